"""Closed surface model to tetrahedral mesh that keeps every triangle."""

import os
import sys

import qt
import slicer
import vtk
from slicer.ScriptedLoadableModule import ScriptedLoadableModuleLogic, ScriptedLoadableModuleTest

sys.path.append(os.path.join(os.path.dirname(__file__), ".."))
from MeshwrightLib import checks, command_line, modules, results, widgets  # noqa: E402


class MeshwrightSurfaceMesher(modules.DescribedModule):
    TITLE = "Surface to Mesh"
    HELP = (
        "Fills a closed surface model with tetrahedra. Every triangle of the model stays as it is. "
        "A surface that is open or intersects itself is refused, with the places listed."
    )


class MeshwrightSurfaceMesherWidget(modules.RunPanel):
    FAILURE = "The surface cannot be meshed."

    def setup(self):
        super().setup()
        self.logic = MeshwrightSurfaceMesherLogic()
        self.prepared = None
        inputs = widgets.section(self.layout, "Input")
        self.surface_selector = widgets.node_selector(["vtkMRMLModelNode"], False, "A closed, triangulated surface.")
        inputs.addRow("Surface:", self.surface_selector)
        settings = widgets.section(self.layout, "Settings")
        self.add_preset(settings, command_line.SURFACE_PRESETS)
        self.size = qt.QDoubleSpinBox()
        self.size.setRange(0.0, 1e6)
        self.size.specialValueText = "from the surface"
        self.size.toolTip = "Largest element size; 0 follows the surface's triangles."
        settings.addRow("Largest size:", self.size)
        outputs = widgets.section(self.layout, "Output")
        self.output_selector = widgets.node_selector(["vtkMRMLModelNode"], True, "The mesh.")
        outputs.addRow("Mesh:", self.output_selector)
        self.add_apply(outputs, slicer.modules.meshwrightsurfacetomesh)
        self.histogram = widgets.HistogramView()
        outputs.addRow("Quality:", self.histogram)
        self.layout.addStretch(1)
        self.follow(self.surface_selector, self.output_selector)

    def on_input_changed(self, _node=None):
        self.apply_button.enabled = bool(self.surface_selector.currentNode() and self.output_selector.currentNode())

    def prepare(self):
        surface, output = self.surface_selector.currentNode(), self.output_selector.currentNode()
        checks.check_different(surface, output)
        self.prepared = self.logic.triangulated(surface)
        overrides = {"size-limit": self.size.value or None}
        parameters = command_line.parameters_of(command_line.SURFACE_PRESETS[self.preset.currentText], overrides, {})
        return {"plc": self.prepared, "output": output}, parameters

    def clean_up(self):
        slicer.mrmlScene.RemoveNode(self.prepared)
        self.prepared = None

    def show_result(self):
        mesh_node = self.output_selector.currentNode()
        mesh_node.SetAndObserveTransformNodeID(self.prepared.GetTransformNodeID())
        widgets.show_volume_mesh(mesh_node)
        self.histogram.show_mesh(mesh_node.GetMesh())


class MeshwrightSurfaceMesherLogic(ScriptedLoadableModuleLogic):
    def triangulated(self, model_node):
        """A copy of the model with triangles only; strips and polygons are split, points are not moved or merged."""
        checks.check_surface(model_node)
        triangles = vtk.vtkTriangleFilter()
        triangles.SetInputData(model_node.GetPolyData())
        triangles.PassLinesOff()
        triangles.PassVertsOff()
        triangles.Update()
        copy = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLModelNode", "Meshwright surface")
        copy.SetAndObservePolyData(triangles.GetOutput())
        copy.SetAndObserveTransformNodeID(model_node.GetTransformNodeID())
        return copy


class MeshwrightSurfaceMesherTest(ScriptedLoadableModuleTest):
    def setUp(self):
        slicer.mrmlScene.Clear()

    def runTest(self):
        self.setUp()
        self.test_keeps_every_triangle()

    def test_keeps_every_triangle(self):
        source = vtk.vtkCubeSource()
        source.SetXLength(30)
        source.Update()
        clean = vtk.vtkCleanPolyData()
        clean.SetInputData(source.GetOutput())
        clean.Update()
        surface = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLModelNode")
        surface.SetAndObservePolyData(clean.GetOutput())
        prepared = MeshwrightSurfaceMesherLogic().triangulated(surface)
        mesh = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLModelNode")
        node = slicer.cli.createNode(slicer.modules.meshwrightsurfacetomesh)
        node.SetParameterAsNode("plc", prepared)
        node.SetParameterAsNode("output", mesh)
        slicer.modules.meshwrightsurfacetomesh.cliModuleLogic().ApplyAndWait(node, False)
        self.assertFalse(node.GetStatus() & node.ErrorsMask, node.GetErrorText())
        self.assertEqual(len(results.labels_of(mesh.GetMesh())), 1)
        self.delayDisplay("Test passed")
