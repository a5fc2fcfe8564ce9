//! Images: label images, scans, displacement fields; borrowed or copied.
//!
//! # Method
//! A copied image is a [`VoxelImage`]. A borrowed one keeps the host's pointer; whatever is needed of it is read when
//! it is given to a job or written to a file, never later, so a job holds no pointer of the host.

use std::ffi::{c_char, c_void};
use std::sync::Arc;

use glam::{DMat3, DVec3};

use super::guard::guard;
use super::handles::{borrow, destroy, give, null};
use super::slices::{path, sized, write_sized};
use super::status::mw_status;
use crate::error::{Error, Result};
use crate::image::grid::Grid;
use crate::image::label_image::LabelImage;
use crate::image::voxel_image::{VoxelData, VoxelImage, VoxelValue, label_image_from_slice};
use crate::{io, with_voxels};

use super::context::{mw_context, shared_context};

/// An image. It does not change after its creation: any number of threads may read it.
pub struct mw_image {
    content: Content,
}

#[allow(clippy::large_enum_variant)] // one per handle, behind a pointer of its own
enum Content {
    Owned(Arc<VoxelImage>),
    Borrowed(BorrowedVoxels),
}

/// Type of array values: one of the MW_TYPE_... numbers.
pub type mw_type = i32;

/// uint8_t
pub const MW_TYPE_U8: mw_type = 1;
/// int8_t
pub const MW_TYPE_I8: mw_type = 2;
/// uint16_t
pub const MW_TYPE_U16: mw_type = 3;
/// int16_t
pub const MW_TYPE_I16: mw_type = 4;
/// uint32_t
pub const MW_TYPE_U32: mw_type = 5;
/// int32_t
pub const MW_TYPE_I32: mw_type = 6;
/// uint64_t
pub const MW_TYPE_U64: mw_type = 7;
/// int64_t
pub const MW_TYPE_I64: mw_type = 8;
/// float
pub const MW_TYPE_F32: mw_type = 9;
/// double
pub const MW_TYPE_F64: mw_type = 10;

/// Frame of coordinates: left, posterior, superior (DICOM, ITK). What the library uses.
pub const MW_SPACE_LPS: i32 = 1;
/// Frame of coordinates: right, anterior, superior (NIfTI, the scene of 3D Slicer).
pub const MW_SPACE_RAS: i32 = 2;

/// Copy the voxels: the caller's array is free for other use after mw_image_create.
pub const MW_COPY: i32 = 0;
/// Borrow the voxels: the caller keeps the array unchanged until mw_image_destroy has returned.
pub const MW_BORROW: i32 = 1;

/// Describes an image in memory. Set everything to zero first, then `struct_size = sizeof(mw_image_desc)`.
/// Voxel (i, j, k), component c stands at `data[i * stride[0] + j * stride[1] + k * stride[2] + c]`.
/// Its centre in the world is `origin + direction * (spacing .* (i, j, k))`, the convention of ITK.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct mw_image_desc {
    /// sizeof(mw_image_desc)
    pub struct_size: usize,
    /// Voxels along i, j, k; each at least 1.
    pub dims: [i64; 3],
    /// Distance of voxel centres along i, j, k, mm; within 1e-6 and 1e6.
    pub spacing: [f64; 3],
    /// Centre of voxel (0, 0, 0), mm.
    pub origin: [f64; 3],
    /// 3 x 3, row-major; column n is the direction of axis n. All zero: identity. It may reflect.
    pub direction: [f64; 9],
    /// Value of voxel (0, 0, 0), aligned for its type.
    pub data: *const c_void,
    /// Steps along i, j, k, in values, not bytes; may be negative. A zero stands for the step of a packed array.
    pub stride: [i64; 3],
    /// Type of the values, MW_TYPE_...
    pub r#type: mw_type,
    /// MW_COPY or MW_BORROW.
    pub borrow: i32,
    /// Frame of origin and direction: MW_SPACE_LPS or MW_SPACE_RAS; 0 stands for LPS.
    pub space: i32,
    /// Values per voxel; 0 stands for 1. Displacement fields have 3.
    pub components: i32,
}

/// Size of the first version of the struct.
const IMAGE_DESC_SIZE: usize = size_of::<mw_image_desc>();

