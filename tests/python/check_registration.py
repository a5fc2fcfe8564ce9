"""The registration beside SimpleITK: its resampling through our displacement field gives our warped scan, and its demons
registration of the same scans gives a table to compare with: ours, peer, agreement.

Usage: check_registration.py MESHWRIGHT_BINARY       (needs numpy, SimpleITK)
"""
import os, subprocess, sys, tempfile

import numpy as np
import SimpleITK as sitk

BINARY = os.path.abspath(sys.argv[1])
FOLDER = tempfile.mkdtemp()
SIZE = 52
SPACING, ORIGIN = (1.0, 1.1, 1.2), (-20.0, 12.0, 7.0)
# Left-handed and turned about the third axis, so that a mix-up of frames shows.
ANGLE = 0.3
DIRECTION = np.array([[np.cos(ANGLE), -np.sin(ANGLE), 0], [np.sin(ANGLE), np.cos(ANGLE), 0], [0, 0, -1.0]])


def path(name):
    return os.path.join(FOLDER, name)


def image(values):
    result = sitk.GetImageFromArray(values.transpose(2, 1, 0))
    result.SetSpacing(SPACING), result.SetOrigin(ORIGIN), result.SetDirection(DIRECTION.ravel().tolist())
    return result


def scan(local):
    """Tissue with texture in a ball about the middle of the image; `local` are millimetres from there."""
    x, y, z = local[..., 0], local[..., 1], local[..., 2]
    texture = 100 + 30 * np.sin(0.55 * x + 0.2 * y) * np.cos(0.45 * y - 0.3 * z) + 25 * np.sin(0.6 * z + 0.3 * x)
    inside = np.linalg.norm(local, axis=-1) < RADIUS
    return np.where(inside, texture, 0.0), inside


index = np.stack(np.meshgrid(*[np.arange(SIZE)] * 3, indexing="ij"), axis=-1)
local = (index - (SIZE - 1) / 2) * SPACING  # along the axes of the image
RADIUS = 0.43 * SIZE
# A point of the fixed scan was `shift` further in the moving scan: up to 3 mm along the first axis, growing along the third.
shift = np.zeros(local.shape)
shift[..., 0] = 1.5 + 1.5 * local[..., 2] / RADIUS
moving, tissue = scan(local)
fixed, fixed_tissue = scan(local + shift)
for name, values in (("moving", moving.astype(np.float32)), ("fixed", fixed.astype(np.float32)), ("labels", tissue.astype(np.uint8))):
    sitk.WriteImage(image(values), path(name + ".nrrd"))
truth = shift @ DIRECTION.T  # LPS
inner = fixed_tissue & (np.linalg.norm(local, axis=-1) < 0.8 * RADIUS)


def mean_error(field):
    return np.linalg.norm(field - truth, axis=-1)[inner].mean()


subprocess.run([BINARY, "register", "--quiet", "--moving-image", path("moving.nrrd"), "--fixed-image", path("fixed.nrrd"), "--segmented-image", path("labels.nrrd"),
                "--tumor-resection", "off", "--output-deformation-field", path("field.nrrd"), "--output-image", path("warped.nrrd")], check=True)
field = sitk.ReadImage(path("field.nrrd"), sitk.sitkVectorFloat64)
ours = sitk.GetArrayFromImage(field).transpose(2, 1, 0, 3)

scans = [sitk.ReadImage(path(name + ".nrrd"), sitk.sitkFloat32) for name in ("fixed", "moving")]
demons = sitk.FastSymmetricForcesDemonsRegistrationFilter()
demons.SetNumberOfIterations(60), demons.SetStandardDeviations(2.0)
theirs = sitk.GetArrayFromImage(demons.Execute(*scans)).transpose(2, 1, 0, 3)

transform = sitk.DisplacementFieldTransform(sitk.Image(field))
resampled = sitk.GetArrayFromImage(sitk.Resample(scans[1], scans[0], transform, sitk.sitkLinear, 0.0)).transpose(2, 1, 0)
warped = sitk.GetArrayFromImage(sitk.ReadImage(path("warped.nrrd"), sitk.sitkFloat32)).transpose(2, 1, 0)
difference = np.abs(resampled - warped)[inner].max()

errors = mean_error(np.zeros_like(ours)), mean_error(ours), mean_error(theirs)
apart = np.linalg.norm(ours - theirs, axis=-1)[inner].mean()
print(f"{'a ball of texture, sheared':44} {'Meshwright':>12} {'ITK demons':>12}")
print(f"{'mean error in the tissue, mm (before: %.3f)' % errors[0]:44} {errors[1]:12.3f} {errors[2]:12.3f}")
print(f"{'mean distance of the two fields, mm':44} {apart:12.3f}")
print(f"{'largest difference of warped scan, ITK resample':44} {difference:9.4f} of {moving.max():.0f}")
assert difference < 0.5, "the warped scan is not the moving scan through the field as ITK applies it"
assert errors[1] < 0.35 * errors[0] and errors[1] < 1.5 * errors[2] + 0.1
assert apart < errors[1] + errors[2] + 1e-9
print("agree")
