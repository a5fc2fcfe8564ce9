//! The deepest point of the kernel of a star-shaped polyhedron: as far as can be from the planes of all its faces.
//!
//! # Method
//! A linear program in four unknowns, a place and its least distance to the planes, which is to be largest. Planes are taken one
//! after the other in mixed order; where the solution so far lies beyond the next, the new one lies on it, and the program on
//! that plane has one unknown less.
//! ```text
//!     +--------------+        . the kernel: all places that see every face from inside;
//!     |              |          between walls that nearly meet it is thousands of times
//!     |   +......+   |          thinner than wide, so that searches which climb do not find it
//!     |  /  .  .  \  |
//!     +-/    ..    \-+
//! ```
//! # Source
//! [Seidel1991].
//!
//! # Cost
//! Linear in the faces on average, some ten microseconds for thirty. No allocation after the buffers have grown.

use glam::DVec3;

use super::spatial_sort::mix;

/// Unknowns: the place and the distance.
const UNKNOWNS: usize = 4;
/// Distances, as shares of the polyhedron's extent, that count as none.
const TOLERANCE: f64 = 1e-13;

/// What a solution keeps to: the product with `factors` is at most `bound`.
#[derive(Debug, Clone, Copy)]
struct Row {
    factors: [f64; UNKNOWNS],
    bound: f64,
}

/// Buffers of the linear program.
#[derive(Debug, Clone, Default)]
pub struct StarKernel {
    /// The rows of the program with one unknown, with two, and so on.
    rows: [Vec<Row>; UNKNOWNS],
}

/// Dimensions of a box and what is to be large in it; the first `count` entries count.
#[derive(Debug, Clone, Copy)]
struct Program {
    count: usize,
    aim: [f64; UNKNOWNS],
    lower: [f64; UNKNOWNS],
    upper: [f64; UNKNOWNS],
}

impl StarKernel {
    /// The deepest point of the kernel of a polyhedron with these faces, seen from inside counter-clockwise as (a, b, c, P)
    /// of a positive tet; `None` where there is none, or none thicker than rounding.
    pub fn deepest_point(&mut self, faces: &[[DVec3; 3]]) -> Option<DVec3> {
        let corners = || faces.iter().flatten().copied();
        let low = corners().fold(DVec3::INFINITY, DVec3::min);
        let high = corners().fold(DVec3::NEG_INFINITY, DVec3::max);
        let (center, extent) = (0.5 * (low + high), 0.5 * (high - low).max_element());
        if !(extent > 0.0 && extent.is_finite()) {
            return None;
        }
        let rows = &mut self.rows[UNKNOWNS - 1];
        rows.clear();
        for &[a, b, c] in faces {
            let normal = (b - a).cross(c - a).try_normalize()?;
            // normal . (P - a) >= distance
            let row = Row { factors: [-normal.x, -normal.y, -normal.z, 1.0], bound: normal.dot(center - a) / extent };
            // In mixed order: few planes cut the solution off then.
            let at = (mix(rows.len() as u64) % (rows.len() as u64 + 1)) as usize;
            rows.push(row);
            let last = rows.len() - 1;
            rows.swap(at, last);
        }
        let mut program = Program { count: UNKNOWNS, aim: [0.0; 4], lower: [-1.0; 4], upper: [1.0; 4] };
        program.aim[UNKNOWNS - 1] = 1.0;
        program.lower[UNKNOWNS - 1] = 0.0;
        let [x, y, z, distance] = solve(&mut self.rows, &program)?;
        (distance > TOLERANCE).then(|| center + extent * DVec3::new(x, y, z))
    }
}

/// The place in the box that keeps to all rows of the last list and is farthest along the aim.
fn solve(lists: &mut [Vec<Row>], program: &Program) -> Option<[f64; UNKNOWNS]> {
    let count = program.count;
    let (rows, fewer) = lists.split_last_mut()?;
    if count == 1 {
        return solve_interval(rows, program);
    }
    let mut found = [0.0; UNKNOWNS];
    for i in 0..count {
        found[i] = if program.aim[i] > 0.0 { program.upper[i] } else { program.lower[i] };
    }
    for number in 0..rows.len() {
        let row = rows[number];
        let product: f64 = (0..count).map(|i| row.factors[i] * found[i]).sum();
        if product <= row.bound + TOLERANCE {
            continue;
        }
        // On the plane of this row, one unknown follows from the others.
        let out = (0..count).max_by(|&i, &j| row.factors[i].abs().total_cmp(&row.factors[j].abs()))?;
        if row.factors[out] == 0.0 {
            return None;
        }
        let without = |values: &[f64; UNKNOWNS]| {
            let mut kept = [0.0; UNKNOWNS];
            (0..count).filter(|i| *i != out).enumerate().for_each(|(to, from)| kept[to] = values[from]);
            kept
        };
        let share = without(&row.factors).map(|factor| factor / row.factors[out]);
        let offset = row.bound / row.factors[out];
        // factor * (offset - share . others) takes the place of the unknown.
        let eliminated = |factors: &[f64; UNKNOWNS], bound: f64| {
            let mut kept = without(factors);
            for i in 0..count - 1 {
                kept[i] -= factors[out] * share[i];
            }
            Row { factors: kept, bound: bound - factors[out] * offset }
        };
        let mut unit = [0.0; UNKNOWNS];
        unit[out] = 1.0;
        let list = fewer.last_mut()?;
        list.clear();
        list.push(eliminated(&unit, program.upper[out]));
        list.push(eliminated(&unit.map(|factor| -factor), -program.lower[out]));
        list.extend(rows[..number].iter().map(|before| eliminated(&before.factors, before.bound)));
        let sub = Program {
            count: count - 1,
            aim: eliminated(&program.aim, 0.0).factors,
            lower: without(&program.lower),
            upper: without(&program.upper),
        };
        let others = solve(fewer, &sub)?;
        (0..count).filter(|i| *i != out).enumerate().for_each(|(from, to)| found[to] = others[from]);
        found[out] = offset - (0..count - 1).map(|i| share[i] * others[i]).sum::<f64>();
    }
    Some(found)
}

