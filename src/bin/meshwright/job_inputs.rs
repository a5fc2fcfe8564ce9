//! Reading what the jobs work on.

use std::path::Path;
use std::sync::Arc;

use glam::{DMat4, DVec3};
use meshwright::image::label_image::LabelImage;
use meshwright::image::voxel_image::VoxelImage;
use meshwright::mesh::mixed_mesh::{MixedMesh, Space};
use meshwright::mesh::sizing::Sizing;
use meshwright::mesh::surface_mesh::{Patch, PatchRole, SurfaceMesh};
use meshwright::parameters::{ParameterSet, Value, find};
use meshwright::pipeline::registration;
use meshwright::{Error, Result, io};

/// The text of a file parameter that has to be given.
fn required(set: &ParameterSet, name: &str) -> Result<String> {
    set.text(name).ok_or_else(|| Error::ParameterValue { name: name.to_owned(), reason: "it has to be given".into() })
}

/// The text of a parameter that a table may lack.
fn optional(set: &ParameterSet, name: &str) -> Option<String> {
    find(set.table(), name).ok().and_then(|_| set.text(name))
}

/// The labels of an image file.
///
/// # Errors
/// Those of the reader and of the conversion.
pub fn read_labels(path: &str) -> Result<LabelImage> {
    let path = Path::new(path);
    io::read_image(path)?.to_label_image().map_err(|error| match error {
        Error::InvalidInput { message, findings } => {
            Error::InvalidInput { message: format!("{}: {message}", path.display()), findings }
        }
        other => other,
    })
}

/// Of image-to-mesh.
pub struct ImageInputs {
    /// The segmentation.
    pub labels: LabelImage,
    /// Points that become vertices.
    pub fixed_points: Vec<DVec3>,
}

impl ImageInputs {
    /// Reads the files that the parameters name.
    ///
    /// # Errors
    /// Those of the reader.
    pub fn read(set: &ParameterSet) -> Result<Self> {
        required(set, "output")?;
        Ok(Self { labels: read_labels(&required(set, "image")?)?, fixed_points: Vec::new() })
    }
}

/// Of surface-to-mesh.
pub struct SurfaceInputs {
    /// The surface.
    pub surface: SurfaceMesh,
    /// Sizes from a background mesh.
    pub sizing: Option<Sizing>,
}

impl SurfaceInputs {
    /// Reads the files that the parameters name.
    ///
    /// # Errors
    /// Those of the reader.
    pub fn read(set: &ParameterSet) -> Result<Self> {
        required(set, "output")?;
        let surface = io::read_surface(Path::new(&required(set, "plc")?))?;
        let sizing = match optional(set, "background") {
            Some(path) => Some(background_sizing(Path::new(&path))?),
            None => None,
        };
        Ok(Self { surface, sizing })
    }

    /// Patches with the roles that the parameters give them.
    ///
    /// # Errors
    /// [`Error::InvalidArgument`] for an unknown role.
    pub fn patches(&self, set: &ParameterSet) -> Result<Vec<Patch>> {
        let mut surface = SurfaceMesh { patches: self.surface.patches.clone(), ..SurfaceMesh::default() };
        for value in set.values("patch-role") {
            // The engine has refused what has another form.
            if let Value::Text(text) = value
                && let Some((patch, role)) = text.split_once('=')
                && let Ok(id) = patch.trim().parse()
            {
                surface.patch_mut(id).role = PatchRole::from_name(role.trim())?;
            }
        }
        Ok(surface.patches)
    }
}

fn background_sizing(path: &Path) -> Result<Sizing> {
    let mesh = io::read_mesh(path)?;
    let sizes = mesh.point_data.iter().find(|a| a.name == "size" && a.components == 1);
    let Some(array) = sizes else {
        return Err(Error::format(path, "the background mesh has no point array 'size'"));
    };
    use meshwright::mesh::mixed_mesh::ArrayData;
    let sizes: Vec<f64> = match &array.data {
        ArrayData::Real(values) => values.clone(),
        ArrayData::Int(values) => values.iter().map(|&v| f64::from(v)).collect(),
        ArrayData::Long(values) => values.iter().map(|&v| v as f64).collect(),
    };
    Ok(Sizing { background: Some((Arc::new(mesh), sizes)), ..Sizing::default() })
}

