//! Image files: what is written comes back, and bad files end in a clear error.

use std::fs;
use std::path::Path;

use glam::{DMat3, DVec3};
use meshwright::image::grid::Grid;
use meshwright::image::voxel_image::{VoxelData, VoxelImage};
use meshwright::{Error, io};

const NAMES: [&str; 6] = ["a.nii", "b.nii.gz", "c.nrrd", "d.nhdr", "e.mha", "f.mhd"];

fn grid() -> Grid {
    // Oblique and left-handed.
    let direction =
        DMat3::from_rotation_x(0.4) * DMat3::from_rotation_z(-1.1) * DMat3::from_diagonal(DVec3::new(1., -1., 1.));
    Grid::new([3, 4, 5], DVec3::new(0.5, 1.25, 2.0), DVec3::new(-10.0, 20.5, 3.0), direction).unwrap()
}

fn every_type() -> Vec<VoxelData> {
    let n = 60;
    vec![
        VoxelData::U8((0..n).collect()),
        VoxelData::I8((0..n).map(|v| v as i8 - 30).collect()),
        VoxelData::U16((0..n).map(|v| u16::from(v) * 1000).collect()),
        VoxelData::I16((0..n).map(|v| (i16::from(v) - 30) * 1000).collect()),
        VoxelData::U32((0..n).map(|v| u32::from(v) * 70_000_000).collect()),
        VoxelData::I32((0..n).map(|v| i32::from(v) * -30_000_000).collect()),
        VoxelData::U64((0..n).map(|v| u64::from(v) << 57).collect()),
        VoxelData::I64((0..n).map(|v| -(i64::from(v) << 56)).collect()),
        VoxelData::F32((0..n).map(|v| f32::from(v) / 7.0).collect()),
        VoxelData::F64((0..n).map(|v| f64::from(v) / 7.0).collect()),
    ]
}

fn assert_same_place(ours: &Grid, theirs: &Grid, tolerance: f64, name: &str) {
    assert_eq!(ours.size(), theirs.size(), "{name}");
    for index in [DVec3::ZERO, DVec3::new(2.0, 3.0, 4.0), DVec3::new(2.0, 0.0, 1.0)] {
        let error = ours.index_to_world(index).distance(theirs.index_to_world(index));
        assert!(error < tolerance, "{name}: {error}");
    }
}

#[test]
fn every_type_comes_back_from_every_format() {
    let folder = tempfile::tempdir().unwrap();
    for name in NAMES {
        for data in every_type() {
            let image = VoxelImage::new(grid(), 1, data).unwrap();
            let path = folder.path().join(name);
            io::write_image(&image, &path).unwrap();
            let back = io::read_image(&path).unwrap();
            assert_eq!(back.data, image.data, "{name}");
            // NIfTI holds its geometry in single precision.
            assert_same_place(&back.grid, &image.grid, if name.contains("nii") { 1e-5 } else { 1e-12 }, name);
        }
    }
}

#[test]
fn displacements_come_back() {
    let folder = tempfile::tempdir().unwrap();
    for name in NAMES {
        let values = VoxelData::F32((0..180).map(|v| v as f32 * 0.25 - 7.0).collect());
        let image = VoxelImage::new(grid(), 3, values).unwrap();
        let path = folder.path().join(name);
        io::write_image(&image, &path).unwrap();
        let back = io::read_image(&path).unwrap();
        assert_eq!((back.components, &back.data), (3, &image.data), "{name}");
    }
}

/// A valid NIfTI file of 3 x 4 x 5 bytes.
fn nifti(folder: &Path) -> Vec<u8> {
    let path = folder.join("valid.nii");
    io::write_image(&VoxelImage::new(grid(), 1, VoxelData::U8(vec![1; 60])).unwrap(), &path).unwrap();
    fs::read(path).unwrap()
}

fn refused(path: &Path, bytes: &[u8], wanted: &str) {
    fs::write(path, bytes).unwrap();
    match io::read_image(path) {
        Err(Error::Format { reason, .. }) => assert!(reason.contains(wanted), "{}: {reason}", path.display()),
        other => panic!("{}: {wanted} gave {other:?}", path.display()),
    }
}

#[test]
fn bad_nifti_is_refused_with_its_reason() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.nii");
    let valid = nifti(folder.path());
    let with = |changes: &[(usize, &[u8])]| {
        let mut bytes = valid.clone();
        for (at, value) in changes {
            bytes[*at..*at + value.len()].copy_from_slice(value);
        }
        bytes
    };
    let short = |value: i16| value.to_ne_bytes();
    let real = |value: f32| value.to_ne_bytes();
    refused(&path, b"", "empty");
    refused(&path, b"hello, this is no image at all", "truncated");
    refused(&path, &[b'x'; 400], "not a NIfTI");
    refused(&path, &with(&[(344, b"abc\0")]), "magic");
    refused(&path, &with(&[(40, &short(2))]), "2-D");
    refused(&path, &with(&[(40, &short(4)), (48, &short(7))]), "4-D");
    refused(&path, &with(&[(42, &short(-3))]), "size");
    refused(&path, &with(&[(42, &short(30000)), (44, &short(30000)), (46, &short(1200))]), "claims");
    refused(&path, &with(&[(80, &real(0.0))]), "voxel size");
    refused(&path, &with(&[(84, &real(-1.0))]), "voxel size");
    refused(&path, &with(&[(88, &real(f32::NAN))]), "voxel size");
    refused(&path, &with(&[(280, &[0; 48])]), "singular");
    refused(&path, &with(&[(284, &real(f32::NAN))]), "singular");
    refused(&path, &with(&[(292, &real(f32::INFINITY))]), "origin");
    refused(&path, &with(&[(70, &short(1792))]), "datatype");
    refused(&path, &with(&[(108, &real(f32::NAN))]), "byte");
    refused(&path, &valid[..valid.len() - 5], "claims");
    // One time point is no movie.
    fs::write(&path, with(&[(40, &short(4)), (48, &short(1))])).unwrap();
    assert_eq!(io::read_image(&path).unwrap().grid.size(), [3, 4, 5]);
}

