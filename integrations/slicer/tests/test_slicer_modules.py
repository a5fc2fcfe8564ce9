"""The binary as 3D Slicer's command-line modules, through Slicer's real module logic; skipped where the wheel is missing."""

import os
import pathlib
import sys

import numpy as np
import pytest

pytest.importorskip("slicer_core")
vtk = pytest.importorskip("vtk")
from vtk.util.numpy_support import numpy_to_vtk, vtk_to_numpy  # noqa: E402

sys.path.insert(0, os.path.dirname(__file__))
sys.path.insert(0, str(pathlib.Path(__file__).parents[1]))
import slicer_core as slicer  # noqa: E402
from MeshwrightLib import command_line, results  # noqa: E402
from slicer_cli import SlicerModule  # noqa: E402

MODULES = {"MeshwrightImageToMesh": "image", "MeshwrightSurfaceToMesh": "plc", "MeshwrightRegister": "moving-image"}


@pytest.fixture(scope="session")
def modules(tmp_path_factory):
    """The binary under the three module names, as the extension installs it."""
    binary = os.environ.get("MESHWRIGHT_EXECUTABLE")
    if not binary:
        pytest.skip("MESHWRIGHT_EXECUTABLE names no binary")
    folder = tmp_path_factory.mktemp("cli-modules")
    for name in MODULES:
        os.symlink(os.path.abspath(binary), folder / name)
    return folder


def ball_volume(size, center, radius, spacing, origin, directions):
    """A label map node with a ball, in RAS; `directions` are the rows of an IJK to RAS direction matrix."""
    grid = np.stack(np.meshgrid(*[np.arange(n) for n in size], indexing="ij"), axis=-1).astype(float)
    world = np.asarray(origin) + (grid * spacing) @ np.asarray(directions).T
    inside = np.linalg.norm(world - np.asarray(center), axis=-1) < radius
    data = vtk.vtkImageData()
    data.SetDimensions(*size)
    data.GetPointData().SetScalars(numpy_to_vtk(inside.astype(np.uint8).ravel(order="F"), deep=True))
    node = slicer.vtkMRMLLabelMapVolumeNode()
    node.SetAndObserveImageData(data)
    node.SetSpacing(*spacing)
    node.SetOrigin(*origin)
    node.SetIJKToRASDirections(*np.asarray(directions).ravel())
    return node


def parameter(module, name):
    """Slicer's name of a parameter."""
    plain = name.replace("-", "").replace("_", "").lower()
    return next(n for n in command_line.parameter_names(module.node) if n.replace("-", "").replace("_", "").lower() == plain)


def image_module(modules, **ball):
    module = SlicerModule(str(modules / "MeshwrightImageToMesh"))
    module.labels = module.add(ball_volume(**ball))
    module.mesh = module.add(slicer.vtkMRMLModelNode())
    module.node.SetParameterAsNode(parameter(module, "image"), module.labels)
    module.node.SetParameterAsNode(parameter(module, "output"), module.mesh)
    return module


CENTERED = dict(size=(36, 34, 30), center=(5.0, -12.0, 40.0), radius=11.0)
ORIENTATIONS = {
    "plain": dict(spacing=(1.0, 1.0, 1.0), origin=(-13.0, -29.0, 25.0), directions=np.eye(3)),
    "reflected": dict(spacing=(1.0, 1.1, 1.2), origin=(23.0, 6.0, 22.0), directions=np.diag([-1.0, -1.0, 1.0])),
    "left-handed": dict(spacing=(1.0, 1.0, 1.0), origin=(23.0, -29.0, 25.0), directions=np.diag([-1.0, 1.0, 1.0])),
    "swapped": dict(spacing=(1.0, 1.0, 1.0), origin=(-10.0, -30.0, 24.0), directions=np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])),
}


@pytest.mark.parametrize("name", MODULES)
def test_slicers_parser_takes_the_xml(modules, name):
    module = SlicerModule(str(modules / name))
    assert parameter(module, MODULES[name])
    module.close()


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_the_mesh_comes_back_where_the_volume_is(modules, orientation):
    module = image_module(modules, **CENTERED, **ORIENTATIONS[orientation])
    states = module.run()
    assert states[-1][0] == "Completed", module.node.GetErrorText()
    mesh = module.mesh.GetMesh()
    assert results.labels_of(mesh) == [1]
    points = vtk_to_numpy(mesh.GetPoints().GetData())
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    assert np.allclose(middle, CENTERED["center"], atol=1.0)
    assert np.allclose(points.max(axis=0) - points.min(axis=0), 2 * CENTERED["radius"], atol=2.0)
    assert min(results.minimum_dihedral_angles(mesh)) > 5.0
    assert sum(count for _, _, count in results.dihedral_histogram(mesh)) == mesh.GetNumberOfCells()
    assert sum(part.GetNumberOfCells() for part in results.split_by_label(mesh).values()) == mesh.GetNumberOfCells()
    module.close()