fn solve_interval(rows: &[Row], program: &Program) -> Option<[f64; UNKNOWNS]> {
    let (mut low, mut high) = (program.lower[0], program.upper[0]);
    for row in rows {
        let factor = row.factors[0];
        if factor > TOLERANCE {
            high = high.min(row.bound / factor);
        } else if factor < -TOLERANCE {
            low = low.max(row.bound / factor);
        } else if row.bound < -TOLERANCE {
            return None;
        }
    }
    if low > high + TOLERANCE {
        return None;
    }
    let mut found = [0.0; UNKNOWNS];
    found[0] = if program.aim[0] > 0.0 { high } else { low };
    Some(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The faces of a box seen from inside, with a distance from the first corner.
    fn box_faces(size: DVec3) -> Vec<[DVec3; 3]> {
        let at = |x: f64, y: f64, z: f64| DVec3::new(x, y, z) * size;
        let quads = [
            [at(0., 0., 0.), at(1., 0., 0.), at(1., 1., 0.), at(0., 1., 0.)],
            [at(0., 0., 1.), at(0., 1., 1.), at(1., 1., 1.), at(1., 0., 1.)],
            [at(0., 0., 0.), at(0., 0., 1.), at(1., 0., 1.), at(1., 0., 0.)],
            [at(0., 1., 0.), at(1., 1., 0.), at(1., 1., 1.), at(0., 1., 1.)],
            [at(0., 0., 0.), at(0., 1., 0.), at(0., 1., 1.), at(0., 0., 1.)],
            [at(1., 0., 0.), at(1., 0., 1.), at(1., 1., 1.), at(1., 1., 0.)],
        ];
        quads.into_iter().flat_map(|[a, b, c, d]| [[a, b, c], [a, c, d]]).collect()
    }

    fn least_distance(faces: &[[DVec3; 3]], p: DVec3) -> f64 {
        let distance = |[a, b, c]: &[DVec3; 3]| (*b - *a).cross(*c - *a).normalize().dot(p - *a);
        faces.iter().map(distance).fold(f64::INFINITY, f64::min)
    }

    #[test]
    fn the_middle_of_a_flat_box_is_deepest() {
        let mut kernel = StarKernel::default();
        for thickness in [1.0, 1e-3, 1e-9] {
            let faces = box_faces(DVec3::new(1.0, 3.0, thickness));
            let found = kernel.deepest_point(&faces).unwrap();
            let distance = least_distance(&faces, found);
            assert!((distance - 0.5 * thickness).abs() < 1e-12, "{thickness} {found} {distance}");
        }
    }

    #[test]
    fn no_place_is_deeper_than_the_one_found() {
        let mut kernel = StarKernel::default();
        let mut word = 1u64;
        let mut next = || {
            word = word.wrapping_add(0x9e37_79b9_7f4a_7c15);
            mix(word) as f64 / u64::MAX as f64 * 2.0 - 1.0
        };
        let mut found = [0, 0];
        for _ in 0..300 {
            // A box with six planes through it.
            let mut faces = box_faces(DVec3::ONE);
            for _ in 0..6 {
                let mut point = |scale: f64| scale * DVec3::new(next(), next(), next());
                let (a, b, c) = (DVec3::splat(0.5) + point(0.4), point(1.0), point(1.0));
                faces.push([a, a + b, a + c]);
            }
            let place = kernel.deepest_point(&faces);
            let depth = place.map_or(0.0, |p| least_distance(&faces, p));
            assert!(place.is_none() || depth > 0.0);
            found[usize::from(place.is_some())] += 1;
            for _ in 0..200 {
                let trial = 0.5 * DVec3::new(next() + 1.0, next() + 1.0, next() + 1.0);
                assert!(least_distance(&faces, trial) <= depth + 1e-12);
            }
        }
        assert!(found[0] > 20 && found[1] > 20, "{found:?}");
    }

    #[test]
    fn polyhedra_without_a_kernel_have_no_deepest_point() {
        let mut faces = box_faces(DVec3::ONE);
        faces.push([DVec3::ZERO, DVec3::Y, DVec3::X].map(|p| p - 0.1 * DVec3::Z));
        assert_eq!(StarKernel::default().deepest_point(&faces), None);
        assert_eq!(StarKernel::default().deepest_point(&[]), None);
    }
}
