"""The panels of the scripted modules, with real MRML nodes and fake widgets: what bad input tells the user, that no node is left
behind, that the panel works again after, and that good input reaches the command-line module."""

import importlib.util
import os
import pathlib
import re
import subprocess
import sys
from xml.etree import ElementTree

import numpy as np
import pytest

pytest.importorskip("slicer_core")
vtk = pytest.importorskip("vtk")
from vtk.util.numpy_support import numpy_to_vtk  # noqa: E402

ROOT = pathlib.Path(__file__).parents[1]
sys.path[:0] = [os.path.dirname(__file__), str(ROOT)]
import slicer_fakes  # noqa: E402

MESSAGES = slicer_fakes.install()
import slicer  # noqa: E402
from MeshwrightLib import checks, command_line  # noqa: E402


class Runner:
    """Stands for the command-line module: remembers what it was started with."""

    def __init__(self):
        self.started = []

    def is_busy(self):
        return False

    def start(self, nodes, parameters):
        self.started.append((nodes, parameters))


def panel(name):
    """The widget of a module, set up in an empty scene."""
    spec = importlib.util.spec_from_file_location(name, ROOT / name / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    slicer.mrmlScene.Clear()
    MESSAGES.clear()
    widget = getattr(module, name + "Widget")()
    widget.setup()
    widget.runner = Runner()
    return widget


def node(class_name, name):
    new = getattr(slicer, class_name)()
    new.SetName(name)
    return slicer.mrmlScene.AddNode(new)


def image(*size):
    data = vtk.vtkImageData()
    data.SetDimensions(*size)
    data.GetPointData().SetScalars(numpy_to_vtk(np.ones(int(np.prod(size)), np.uint8), deep=True))
    return data


def volume(name, size=(4, 4, 4), class_name="vtkMRMLScalarVolumeNode"):
    result = node(class_name, name)
    if size:
        result.SetAndObserveImageData(image(*size))
    return result


def refuses(widget, words):
    """Apply shows one message with `words`, starts nothing and leaves the scene as it was."""
    before = slicer.mrmlScene.GetNumberOfNodes()
    MESSAGES.clear()
    widget.on_apply()
    assert len(MESSAGES) == 1 and words in MESSAGES[0], MESSAGES
    assert not widget.runner.started
    assert slicer.mrmlScene.GetNumberOfNodes() == before


def test_the_modules_describe_themselves():
    for name in ("MeshwrightImageMesher", "MeshwrightSurfaceMesher", "MeshwrightRegistration"):
        spec = importlib.util.spec_from_file_location(name, ROOT / name / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        parent = type("Parent", (), {})()
        getattr(module, name)(parent)
        assert parent.title.startswith("Meshwright: ") and len(parent.helpText) > 80 and parent.categories
        assert (ROOT / name / "Resources" / "Icons" / f"{name}.png").is_file()


def test_the_pictures_that_the_extension_names_are_there():
    listing = (ROOT / "CMakeLists.txt").read_text()
    named = re.findall(r"integrations/slicer/(\S+\.png)", listing)
    assert len(named) == 2 and all((ROOT / name).is_file() for name in named), named


def segmentation_with(widget, *names):
    """A segmentation of balls beside each other, chosen in the panel."""
    result = node("vtkMRMLSegmentationNode", "tissues")
    result.SetAndObserveSegmentation(slicer.vtkSegmentation())
    for index, name in enumerate(names):
        grid = np.stack(np.meshgrid(*[np.arange(24)] * 3, indexing="ij"), axis=-1) - (6.0 + 11 * index, 11.0, 11.0)
        data = slicer.vtkOrientedImageData()
        data.SetDimensions(24, 24, 24)
        inside = (np.linalg.norm(grid, axis=-1) < 5).astype(np.uint8)
        data.GetPointData().SetScalars(numpy_to_vtk(inside.ravel(order="F"), deep=True))
        segment = slicer.vtkSegment()
        segment.SetName(name)
        segment.AddRepresentation("Binary labelmap", data)
        result.GetSegmentation().AddSegment(segment, name)
    widget.segmentation_selector.node = result
    widget.on_input_changed()
    return result


def test_a_segmentation_that_cannot_be_meshed_is_a_message_and_the_panel_lives_on():
    widget = panel("MeshwrightImageMesher")
    refuses(widget, "Choose a segmentation")
    segmentation_with(widget)
    refuses(widget, "'tissues' has no segments")
    widget.segmentation_selector.node = volume("scan")
    widget.table.segment_ids = []
    refuses(widget, "'scan' is not a segmentation")
    segmentation_with(widget, "liver", "tumour")
    for row in (0, 1):
        widget.table.item(row, 0).setCheckState(None)
    refuses(widget, "Tick at least one segment")
    widget.on_input_changed()
    for text in ("high", "0", "1.5", "nan", "-1"):
        widget.table.item(1, 2).words = text
        refuses(widget, f"'{text}' of segment 'tumour'")
    widget.table.item(1, 2).words = "0,95"
    MESSAGES.clear()
    widget.on_apply()
    assert MESSAGES == [], MESSAGES
    nodes, parameters = widget.runner.started[0]
    assert parameters["fidelity-for"] == "2=0.95"
    values = np.unique(vtk.util.numpy_support.vtk_to_numpy(nodes["image"].GetImageData().GetPointData().GetScalars()))
    assert values.tolist() == [0, 1, 2]
    widget.on_finished(False)
    assert widget.labels is None and slicer.mrmlScene.GetFirstNodeByClass("vtkMRMLLabelMapVolumeNode") is None


def test_a_segmentation_under_a_transform_takes_the_mesh_along():
    widget = panel("MeshwrightImageMesher")
    segmentation = segmentation_with(widget, "liver")
    transform = node("vtkMRMLLinearTransformNode", "patient to table")
    segmentation.SetAndObserveTransformNodeID(transform.GetID())
    widget.output_selector.node = node("vtkMRMLModelNode", "mesh")
    widget.on_apply()
    assert len(widget.runner.started) == 1, MESSAGES
    widget.histogram.show_mesh = lambda mesh: None
    sys.modules["MeshwrightLib.widgets"].show_volume_mesh = lambda mesh_node: None
    widget.show_result()
    assert widget.output_selector.node.GetTransformNodeID() == widget.labels.GetTransformNodeID()


def test_a_model_that_is_no_surface_is_a_message():
    widget = panel("MeshwrightSurfaceMesher")
    refuses(widget, "Choose a surface model")
    widget.surface_selector.node = model = node("vtkMRMLModelNode", "heart")
    refuses(widget, "'heart' has no triangles")
    model.SetAndObserveMesh(vtk.vtkUnstructuredGrid())
    refuses(widget, "'heart' is a volume mesh")
    points = vtk.vtkPolyData()
    points.SetPoints(vtk.vtkPoints())
    model.SetAndObserveMesh(points)
    refuses(widget, "'heart' has no triangles")
    widget.surface_selector.node = volume("scan")
    refuses(widget, "'scan' is not a surface model")
    source = vtk.vtkCubeSource()
    source.Update()
    model.SetAndObserveMesh(source.GetOutput())
    widget.surface_selector.node = widget.output_selector.node = model
    refuses(widget, "'heart' is the input")
    widget.output_selector.node = node("vtkMRMLModelNode", "mesh")
    widget.on_apply()
    nodes, _ = widget.runner.started[0]
    assert nodes["plc"].GetPolyData().GetNumberOfPolys() == 12 and nodes["plc"] is not model
    widget.on_finished(False)
    assert slicer.mrmlScene.GetNumberOfNodesByClass("vtkMRMLModelNode") == 2


def test_scans_that_cannot_be_registered_are_a_message():
    widget = panel("MeshwrightRegistration")
    refuses(widget, "Choose the preoperative scan")
    widget.moving.node = volume("before", size=None)
    refuses(widget, "'before' (the preoperative scan) has no voxels")
    widget.moving.node = volume("before", size=(4, 4, 1))
    refuses(widget, "single slice")
    widget.moving.node = volume("before")
    refuses(widget, "Choose the intraoperative scan")
    widget.fixed.node = volume("after")
    widget.labels.node = node("vtkMRMLModelNode", "model")
    refuses(widget, "'model' is not the segmentation")
    widget.labels.node = volume("labels", class_name="vtkMRMLLabelMapVolumeNode")
    widget.warped.node = widget.fixed.node
    refuses(widget, "'after' is the input")
    widget.warped.node = volume("warped", size=None)
    transform = node("vtkMRMLLinearTransformNode", "moved")
    widget.fixed.node.SetAndObserveTransformNodeID(transform.GetID())
    refuses(widget, "'after' is under the transform 'moved'")
    # Without a transform, which is how volumes come, it runs.
    widget.fixed.node.SetAndObserveTransformNodeID(None)
    MESSAGES.clear()
    widget.on_apply()
    assert MESSAGES == [] and set(widget.runner.started[0][0]) == {"moving-image", "fixed-image", "segmented-image", "output-image"}


def test_an_empty_fidelity_means_that_of_the_preset():
    assert checks.fidelity_of("  ", "liver") is None
    assert checks.fidelity_of("0.8", "liver") == 0.8


@pytest.mark.skipif("MESHWRIGHT_EXECUTABLE" not in os.environ, reason="MESHWRIGHT_EXECUTABLE names no binary")
@pytest.mark.parametrize("job", ["image-to-mesh", "surface-to-mesh", "register"])
def test_every_preset_has_values_that_the_module_takes(job):
    xml = subprocess.run([os.environ["MESHWRIGHT_EXECUTABLE"], job, "--xml"], capture_output=True, text=True, check=True).stdout
    known = {e.findtext("name"): e for e in ElementTree.fromstring(xml).iter() if e.findtext("name")}
    presets = {"image-to-mesh": command_line.IMAGE_PRESETS, "surface-to-mesh": command_line.SURFACE_PRESETS, "register": command_line.REGISTRATION_PRESETS}
    panels = {"image-to-mesh": {"lattice-spacing": 2.0, "fidelity": 0.9}, "surface-to-mesh": {"size-limit": 2.0}, "register": {}}
    for name, value in [item for values in [*presets[job].values(), panels[job]] for item in values.items()]:
        element = known[name.replace("-", "_")]
        choices = [e.text for e in element.findall("element")]
        if element.tag == "boolean":
            assert isinstance(value, bool), name
        elif choices:
            assert value in choices, name
        else:
            low, high = (element.find("constraints").findtext(end) for end in ("minimum", "maximum"))
            assert (low is None or float(low) <= value) and (high is None or value <= float(high)), name