/// Voxels in the host's memory.
#[derive(Clone, Copy)]
struct BorrowedVoxels {
    grid: Grid,
    components: usize,
    data: *const c_void,
    /// Per axis, in values.
    strides: [isize; 3],
    kind: mw_type,
}

// SAFETY: the host promised not to change the array while the image lives; it is only read.
unsafe impl Send for BorrowedVoxels {}
// SAFETY: as above.
unsafe impl Sync for BorrowedVoxels {}

/// Runs `$body` with `$Type` standing for the type of `$kind`.
macro_rules! with_type {
    (@rows $kind:expr, $Type:ident => $body:expr; $($number:ident: $value:ty),*) => {
        match $kind {
            $($number => {
                type $Type = $value;
                $body
            })*
            other => Err(unknown_type(other)),
        }
    };
    ($kind:expr, $Type:ident => $body:expr) => {
        with_type!(@rows $kind, $Type => $body; MW_TYPE_U8: u8, MW_TYPE_I8: i8, MW_TYPE_U16: u16, MW_TYPE_I16: i16,
            MW_TYPE_U32: u32, MW_TYPE_I32: i32, MW_TYPE_U64: u64, MW_TYPE_I64: i64, MW_TYPE_F32: f32, MW_TYPE_F64: f64)
    };
}

fn unknown_type(number: mw_type) -> Error {
    Error::argument("type", format!("{number} is no MW_TYPE_ number (1 to 10)"))
}

/// A value that [`VoxelData`] has a vector for.
trait Stored: VoxelValue {
    /// Its MW_TYPE_ number.
    const NUMBER: mw_type;

    fn wrap(values: Vec<Self>) -> VoxelData;
}

macro_rules! stored {
    ($($number:ident: $type:ty, $variant:ident;)*) => {$(
        impl Stored for $type {
            const NUMBER: mw_type = $number;

            fn wrap(values: Vec<Self>) -> VoxelData {
                VoxelData::$variant(values)
            }
        }
    )*};
}
stored! {
    MW_TYPE_U8: u8, U8; MW_TYPE_I8: i8, I8; MW_TYPE_U16: u16, U16; MW_TYPE_I16: i16, I16; MW_TYPE_U32: u32, U32;
    MW_TYPE_I32: i32, I32; MW_TYPE_U64: u64, U64; MW_TYPE_I64: i64, I64; MW_TYPE_F32: f32, F32; MW_TYPE_F64: f64, F64;
}