/// Of register.
pub struct RegistrationInputs {
    fixed: VoxelImage,
    moving: VoxelImage,
    segmentation: LabelImage,
    fixed_mask: Option<LabelImage>,
    mesh: Option<MixedMesh>,
    rigid: Option<DMat4>,
    landmarks: Option<(Vec<DVec3>, Vec<DVec3>)>,
}

impl RegistrationInputs {
    /// Reads the files that the parameters name.
    ///
    /// # Errors
    /// Those of the readers.
    pub fn read(set: &ParameterSet) -> Result<Self> {
        let image = |name: &str| io::read_image(Path::new(&required(set, name)?));
        let mesh = match optional(set, "input-mesh") {
            Some(path) => Some(lps_mesh(Path::new(&path))?),
            None => None,
        };
        let landmarks = match optional(set, "landmarks") {
            Some(path) => Some(read_landmarks(Path::new(&path))?),
            None => None,
        };
        let rigid = match optional(set, "initial-transform") {
            Some(text) => Some(parse_transform(&text)?),
            None => None,
        };
        Ok(Self {
            fixed: image("fixed-image")?,
            moving: image("moving-image")?,
            segmentation: read_labels(&required(set, "segmented-image")?)?,
            fixed_mask: optional(set, "fixed-mask").map(|path| read_labels(&path)).transpose()?,
            mesh,
            rigid,
            landmarks,
        })
    }

    /// What the pipeline takes.
    pub fn as_input(&self) -> registration::Input<'_> {
        registration::Input {
            fixed: &self.fixed,
            moving: &self.moving,
            segmentation: &self.segmentation,
            fixed_mask: self.fixed_mask.as_ref(),
            mesh: self.mesh.as_ref(),
            rigid: self.rigid,
            landmarks: self.landmarks.as_ref().map(|(fixed, moving)| (&fixed[..], &moving[..])),
        }
    }
}

/// A mesh in LPS, whatever frame its file states.
pub fn lps_mesh(path: &Path) -> Result<MixedMesh> {
    let mut mesh = io::read_mesh(path)?;
    if mesh.space == Space::Ras {
        mesh.points.iter_mut().for_each(|p| *p *= DVec3::new(-1.0, -1.0, 1.0));
        mesh.space = Space::Lps;
    }
    Ok(mesh)
}

/// 12 or 16 numbers, row-major.
fn parse_transform(text: &str) -> Result<DMat4> {
    let refuse = || Error::ParameterValue {
        name: "initial-transform".into(),
        reason: format!("'{text}' is not 12 or 16 finite numbers of a row-major matrix"),
    };
    let words = text.split(|c: char| c.is_whitespace() || c == ',' || c == ';').filter(|w| !w.is_empty());
    let mut numbers = words.map(|w| w.parse::<f64>().ok()).collect::<Option<Vec<_>>>().ok_or_else(refuse)?;
    if numbers.len() == 12 {
        numbers.extend([0.0, 0.0, 0.0, 1.0]);
    }
    let values: [f64; 16] = numbers.try_into().map_err(|_| refuse())?;
    if values.iter().any(|v| !v.is_finite()) {
        return Err(refuse());
    }
    Ok(DMat4::from_cols_array(&values).transpose())
}

/// The last six columns of each row; a first row of names is passed over.
fn read_landmarks(path: &Path) -> Result<(Vec<DVec3>, Vec<DVec3>)> {
    let text = std::fs::read_to_string(path).map_err(|source| Error::io(path, source))?;
    let (mut fixed, mut moving) = (Vec::new(), Vec::new());
    for (number, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty() && !l.starts_with('#')) {
        let words: Vec<&str> = line.split([',', ';', '\t']).map(str::trim).collect();
        let tail = &words[words.len().saturating_sub(6)..];
        let numbers: Option<Vec<f64>> = tail.iter().map(|w| w.parse().ok().filter(|v: &f64| v.is_finite())).collect();
        match numbers.as_deref() {
            Some(&[a, b, c, d, e, f]) => {
                fixed.push(DVec3::new(a, b, c));
                moving.push(DVec3::new(d, e, f));
            }
            // Names of the columns stand above the first numbers.
            _ if fixed.is_empty() => {}
            _ => return Err(Error::format(path, format!("line {}: six numbers are needed", number + 1))),
        }
    }
    Ok((fixed, moving))
}