def test_progress_moves_forward(modules):
    module = image_module(modules, **CENTERED, **ORIENTATIONS["plain"])
    command_line.set_cli_parameters(module.node, {"lattice-spacing": 1.5, "fidelity": 0.97})
    states = module.run()
    percents = [percent for status, percent in states if status == "Running"]
    assert percents == sorted(percents) and max(percents) > 0, states
    module.close()


def test_cancel_leaves_no_file(modules):
    module = image_module(modules, **CENTERED, **ORIENTATIONS["plain"])
    command_line.set_cli_parameters(module.node, {"lattice-spacing": 0.25, "max-element-size": 0.3})
    states = module.run(cancel_at=0)
    assert states[-1][0] == "Cancelled"
    assert module.mesh.GetMesh() is None or module.mesh.GetMesh().GetNumberOfCells() == 0
    assert not [f for f in os.listdir(module.folder) if f.endswith((".vtk", ".vtu"))]
    module.close()


def test_an_error_reaches_the_user(modules):
    module = image_module(modules, size=(8, 8, 8), center=(100.0, 100.0, 100.0), radius=1.0, **ORIENTATIONS["plain"])
    states = module.run()
    assert states[-1][0] == "Completed with errors"
    assert "label" in module.node.GetErrorText().lower() or "foreground" in module.node.GetErrorText().lower()
    module.close()


def test_an_unknown_parameter_is_refused():
    class Node:
        def GetNumberOfParameterGroups(self):
            return 1

        def GetNumberOfParametersInGroup(self, _group):
            return 1

        def GetParameterName(self, _group, _index):
            return "fidelity"

    with pytest.raises(ValueError, match="latice"):
        command_line.set_cli_parameters(Node(), {"latice-spacing": 3})


def test_the_smallest_dihedral_angle_is_that_of_known_tetrahedra():
    grid, points = vtk.vtkUnstructuredGrid(), vtk.vtkPoints()
    points.SetDataTypeToDouble()
    # A regular one, the corner of a cube, and one of 120 degrees at its edge 02, where vtkMeshQuality takes 60.
    half, root = np.sqrt(0.75), np.sqrt(2.0 / 3.0)
    shapes = [
        [(0, 0, 0), (1, 0, 0), (0.5, half, 0), (0.5, half / 3, root)],
        [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)],
        [(0, 0, 0), (2, 0, 1), (0, 0, 2), (-1, 2 * half, 1)],
    ]
    grid.SetPoints(points)
    for shape in shapes:
        corners = [points.InsertNextPoint(point) for point in shape]
        grid.InsertNextCell(vtk.VTK_TETRA, 4, corners)
    grid.InsertNextCell(vtk.VTK_TRIANGLE, 3, [0, 1, 2])
    angles = results.minimum_dihedral_angles(grid)
    assert np.allclose(angles[:2], np.degrees([np.arccos(1 / 3), np.arccos(1 / np.sqrt(3))]), atol=1e-9)
    a, b, c, d = (np.array(point, float) for point in shapes[2])
    normals = [np.cross(q - p, r - p) for p, q, r in ((b, c, d), (a, d, c), (a, b, d), (a, c, b))]
    cosines = [-np.dot(m, n) / np.linalg.norm(m) / np.linalg.norm(n) for k, m in enumerate(normals) for n in normals[:k]]
    assert len(angles) == 3 and np.isclose(angles[2], np.degrees(np.arccos(max(cosines))), atol=1e-9)


def test_per_label_values_are_sorted():
    merged = command_line.parameters_of({"fidelity": 0.8}, {"lattice-spacing": None}, {"fidelity": {3: 0.9, 1: 0.75}})
    assert merged == {"fidelity": 0.8, "fidelity-for": "1=0.75,3=0.9"}


def test_a_surface_keeps_its_triangles(modules):
    source = vtk.vtkSphereSource()
    source.SetRadius(10)
    source.SetCenter(3, 4, 5)
    source.SetThetaResolution(16)
    source.SetPhiResolution(12)
    source.Update()
    module = SlicerModule(str(modules / "MeshwrightSurfaceToMesh"))
    surface, mesh = module.add(slicer.vtkMRMLModelNode()), module.add(slicer.vtkMRMLModelNode())
    surface.SetAndObserveMesh(source.GetOutput())
    module.node.SetParameterAsNode(parameter(module, "plc"), surface)
    module.node.SetParameterAsNode(parameter(module, "output"), mesh)
    states = module.run()
    assert states[-1][0] == "Completed", module.node.GetErrorText()
    faces = {
        frozenset(mesh.GetMesh().GetCell(c).GetFace(f).GetPointId(v) for v in range(3))
        for c in range(mesh.GetMesh().GetNumberOfCells())
        for f in range(4)
    }
    points = {tuple(np.round(mesh.GetMesh().GetPoint(i), 3)): i for i in range(mesh.GetMesh().GetNumberOfPoints())}
    for cell in range(source.GetOutput().GetNumberOfCells()):
        triangle = source.GetOutput().GetCell(cell)
        corners = [points[tuple(np.round(source.GetOutput().GetPoint(triangle.GetPointId(v)), 3))] for v in range(3)]
        assert frozenset(corners) in faces
    module.close()