impl BorrowedVoxels {
    /// Checks a description.
    fn new(desc: &mw_image_desc) -> Result<Self> {
        let size = desc.dims.map(|d| usize::try_from(d).unwrap_or(0));
        let components = usize::try_from(desc.components.max(1)).unwrap_or(1);
        if desc.components < 0 {
            return Err(Error::argument("components", format!("{} is negative", desc.components)));
        }
        let grid = grid_of(desc, size)?;
        if desc.data.is_null() {
            return Err(null("data"));
        }
        let packed = [components as i64, (components * size[0]) as i64, (components * size[0] * size[1]) as i64];
        let mut strides = [0; 3];
        for axis in 0..3 {
            let stride = if desc.stride[axis] == 0 { packed[axis] } else { desc.stride[axis] };
            strides[axis] =
                isize::try_from(stride).map_err(|_| Error::argument("stride", format!("{stride} is out of range")))?;
        }
        let value_bytes = with_type!(desc.r#type, T => Ok(size_of::<T>()))?;
        let voxels = Self { grid, components, data: desc.data, strides, kind: desc.r#type };
        voxels.check_reach(value_bytes as i128)?;
        if !desc.data.addr().is_multiple_of(value_bytes) {
            return Err(Error::argument("data", format!("not aligned to {value_bytes} bytes")));
        }
        Ok(voxels)
    }

    fn check_reach(&self, value_bytes: i128) -> Result<()> {
        let (low, high) = self.reach();
        if (high - low + 1) * value_bytes > isize::MAX as i128 {
            return Err(Error::argument("stride", format!("{:?} reach past the address space", self.strides)));
        }
        Ok(())
    }

    /// Positions of the lowest and the highest value, relative to `data`.
    fn reach(&self) -> (i128, i128) {
        let size = self.grid.size();
        (0..3).fold((0, self.components as i128 - 1), |(low, high), axis| {
            let reach = (size[axis] as i128 - 1) * self.strides[axis] as i128;
            (low + reach.min(0), high + reach.max(0))
        })
    }

    /// The host's memory from the lowest to the highest value, and the position of voxel 0 in it.
    ///
    /// # Safety
    /// The host's array is alive and nobody writes it for `'a`; `T` is the type of `kind`.
    unsafe fn values<'a, T>(&self) -> (&'a [T], usize) {
        let (low, high) = self.reach();
        // SAFETY: check_reach keeps the span within isize::MAX bytes, new() checked null and alignment; the host
        // promised that every voxel of its description is readable.
        let values = unsafe {
            std::slice::from_raw_parts(self.data.cast::<T>().offset(low as isize), (high - low + 1) as usize)
        };
        (values, (-low) as usize)
    }

    fn copy<T: Stored>(&self) -> Result<VoxelData> {
        // SAFETY: only called while the image is alive, during which the host keeps the array; T follows from `kind`.
        let (values, base) = unsafe { self.values::<T>() };
        let [ni, nj, nk] = self.grid.size();
        let total = ni * nj * nk * self.components;
        let mut copy = Vec::new();
        let bytes = (total * size_of::<T>()) as u64;
        copy.try_reserve_exact(total).map_err(|_| Error::OutOfMemory { what: "image", bytes })?;
        for k in 0..nk as isize {
            for j in 0..nj as isize {
                let row = base as isize + j * self.strides[1] + k * self.strides[2];
                for i in 0..ni as isize {
                    let at = (row + i * self.strides[0]) as usize;
                    copy.extend_from_slice(&values[at..at + self.components]);
                }
            }
        }
        Ok(T::wrap(copy))
    }

    fn to_voxel_image(self) -> Result<VoxelImage> {
        let data = with_type!(self.kind, T => self.copy::<T>())?;
        VoxelImage::new(self.grid, self.components, data)
    }

    fn to_label_image(self) -> Result<LabelImage> {
        if self.components != 1 {
            let reason = format!("a label image has one value per voxel, this one has {}", self.components);
            return Err(Error::input(reason));
        }
        with_type!(self.kind, T => {
            // SAFETY: as in `copy`.
            let (values, _) = unsafe { self.values::<T>() };
            label_image_from_slice(self.grid, values, self.strides)
        })
    }
}

fn grid_of(desc: &mw_image_desc, size: [usize; 3]) -> Result<Grid> {
    let mut origin = DVec3::from_array(desc.origin);
    let mut direction =
        if desc.direction == [0.0; 9] { DMat3::IDENTITY } else { DMat3::from_cols_array(&desc.direction).transpose() };
    match desc.space {
        0 | MW_SPACE_LPS => {}
        MW_SPACE_RAS => {
            let flip = DVec3::new(-1.0, -1.0, 1.0);
            origin *= flip;
            direction = DMat3::from_diagonal(flip) * direction;
        }
        other => return Err(Error::argument("space", format!("{other} is no MW_SPACE_ number"))),
    }
    if !matches!(desc.borrow, MW_COPY | MW_BORROW) {
        return Err(Error::argument("borrow", format!("{} is neither MW_COPY nor MW_BORROW", desc.borrow)));
    }
    Grid::new(size, DVec3::from_array(desc.spacing), origin, direction)
}

impl mw_image {
    /// A handle's content for an image the library made.
    pub fn owned(image: Arc<VoxelImage>) -> Self {
        Self { content: Content::Owned(image) }
    }

    /// The image as labels.
    ///
    /// # Errors
    /// As [`VoxelImage::to_label_image`].
    pub fn to_label_image(&self) -> Result<LabelImage> {
        match &self.content {
            Content::Owned(image) => image.to_label_image(),
            Content::Borrowed(voxels) => voxels.to_label_image(),
        }
    }

    /// The image with voxels of its own: shared where it has some, copied where it borrowed them.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn to_voxel_image(&self) -> Result<Arc<VoxelImage>> {
        match &self.content {
            Content::Owned(image) => Ok(Arc::clone(image)),
            Content::Borrowed(voxels) => voxels.to_voxel_image().map(Arc::new),
        }
    }

