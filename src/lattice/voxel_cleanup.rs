//! Clean-up of the segmentation before the lattice sees it, and the way back to the caller's labels.
//!
//! # Method
//! Up-sampling, isolated voxels, small regions, contacts, then a label of its own for each region where asked for; the
//! operations are those of `image::morphology` and `image::contact_removal`. Every change is a finding with the label and the number of voxels.
//!
//! # Source
//! [Drakopoulos2017] 2.3.2.

use std::borrow::Cow;

use crate::context::RunContext;
use crate::error::{Finding, FindingCode, Result, Severity};
use crate::image::contact_costs::OutOfRange;
use crate::image::contact_removal::{RemovedContacts, remove_contacts};
use crate::image::label_image::LabelImage;
use crate::image::morphology::{IsolatedKind, relabel_isolated, remove_small_regions, separate_regions, upsample};
use crate::index::Label;
use crate::lattice::options::{IsolatedVoxels, Options};
use crate::lattice::report::Report;
use crate::statistics::Statistics;

/// The segmentation that is meshed.
pub struct CleanImage<'a> {
    /// Internal labels.
    pub image: Cow<'a, LabelImage>,
    /// The caller's value of each internal label.
    pub values: Vec<i32>,
    /// Volume that the mesh of each internal label is to have, mm^3: of its voxels, without what the removal of contacts
    /// gave or took. On walls of 1.4 voxels around vessels that is 6.5 % of the vessels, and contacts end at corners of voxels,
    /// which surfaces of that volume round off.
    pub volumes: Vec<f64>,
    /// What was changed.
    pub figures: Statistics,
}

/// Cleans a segmentation as the options say.
///
/// # Errors
/// [`crate::Error::CapacityExceeded`] for too many regions, [`crate::Error::InvalidArgument`] for an image that
/// up-sampling makes too large; [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn clean<'a>(image: &'a LabelImage, options: &Options, context: &RunContext) -> Result<CleanImage<'a>> {
    let mut report = Report::default();
    let mut clean = Cow::Borrowed(image);
    if options.upsampling > 1 {
        clean = Cow::Owned(upsample(image, options.upsampling, context)?);
    }
    let kinds: &[IsolatedKind] = match options.isolated_voxels {
        IsolatedVoxels::Keep => &[],
        IsolatedVoxels::Background => &[IsolatedKind::Background],
        IsolatedVoxels::Foreground => &[IsolatedKind::Foreground],
        IsolatedVoxels::Both => &[IsolatedKind::Background, IsolatedKind::Foreground],
    };
    for kind in kinds {
        let changed = relabel_isolated(clean.to_mut(), *kind, context)?;
        tell(&changed, image, "isolated voxels", "cleanup.isolated", &mut report, context);
    }
    if let Some(threshold) = options.image_region_threshold {
        let changed = remove_small_regions(clean.to_mut(), threshold, context)?;
        tell(&changed, image, "voxels of small regions", "cleanup.small_regions", &mut report, context);
    }
    let before = clean.voxel_counts();
    if options.check_image_topology {
        let removed = remove_contacts(clean.to_mut(), options.seed, context)?;
        report.set("cleanup.contacts", removed.voxels as f64);
        report.set("cleanup.opened_walls", removed.opened as f64);
        tell_removed(removed, &clean, context);
    }
    let values = clean.values().to_vec();
    let voxel = clean.grid().spacing().element_product();
    if !options.separate_regions {
        let volumes = before.into_iter().map(|count| count as f64 * voxel).collect();
        return Ok(CleanImage { image: clean, values, volumes, figures: report.statistics() });
    }
    // Contacts of a label are removed all over it: each of its regions gets the same share back.
    let share = |(before, after): (u64, u64)| before as f64 / after.max(1) as f64;
    let shares: Vec<f64> = before.into_iter().zip(clean.voxel_counts()).map(share).collect();
    let (regions, originals) = separate_regions(&clean, context)?;
    report.set("cleanup.regions", (originals.len() - 1) as f64);
    let values = originals.iter().map(|l| values[l.index()]).collect();
    let volume = |(count, label): (u64, &Label)| count as f64 * shares[label.index()] * voxel;
    let volumes = regions.voxel_counts().into_iter().zip(&originals).map(volume).collect();
    Ok(CleanImage { image: Cow::Owned(regions), values, volumes, figures: report.statistics() })
}

fn tell_removed(removed: RemovedContacts, image: &LabelImage, context: &RunContext) {
    let RemovedContacts { voxels, opened, euler, pieces } = removed;
    if opened > 0 {
        let text =
            format!("removing contacts brought labels face to face in {opened} places where others lay between them");
        context.report(Finding::new(FindingCode::VoxelsRelabelled, Severity::Warning, text));
    }
    tell_topology(euler, image, FindingCode::OtherTopology, "the Euler number", context);
    tell_topology(pieces, image, FindingCode::DisconnectedMesh, "the number of pieces", context);
    if voxels > 0 {
        let text = format!("{voxels} voxels were relabelled to remove contacts at edges and corners");
        let finding = Finding::new(FindingCode::VoxelsRelabelled, Severity::Note, text);
        context.report(finding.with_ids(-1, voxels as i64));
    }
}

