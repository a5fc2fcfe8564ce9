"""Displacement fields of every format beside SimpleITK and VTK: both move points where `meshwright warp` does, to 1e-4 mm.

Usage: check_warp.py MESHWRIGHT_BINARY       (needs numpy, SimpleITK, vtk)
"""
import os, subprocess, sys, tempfile

import numpy as np
import SimpleITK as sitk
import vtk
from vtk.util.numpy_support import numpy_to_vtk, vtk_to_numpy

BINARY = os.path.abspath(sys.argv[1])
FOLDER = tempfile.mkdtemp()
SIZE, SPACING, ORIGIN = (30, 28, 26), (1.5, 1.4, 2.0), (-20.0, 12.0, 7.0)
TOLERANCE = 1e-4
rng = np.random.default_rng(3)


def path(name):
    return os.path.join(FOLDER, name)


def image(values, direction):
    result = sitk.GetImageFromArray(values.transpose(2, 1, 0))
    result.SetSpacing(SPACING), result.SetOrigin(ORIGIN), result.SetDirection(direction.ravel().tolist())
    return result


def register(direction, field):
    """Two scans of a textured ball, one of them moved, and the field between them."""
    index = np.stack(np.meshgrid(*[np.arange(n) for n in SIZE], indexing="ij"), axis=-1)
    local = (index - (np.array(SIZE) - 1) / 2) * SPACING

    def scan(p):
        texture = 100 + 30 * np.sin(0.5 * p[..., 0]) * np.cos(0.4 * p[..., 1]) + 25 * np.sin(0.45 * p[..., 2] + 0.2 * p[..., 0])
        return np.where(np.linalg.norm(p, axis=-1) < 17, texture, 0).astype(np.float32)

    moved = local + np.array([1.0, -0.5, 0.8]) + 0.05 * local[..., [1, 2, 0]]
    for name, values in (("fixed", scan(moved)), ("moving", scan(local)), ("labels", (scan(local) > 0).astype(np.uint8))):
        sitk.WriteImage(image(values, direction), path(name + ".nrrd"))
    subprocess.run([BINARY, "register", "--quiet", "--moving-image", path("moving.nrrd"), "--fixed-image", path("fixed.nrrd"),
                    "--segmented-image", path("labels.nrrd"), "--num-adaptive-iterations", "2", "--output-deformation-field", field], check=True)


def points_inside(field, count=200):
    """Random points that no interpolation has to leave the grid for."""
    index = 1 + rng.random((count, 3)) * (np.array(SIZE) - 3)
    return np.array([field.TransformContinuousIndexToPhysicalPoint(i.tolist()) for i in index])


def ours(points, field):
    np.savetxt(path("points.csv"), points, delimiter=",", fmt="%.17g", header="x,y,z", comments="")
    subprocess.run([BINARY, "warp", path("points.csv"), path("moved.csv"), "--field", field, "--to-moving"], check=True)
    return np.loadtxt(path("moved.csv"), delimiter=",", skiprows=1)


def by_simpleitk(points, field):
    transform = sitk.DisplacementFieldTransform(sitk.Image(field))
    return np.array([transform.TransformPoint(p.tolist()) for p in points])


def by_vtk_grid(points, file):
    """vtkGridTransform reads axis-aligned fields only."""
    reader = vtk.vtkMetaImageReader()
    reader.SetFileName(file)
    transform = vtk.vtkGridTransform()
    transform.SetDisplacementGridConnection(reader.GetOutputPort())
    return np.array([transform.TransformPoint(p.tolist()) for p in points])


def by_vtk_mesh(points, field):
    """A mesh that `warp` moved, as VTK reads it."""
    cloud = vtk.vtkPoints()
    cloud.SetDataTypeToDouble()
    cloud.SetData(numpy_to_vtk(np.ascontiguousarray(points), deep=True))
    grid = vtk.vtkUnstructuredGrid()
    grid.SetPoints(cloud)
    for first in range(0, len(points) - 3, 4):
        corners = list(range(first, first + 4))
        a, b, c, d = points[corners]
        if np.dot(np.cross(b - a, c - a), d - a) < 0:
            corners[2], corners[3] = corners[3], corners[2]
        grid.InsertNextCell(vtk.VTK_TETRA, 4, corners)
    writer = vtk.vtkXMLUnstructuredGridWriter()
    writer.SetFileName(path("mesh.vtu")), writer.SetInputData(grid), writer.Write()
    subprocess.run([BINARY, "warp", path("mesh.vtu"), path("moved.vtu"), "--field", field, "--to-moving"], check=True)
    reader = vtk.vtkXMLUnstructuredGridReader()
    reader.SetFileName(path("moved.vtu")), reader.Update()
    return vtk_to_numpy(reader.GetOutput().GetPoints().GetData()).astype(float)


turned = np.array([[np.cos(0.4), -np.sin(0.4), 0], [np.sin(0.4), np.cos(0.4), 0], [0, 0, -1.0]])
for direction, extension in ((np.eye(3), ".mha"), (turned, ".nrrd"), (turned, ".nii.gz"), (turned, ".mha")):
    file = path("field" + extension)
    register(direction, file)
    field = sitk.ReadImage(file, sitk.sitkVectorFloat64)
    points = points_inside(field)
    expected = by_simpleitk(points, field)
    assert np.linalg.norm(expected - points, axis=1).mean() > 0.3, "the field moves something"
    found = {"warp": ours(points, file), "VTK, moved mesh": by_vtk_mesh(points, file)}
    if extension == ".mha" and np.array_equal(direction, np.eye(3)):
        found["vtkGridTransform"] = by_vtk_grid(points, file)
    for name, moved in found.items():
        worst = np.abs(moved - expected).max()
        print(f"{extension:8} {name:18} {worst:.1e} mm from SimpleITK")
        assert worst < TOLERANCE, f"{name}, {extension}"
print("agree")
