//! What a host says about element sizes: sources, a background mesh, a function.
//!
//! # Method
//! Plain data, handed to the engine as it is; `mesh::size_field` evaluates it. Every part gives an upper bound of the
//! edge length at a point; the smallest bound holds.
//!
//! # Invariants
//! [`Sizing::check`]: sizes are finite and positive, coordinates finite, decays finite and not negative.

use std::sync::Arc;

use glam::DVec3;

use crate::error::{Error, Result};
use crate::mesh::mixed_mesh::MixedMesh;

/// Where a source of sizes lies.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum SourceShape {
    /// A point.
    Point(DVec3),
    /// A straight segment.
    Line(DVec3, DVec3),
    /// An axis-aligned box, smallest and largest corner; the whole inside has the size.
    Box(DVec3, DVec3),
    /// A ball; the whole inside has the size.
    Sphere(DVec3, f64),
}

impl SourceShape {
    /// Distance from `point` to the source, 0 inside.
    pub fn distance(&self, point: DVec3) -> f64 {
        match *self {
            Self::Point(p) => point.distance(p),
            Self::Line(a, b) => {
                let along = b - a;
                let squared = along.length_squared();
                let t = if squared > 0.0 { ((point - a).dot(along) / squared).clamp(0.0, 1.0) } else { 0.0 };
                point.distance(a + t * along)
            }
            Self::Box(low, high) => point.distance(point.clamp(low, high)),
            Self::Sphere(center, radius) => (point.distance(center) - radius).max(0.0),
        }
    }
}

/// A source of sizes: edge length at most `size + decay * distance`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SizeSource {
    /// Where it lies.
    pub shape: SourceShape,
    /// Edge length at the source, mm.
    pub size: f64,
    /// Growth of the edge length per millimetre of distance; infinite decay is written as a very large number.
    pub decay: f64,
}

/// A host's size function: `(point, size wanted so far) -> edge length`, called from several threads at once. A value
/// that is not finite and positive ends the run with an error.
pub type SizeFunction = Arc<dyn Fn(DVec3, f64) -> f64 + Send + Sync>;

/// Everything a host says about sizes.
#[derive(Clone, Default)]
pub struct Sizing {
    /// Sources.
    pub sources: Vec<SizeSource>,
    /// A function of the host.
    pub function: Option<SizeFunction>,
    /// A mesh and an edge length at each of its points, interpolated linearly; outside of it there is no bound.
    pub background: Option<(Arc<MixedMesh>, Vec<f64>)>,
}

impl Sizing {
    /// Checks the numbers.
    ///
    /// # Errors
    /// [`Error::InvalidArgument`] naming the first that is unusable.
    pub fn check(&self) -> Result<()> {
        for (i, source) in self.sources.iter().enumerate() {
            let finite = match source.shape {
                SourceShape::Point(p) => p.is_finite(),
                SourceShape::Line(a, b) => a.is_finite() && b.is_finite(),
                SourceShape::Box(a, b) => a.is_finite() && b.is_finite() && a.cmple(b).all(),
                SourceShape::Sphere(c, r) => c.is_finite() && r.is_finite() && r >= 0.0,
            };
            if !finite {
                return Err(Error::argument("source", format!("number {i}: {:?} is not a finite shape", source.shape)));
            }
            check_size("source", i, source.size)?;
            if !(source.decay.is_finite() && source.decay >= 0.0) {
                return Err(Error::argument("source", format!("number {i}: decay {} is unusable", source.decay)));
            }
        }
        if let Some((mesh, sizes)) = &self.background {
            if mesh.points.len() != sizes.len() {
                let reason = format!("{} sizes for {} points", sizes.len(), mesh.points.len());
                return Err(Error::argument("background", reason));
            }
            sizes.iter().enumerate().try_for_each(|(i, &size)| check_size("background", i, size))?;
        }
        Ok(())
    }
}

fn check_size(name: &str, number: usize, size: f64) -> Result<()> {
    if size.is_finite() && size > 0.0 {
        Ok(())
    } else {
        Err(Error::argument(name, format!("number {number}: size {size} is not finite and positive")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_to_the_shapes() {
        let p = DVec3::new(3.0, 4.0, 0.0);
        assert_eq!(SourceShape::Point(DVec3::ZERO).distance(p), 5.0);
        assert_eq!(SourceShape::Line(DVec3::ZERO, DVec3::X).distance(DVec3::new(0.5, 2.0, 0.0)), 2.0);
        assert_eq!(SourceShape::Box(DVec3::ZERO, DVec3::ONE).distance(DVec3::new(0.5, 0.5, 3.0)), 2.0);
        assert_eq!(SourceShape::Sphere(DVec3::ZERO, 6.0).distance(p), 0.0);
    }

    #[test]
    fn unusable_sizes_are_refused() {
        for size in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            let source = SizeSource { shape: SourceShape::Point(DVec3::ZERO), size, decay: 0.2 };
            assert!(Sizing { sources: vec![source], ..Sizing::default() }.check().is_err(), "{size}");
        }
    }
}