#[test]
fn a_truncated_or_lying_gzip_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.nii.gz");
    let noise = VoxelData::U8((0..60u32).map(|v| (v * v * 7919 % 251) as u8).collect());
    io::write_image(&VoxelImage::new(grid(), 1, noise).unwrap(), &path).unwrap();
    let bytes = fs::read(&path).unwrap();
    for length in 1..bytes.len() {
        fs::write(&path, &bytes[..length]).unwrap();
        let error = io::read_image(&path).unwrap_err();
        assert!(matches!(error, Error::Format { .. }), "{length}: {error}");
    }
    // 2^40 voxels over a few packed bytes: no memory is asked for.
    let mut header = nifti(folder.path());
    for at in [42, 44, 46] {
        header[at..at + 2].copy_from_slice(&10_000i16.to_ne_bytes());
    }
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    std::io::Write::write_all(&mut encoder, &header).unwrap();
    refused(&path, &encoder.finish().unwrap(), "ends after");
}

#[test]
fn bad_nrrd_and_metaimage_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let nrrd = folder.path().join("a.nrrd");
    let head = |fields: &str| format!("NRRD0004\n{fields}\n\n0123456789").into_bytes();
    let ok = "type: uint8\ndimension: 3\nencoding: raw\n";
    refused(&nrrd, b"NRRX0004\n", "not an NRRD");
    refused(&nrrd, b"NRRD0004\ntype: uint8", "truncated");
    refused(&nrrd, &head("type: uint8\ndimension: 2\nsizes: 2 5\nencoding: raw"), "2-D");
    refused(&nrrd, &head("type: uint8\ndimension: 4\nsizes: 1 2 5 3\nencoding: raw"), "4-D");
    refused(&nrrd, &head(&format!("{ok}sizes: 10000 10000 10000")), "claims");
    refused(&nrrd, &head(&format!("{ok}sizes: 1 2 5\nspacings: 1 0 1")), "spacing");
    refused(&nrrd, &head(&format!("{ok}sizes: 1 2 5\nspacings: 1 nan 1")), "spacing");
    refused(&nrrd, &head(&format!("{ok}sizes: 1 2 5\nspacings: 1 -2 1")), "spacing");
    refused(
        &nrrd,
        &head(&format!("{ok}sizes: 1 2 5\nspace: LPS\nspace directions: (1,0,0) (1,0,0) (0,0,1)")),
        "singular",
    );
    refused(&nrrd, &head(&format!("{ok}sizes: 1 2 5\nspace: XYZ\nspace directions: (1,0,0) (0,1,0) (0,0,1)")), "space");
    refused(&nrrd, &head("type: uint8\ndimension: 3\nencoding: bzip2\nsizes: 1 2 5"), "encoding");
    let meta = folder.path().join("a.mha");
    let head = |fields: &str| format!("ObjectType = Image\n{fields}\nElementDataFile = LOCAL\n0123456789").into_bytes();
    let ok = "NDims = 3\nElementType = MET_UCHAR\nDimSize = 1 2 5";
    refused(&meta, b"ObjectType = Image\nNDims = 3\n", "truncated");
    refused(&meta, &head("NDims = 2\nElementType = MET_UCHAR\nDimSize = 2 5"), "2-D");
    refused(&meta, &head("NDims = 4\nElementType = MET_UCHAR\nDimSize = 1 2 5 2"), "4-D");
    refused(&meta, &head("NDims = 3\nElementType = MET_UCHAR\nDimSize = 100000 100000 100"), "claims");
    refused(&meta, &head(&format!("{ok}\nElementSpacing = 1 0 1")), "spacing");
    refused(&meta, &head(&format!("{ok}\nElementSpacing = 1 nan 1")), "spacing");
    refused(&meta, &head(&format!("{ok}\nTransformMatrix = 1 0 0 1 0 0 0 0 1")), "singular");
    refused(&meta, &head("NDims = 3\nElementType = MET_OTHER\nDimSize = 1 2 5"), "ElementType");
    fs::write(&meta, head(ok)).unwrap();
    assert_eq!(io::read_image(&meta).unwrap().data, VoxelData::U8(b"0123456789".to_vec()));
}

#[test]
fn cut_and_broken_headers_never_panic() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["a.nii", "c.nrrd", "e.mha"] {
        let path = folder.path().join(name);
        io::write_image(&VoxelImage::new(grid(), 1, VoxelData::I16(vec![1; 60])).unwrap(), &path).unwrap();
        let bytes = fs::read(&path).unwrap();
        for length in 0..bytes.len() {
            fs::write(&path, &bytes[..length]).unwrap();
            assert!(io::read_image(&path).is_err(), "{name} cut at {length}");
        }
        for at in 0..bytes.len() {
            let mut broken = bytes.clone();
            broken[at] ^= 0x5a;
            fs::write(&path, &broken).unwrap();
            let _ = io::read_image(&path);
        }
    }
}
