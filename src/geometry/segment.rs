//! Line segments: closest points.

use glam::DVec3;

/// The point of the segment `start`-`end` closest to `point`.
pub fn closest_point(point: DVec3, start: DVec3, end: DVec3) -> DVec3 {
    let direction = end - start;
    let squared = direction.length_squared();
    if squared == 0.0 {
        return start;
    }
    start + direction * ((point - start).dot(direction) / squared).clamp(0.0, 1.0)
}

/// Squared distance of `point` to the segment `start`-`end`.
pub fn squared_distance(point: DVec3, start: DVec3, end: DVec3) -> f64 {
    point.distance_squared(closest_point(point, start, end))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn closest_points_are_clamped_to_the_ends() {
        let (start, end) = (DVec3::ZERO, DVec3::X);
        assert_eq!(closest_point(DVec3::new(0.5, 1.0, 0.0), start, end), DVec3::new(0.5, 0.0, 0.0));
        assert_eq!(squared_distance(DVec3::new(3.0, 0.0, 0.0), start, end), 4.0);
    }
}
