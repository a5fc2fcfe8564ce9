"""Images against SimpleITK and nibabel: our reader places every voxel where SimpleITK does, and both read what we write.

Usage: check_images.py MESHWRIGHT_BINARY       (needs numpy, SimpleITK, nibabel)
"""
import itertools, json, os, subprocess, sys, tempfile

import nibabel as nib
import numpy as np
import SimpleITK as sitk

BINARY = os.path.abspath(sys.argv[1])
FOLDER = tempfile.mkdtemp()
rng = np.random.default_rng(7)


def info(path):
    return json.loads(subprocess.run([BINARY, "info", path, "--json"], capture_output=True, text=True, check=True).stdout)


def rotation(axis, angle):
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


GEOMETRIES = [
    ((1.0, 1.0, 1.0), (0, 0, 0), np.eye(3)),
    ((0.7, 1.1, 2.5), (-12.5, 30.25, 7), rotation((1, 2, 3), 0.7)),
    ((0.5, 0.5, 3.0), (5, -6, 7), rotation((0, 1, 1), -1.9) @ np.diag([1, 1, -1])),
    ((2.0, 0.3, 0.9), (100, 200, -300), np.diag([-1.0, -1.0, 1.0])),
    ((1.0, 2.0, 3.0), (0, 0, 1), np.eye(3)[:, [1, 2, 0]]),
    ((1.0, 2.0, 3.0), (0, 0, 1), np.eye(3)[:, [1, 0, 2]]),
]
TYPES = [np.uint8, np.int8, np.uint16, np.int16, np.uint32, np.int32, np.uint64, np.int64, np.float32, np.float64]


def make(index, dtype, components=1):
    spacing, origin, direction = GEOMETRIES[index]
    shape = (4, 5, 6) if components == 1 else (4, 5, 6, components)
    data = rng.integers(0, 100, shape).astype(dtype)
    image = sitk.GetImageFromArray(data, isVector=components > 1)
    image.SetSpacing(spacing), image.SetOrigin(origin), image.SetDirection(direction.ravel().tolist())
    return image, data


def agree(path, tolerance):
    """Our geometry of a file against SimpleITK's."""
    ours, theirs = info(path), sitk.ReadImage(path)
    matrix = np.array(ours["direction"]) * np.array(ours["spacing"])
    assert ours["size"] == list(theirs.GetSize()), path
    for index in itertools.product((0, 3), (0, 4), (0, 2)):
        point = np.array(ours["origin"]) + matrix @ np.array(index, float)
        error = np.abs(point - theirs.TransformIndexToPhysicalPoint(index)).max()
        assert error < tolerance, f"{path}: voxel {index} is {error} mm off"


def same(path, data, components=1):
    theirs = sitk.ReadImage(path)
    assert theirs.GetNumberOfComponentsPerPixel() == components, path
    assert np.array_equal(sitk.GetArrayFromImage(theirs).astype(float), data.astype(float)), path


checked = 0
for g, dtype in itertools.product(range(len(GEOMETRIES)), TYPES):
    image, data = make(g, dtype)
    for source in ("nii", "nii.gz", "nrrd", "nhdr", "mha", "mhd"):
        if g > 0 and dtype not in (np.uint8, np.int16, np.float32):
            continue
        path = os.path.join(FOLDER, f"a.{source}")
        sitk.WriteImage(image, path, useCompression=bool(g % 2))
        tolerance = 2e-4 if "nii" in source else 1e-9
        agree(path, tolerance)
        for target in ("nii", "nii.gz", "nrrd", "nhdr", "mha", "mhd"):
            out = os.path.join(FOLDER, f"b.{target}")
            subprocess.run([BINARY, "convert", path, out], check=True)
            agree(out, 2e-4)
            same(out, data)
            checked += 1
            if target.startswith("nii"):
                loaded = nib.load(out)
                assert np.array_equal(np.asarray(loaded.dataobj).transpose(2, 1, 0), data)
                want = np.diag([-1, -1, 1]) @ np.array(image.GetDirection()).reshape(3, 3) * np.array(image.GetSpacing())
                assert np.allclose(loaded.affine[:3, :3], want, atol=1e-5)

for g in range(3):
    image, data = make(g, np.float32, 3)
    for source, target in itertools.product(("nii.gz", "nrrd", "mha"), repeat=2):
        path, out = os.path.join(FOLDER, f"v.{source}"), os.path.join(FOLDER, f"w.{target}")
        sitk.WriteImage(image, path)
        subprocess.run([BINARY, "convert", path, out], check=True)
        same(out, data, 3)
        agree(out, 2e-4)
        checked += 1
    assert nib.load(os.path.join(FOLDER, "w.nii.gz")).header["intent_code"] == 1006