    fn describe(&self) -> mw_image_desc {
        let (grid, components, borrow) = match &self.content {
            Content::Owned(image) => (&image.grid, image.components, MW_COPY),
            Content::Borrowed(voxels) => (&voxels.grid, voxels.components, MW_BORROW),
        };
        let (data, kind, stride) = match &self.content {
            Content::Owned(image) => {
                let size = grid.size();
                let stride = [components, components * size[0], components * size[0] * size[1]];
                let data = with_voxels!(&image.data, values => values.as_ptr().cast::<c_void>());
                (data, type_of(&image.data), stride.map(|s| s as i64))
            }
            Content::Borrowed(voxels) => (voxels.data, voxels.kind, voxels.strides.map(|s| s as i64)),
        };
        mw_image_desc {
            struct_size: size_of::<mw_image_desc>(),
            dims: grid.size().map(|d| d as i64),
            spacing: grid.spacing().to_array(),
            origin: grid.origin().to_array(),
            direction: grid.direction().transpose().to_cols_array(),
            data,
            stride,
            r#type: kind,
            borrow,
            space: MW_SPACE_LPS,
            components: components as i32,
        }
    }
}

fn type_of(data: &VoxelData) -> mw_type {
    fn number<T: Stored>(_: &[T]) -> mw_type {
        T::NUMBER
    }
    with_voxels!(data, values => number(values))
}

/// Makes an image of voxels in memory.
///
/// Labels are whole numbers from 0 (background) to 2147483647, of any integer type, or of a floating-point type when
/// every value is whole; that is checked when the image is given to a job as labels.
///
/// @param context  a context
/// @param desc     the description; not kept
/// @param out      receives the image, null after an error; destroy it with mw_image_destroy
/// @return MW_OK, MW_E_ARG (null pointer, struct_size too small, unknown type, size below 1, spacing not finite and
///         positive, singular direction, misaligned data), MW_E_MEMORY
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_image_create(
    context: *mut mw_context,
    desc: *const mw_image_desc,
    out: *mut *mut mw_image,
) -> mw_status {
    let make = || {
        // SAFETY: the C caller's promises about the handle and the struct, whose fields may all be zero.
        let (_, desc) = unsafe { (shared_context(context)?, sized(desc, IMAGE_DESC_SIZE, "desc")?) };
        let voxels = BorrowedVoxels::new(&desc)?;
        let content = match desc.borrow {
            MW_BORROW => Content::Borrowed(voxels),
            _ => Content::Owned(Arc::new(voxels.to_voxel_image()?)),
        };
        Ok(mw_image { content })
    };
    // SAFETY: the C caller's promise about `out`.
    guard(|| unsafe { give(out, make) })
}

/// Reads an image file: NIfTI (.nii, .nii.gz), NRRD (.nrrd, .nhdr) or MetaImage (.mha, .mhd).
///
/// @param context  a context
/// @param path     file name, UTF-8
/// @param out      receives the image, null after an error; destroy it with mw_image_destroy
/// @return MW_OK, MW_E_ARG, MW_E_IO, MW_E_FORMAT (the text says what is wrong with the file), MW_E_UNSUPPORTED,
///         MW_E_MEMORY
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_image_read(
    context: *mut mw_context,
    path: *const c_char,
    out: *mut *mut mw_image,
) -> mw_status {
    let make = || {
        // SAFETY: the C caller's promises about the handle and the string.
        let (_, path) = unsafe { (shared_context(context)?, self::path(path)?) };
        Ok(mw_image::owned(Arc::new(io::read_image(&path)?)))
    };
    // SAFETY: the C caller's promise about `out`.
    guard(|| unsafe { give(out, make) })
}

/// Writes an image in the format of the file's name. The file appears whole or not at all.
///
/// @param image  an image
/// @param path   file name, UTF-8, ending as in mw_image_read
/// @return MW_OK, MW_E_ARG, MW_E_IO, MW_E_UNSUPPORTED (unknown ending), MW_E_MEMORY
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_image_write(image: *const mw_image, path: *const c_char) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promises about the handle and the string.
        let (image, path) = unsafe { (borrow(image, "image")?, self::path(path)?) };
        io::write_image(image.to_voxel_image()?.as_ref(), &path)
    })
}

