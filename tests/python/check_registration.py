"""The registration beside SimpleITK: its resampling through our displacement field gives our warped scan, and its demons
registration of the same scans gives a table to compare with: ours, peer, agreement. Our evaluation figures, Hausdorff distance of
Canny edges and landmark errors, are compared with those of ITK's Canny filter, distance map and transforms.

Usage: check_registration.py MESHWRIGHT_BINARY       (needs numpy, SimpleITK)
"""
import csv, json, os, subprocess, sys, tempfile

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


random = np.random.default_rng(3)
chosen = np.argwhere(inner)[random.permutation(int(inner.sum()))[:40]]
landmarks = [image(moving).TransformIndexToPhysicalPoint(index.tolist()) for index in chosen]
landmarks = [np.concatenate([p, np.array(p) + truth[tuple(index)]]) for p, index in zip(landmarks, chosen)]
with open(path("landmarks.csv"), "w", newline="") as stream:
    csv.writer(stream).writerows(landmarks)

subprocess.run([BINARY, "register", "--quiet", "--moving-image", path("moving.nrrd"), "--fixed-image", path("fixed.nrrd"), "--segmented-image", path("labels.nrrd"),
                "--tumor-resection", "off", "--output-deformation-field", path("field.nrrd"), "--output-image", path("warped.nrrd"), "--hd-evaluation", "on",
                "--landmarks", path("landmarks.csv"), "--json", path("report.json")], check=True)
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



def canny(scan):
    values = sitk.GetArrayFromImage(scan)
    low, high = np.percentile(values[values != 0], [2, 98])
    scaled = sitk.Clamp((scan - float(low)) / float(high - low), sitk.sitkFloat32, 0.0, 1.2)
    return sitk.Cast(sitk.CannyEdgeDetection(scaled, lowerThreshold=0.04, upperThreshold=0.08, variance=[1.5] * 3), sitk.sitkUInt8)


def edge_distances(one, other):
    ours, theirs = canny(one), canny(other)

    def to(edges, of):
        distances = sitk.SignedMaurerDistanceMap(edges, insideIsPositive=False, squaredDistance=False, useImageSpacing=True)
        return np.maximum(sitk.GetArrayFromImage(distances)[sitk.GetArrayFromImage(of) > 0], 0.0)

    forth, back = to(theirs, ours), to(ours, theirs)
    return {"hausdorff": max(forth.max(), back.max()), "hausdorff_95": max(np.percentile(forth, 95), np.percentile(back, 95)),
            "mean": 0.5 * (forth.mean() + back.mean())}


with open(path("report.json")) as stream:
    report = json.load(stream)


def statistic(name):
    value = report["statistics"]
    for part in name.split("."):
        value = value[part]
    return value


print(f"{'evaluation':44} {'Meshwright':>12} {'ITK':>12}")
for name, value in edge_distances(sitk.ReadImage(path("warped.nrrd"), sitk.sitkFloat32), scans[0]).items():
    own = statistic("edges." + name)
    print(f"{'edges.' + name + ', mm':44} {own:12.3f} {value:12.3f}")
    # Two Canny filters differ in single voxels: the largest distance by those, the others hardly.
    assert abs(own - value) < (2.5 * max(SPACING) if name == "hausdorff" else 0.25)
mapped = [np.linalg.norm(np.array(transform.TransformPoint(row[:3].tolist())) - row[3:]) for row in np.array(landmarks)]
for name, value in (("mean", np.mean(mapped)), ("max", np.max(mapped))):
    print(f"{'landmarks.' + name + ', mm':44} {statistic('landmarks.' + name):12.5f} {value:12.5f}")
    assert abs(statistic("landmarks." + name) - value) < 1e-4

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