fn tell_topology(found: Vec<OutOfRange>, image: &LabelImage, code: FindingCode, what: &str, context: &RunContext) {
    for OutOfRange { label, number, range: [low, high] } in found {
        let value = image.values()[label.index()];
        let text =
            format!("removing contacts gave label {value} {what} {number}, outside of the image's {low} to {high}");
        let off = if number < low { number - low } else { number - high };
        context.report(Finding::new(code, Severity::Warning, text).with_ids(i64::from(value), off));
    }
}

fn tell(changed: &[u64], image: &LabelImage, what: &str, name: &str, report: &mut Report, context: &RunContext) {
    report.add(name, changed.iter().sum::<u64>() as f64);
    for (label, count) in changed.iter().enumerate().filter(|(_, count)| **count > 0) {
        let value = image.values()[label];
        let text = format!("{count} {what} of label {value} were relabelled");
        let finding = Finding::new(FindingCode::VoxelsRelabelled, Severity::Note, text);
        context.report(finding.with_ids(i64::from(value), *count as i64));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lattice::options::PARAMETERS;
    use crate::lattice::test_images::{segment_distance, voxel_image};
    use crate::parameters::ParameterSet;
    use glam::DVec3;

    /// How many walls the removal of contacts opened, and the warnings.
    fn opened(image: &LabelImage) -> (f64, Vec<FindingCode>) {
        let mut set = ParameterSet::new(PARAMETERS);
        set.set_text("check-image-topology", "1").unwrap();
        let context = RunContext::with_threads(1).unwrap();
        let clean = clean(image, &Options::from_parameters(&set).unwrap(), &context).unwrap();
        let findings = context.take_findings();
        let warnings = findings.iter().filter(|f| f.severity == Severity::Warning).map(|f| f.code).collect();
        (clean.figures.value("cleanup.opened_walls").unwrap(), warnings)
    }

    #[test]
    fn walls_stay_closed_where_another_voxel_can_take_their_place() {
        // Vessels that cross, in a wall of 1.6 voxels: where it touches itself and them at edges and corners of voxels only, no voxels
        // of the contact keep its Euler number without a hole; one beside them does.
        let vessels = [
            ([[8.22, 19.91, 7.84], [24.77, 21.06, 9.79]], 3.465),
            ([[14.71, 15.93, 17.02], [23.42, 14.34, 20.09]], 2.568),
            ([[17.31, 29.0, 17.78], [7.14, 10.1, 26.38]], 2.665),
            ([[19.57, 15.02, 18.78], [19.94, 29.0, 6.0]], 2.03),
        ];
        let beyond = |p: DVec3| vessels.map(|(ends, radius)| segment_distance(p, ends) - radius);
        let nearest = |p: DVec3| beyond(p).into_iter().fold(f64::INFINITY, f64::min);
        let vessels = opened(&voxel_image(36, |p| match nearest(p) {
            d if d < 0.0 => 1,
            d if d < 1.6185 => 2,
            _ => 0,
        }));
        assert_eq!(vessels, (0.0, Vec::new()));
        // A thick wall around a ball, with contacts of its voxels only.
        let ball = voxel_image(16, |p| match p.distance(DVec3::splat(7.3)) {
            d if d < 3.0 => 1,
            d if d < 6.0 => 2,
            _ => 0,
        });
        assert_eq!(opened(&ball), (0.0, Vec::new()));
    }

    #[test]
    fn what_the_removal_of_contacts_could_not_keep_is_told() {
        let image = voxel_image(8, |p| u16::from(p.x < 3.0));
        let context = RunContext::with_threads(1).unwrap();
        let out = |number: i64| vec![OutOfRange { label: Label(1), number, range: [2, 4] }];
        tell_removed(RemovedContacts { voxels: 9, opened: 2, euler: out(6), pieces: out(1) }, &image, &context);
        let told: Vec<_> = context.take_findings().into_iter().map(|f| (f.code, f.severity, f.ids)).collect();
        let expected = [
            (FindingCode::VoxelsRelabelled, Severity::Warning, [-1, -1]),
            (FindingCode::OtherTopology, Severity::Warning, [1, 2]),
            (FindingCode::DisconnectedMesh, Severity::Warning, [1, -1]),
            (FindingCode::VoxelsRelabelled, Severity::Note, [-1, 9]),
        ];
        assert_eq!(told, expected);
    }
}