/// Describes an image: its size, place, type and where its voxels are.
///
/// @param image  an image
/// @param out    receives the description; set its struct_size before. `data` stays valid until mw_image_destroy and
///               must not be written
/// @return MW_OK, MW_E_ARG (null pointer, struct_size too small)
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_image_describe(image: *const mw_image, out: *mut mw_image_desc) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promises about the handle and the struct.
        unsafe { write_sized(out, &borrow(image, "image")?.describe(), IMAGE_DESC_SIZE, "out") }
    })
}

/// Destroys an image; null is allowed. Jobs that were given the image keep what they need of it.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_image_destroy(image: *mut mw_image) {
    guard(|| {
        // SAFETY: the C caller's promise about the handle.
        unsafe { destroy(image) };
        Ok(())
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::index::Label;

    fn desc(data: &[i16]) -> mw_image_desc {
        mw_image_desc {
            struct_size: IMAGE_DESC_SIZE,
            dims: [2, 3, 1],
            spacing: [1.0, 2.0, 3.0],
            origin: [10.0, 20.0, 30.0],
            direction: [0.0; 9],
            data: data.as_ptr().cast(),
            stride: [0; 3],
            r#type: MW_TYPE_I16,
            borrow: MW_BORROW,
            space: 0,
            components: 0,
        }
    }

    #[test]
    fn strides_and_types_of_the_host_are_followed() {
        let data = [1i16, 2, 3, 4, 5, 6];
        let voxels = BorrowedVoxels::new(&mw_image_desc { stride: [3, 1, 0], ..desc(&data) }).unwrap();
        assert_eq!(voxels.to_voxel_image().unwrap().data, VoxelData::I16(vec![1, 4, 2, 5, 3, 6]));
        assert_eq!(voxels.to_label_image().unwrap().voxels(), [1, 4, 2, 5, 3, 6].map(Label));
        let last =
            BorrowedVoxels::new(&mw_image_desc { stride: [-1, -2, 0], data: data[5..].as_ptr().cast(), ..desc(&data) })
                .unwrap();
        assert_eq!(last.to_label_image().unwrap().voxels(), [6, 5, 4, 3, 2, 1].map(Label));
        assert_eq!(last.to_voxel_image().unwrap().data, VoxelData::I16(vec![6, 5, 4, 3, 2, 1]));
    }

    #[test]
    fn ras_geometry_is_turned_to_lps() {
        let data = [1i16; 6];
        let voxels = BorrowedVoxels::new(&mw_image_desc { space: MW_SPACE_RAS, ..desc(&data) }).unwrap();
        assert_eq!(voxels.grid.origin(), DVec3::new(-10.0, -20.0, 30.0));
        assert_eq!(voxels.grid.index_to_world(DVec3::ONE), DVec3::new(-11.0, -22.0, 33.0));
    }

    #[test]
    fn unusable_descriptions_are_refused() {
        let data = [1i16; 6];
        let good = desc(&data);
        let bad = [
            mw_image_desc { dims: [0, 3, 1], ..good },
            mw_image_desc { dims: [-2, 3, 1], ..good },
            mw_image_desc { dims: [i64::MAX, i64::MAX, 2], ..good },
            mw_image_desc { spacing: [1.0, 0.0, 1.0], ..good },
            mw_image_desc { spacing: [1.0, f64::NAN, 1.0], ..good },
            mw_image_desc { direction: [1.0; 9], ..good },
            mw_image_desc { data: std::ptr::null(), ..good },
            mw_image_desc { data: data.as_ptr().cast::<u8>().wrapping_add(1).cast(), ..good },
            mw_image_desc { r#type: 0, ..good },
            mw_image_desc { r#type: 11, ..good },
            mw_image_desc { borrow: 2, ..good },
            mw_image_desc { space: 3, ..good },
            mw_image_desc { components: -1, ..good },
            mw_image_desc { stride: [i64::MAX, 1, 1], ..good },
        ];
        for (i, desc) in bad.iter().enumerate() {
            assert!(BorrowedVoxels::new(desc).is_err(), "number {i}");
        }
    }
}