# NIfTI written by nibabel: sform only, qform only, neither; scaling; big-endian; NIfTI-2; pairs.
affine = np.diag([-1, -1, 1, 1.0]) @ np.block([[rotation((1, 2, 3), 0.7) * [0.7, 1.1, 2.5], np.array([[3.0], [4], [5]])], [np.zeros((1, 3)), np.ones((1, 1))]])
data = rng.integers(0, 50, (4, 5, 6)).astype(np.int16)
for kind, codes in itertools.product((nib.Nifti1Image, nib.Nifti2Image), ((1, 0), (0, 1), (2, 1), (0, 0))):
    image = kind(data, affine)
    image.set_sform(affine, codes[0]), image.set_qform(affine, codes[1])
    path = os.path.join(FOLDER, "n.nii")
    image.to_filename(path)
    if kind is nib.Nifti1Image:
        agree(path, 2e-4)
    elif codes != (0, 0):  # SimpleITK does not read NIfTI-2
        ours, lps = info(path), np.diag([-1, -1, 1]) @ affine[:3]
        assert np.allclose(np.array(ours["direction"]) * ours["spacing"], lps[:, :3], atol=1e-5)
        assert np.allclose(ours["origin"], lps[:, 3], atol=1e-5)
image = nib.Nifti1Image(data, affine)
big = nib.Nifti1Image(data, affine, nib.Nifti1Header(endianness=">"))
assert big.header.endianness == ">"
big.to_filename(os.path.join(FOLDER, "big.nii"))
agree(os.path.join(FOLDER, "big.nii"), 2e-4)
subprocess.run([BINARY, "convert", FOLDER + "/big.nii", FOLDER + "/c.nrrd"], check=True)
assert np.array_equal(sitk.GetArrayFromImage(sitk.ReadImage(FOLDER + "/c.nrrd")).transpose(2, 1, 0), data)
nib.Nifti1Pair(data, affine).to_filename(FOLDER + "/pair.img")
for name in ("pair.img", "pair.hdr"):
    subprocess.run([BINARY, "convert", f"{FOLDER}/{name}", FOLDER + "/c.nrrd"], check=True)
    assert np.array_equal(sitk.GetArrayFromImage(sitk.ReadImage(FOLDER + "/c.nrrd")).transpose(2, 1, 0), data)
image.header.set_slope_inter(0.5, 3)
image.to_filename(FOLDER + "/scaled.nii")
subprocess.run([BINARY, "convert", FOLDER + "/scaled.nii", FOLDER + "/c.mha"], check=True)
assert np.allclose(sitk.GetArrayFromImage(sitk.ReadImage(FOLDER + "/c.mha")), sitk.GetArrayFromImage(sitk.ReadImage(FOLDER + "/scaled.nii")))

# Big-endian MetaImage, text MetaImage, text NRRD, spaces of NRRD.
header = "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = True\nDimSize = 6 5 4\nElementSpacing = 1 2 3\nElementType = MET_SHORT\nElementDataFile = LOCAL\n"
raw = rng.integers(0, 50, (4, 5, 6)).astype(">i2")
open(FOLDER + "/m.mha", "wb").write(header.encode() + raw.tobytes())
subprocess.run([BINARY, "convert", FOLDER + "/m.mha", FOLDER + "/c.nrrd"], check=True)
same(FOLDER + "/c.nrrd", raw)
for space in ("left-posterior-superior", "right-anterior-superior", "left-anterior-superior", "RAS"):
    text = f"NRRD0004\n# x\ntype: short\ndimension: 3\nspace: {space}\nsizes: 6 5 4\nspace directions: (0,1.5,0) (1,0,0) (0,0.1,-2)\nkinds: domain domain domain\nendian: big\nencoding: raw\nspace origin: (1,2,3)\n\n"
    open(FOLDER + "/s.nrrd", "wb").write(text.encode() + raw.tobytes())
    agree(FOLDER + "/s.nrrd", 1e-9)
    subprocess.run([BINARY, "convert", FOLDER + "/s.nrrd", FOLDER + "/c.mha"], check=True)
    same(FOLDER + "/c.mha", raw)
text = "NRRD0004\ntype: short\ndimension: 3\nsizes: 6 5 4\nspacings: 1 2 3\nencoding: ascii\n\n" + " ".join(str(v) for v in raw.ravel()) + "\n"
open(FOLDER + "/t.nrrd", "w").write(text)
agree(FOLDER + "/t.nrrd", 1e-9)
subprocess.run([BINARY, "convert", FOLDER + "/t.nrrd", FOLDER + "/c.mha"], check=True)
same(FOLDER + "/c.mha", raw)
print(f"images: {checked} conversions agree with SimpleITK and nibabel")
