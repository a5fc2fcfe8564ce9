"""Closed surface model to tetrahedral mesh that keeps every triangle."""

import os
import sys

import qt
import slicer
import vtk
from slicer.ScriptedLoadableModule import (
    ScriptedLoadableModule,
    ScriptedLoadableModuleLogic,
    ScriptedLoadableModuleTest,
    ScriptedLoadableModuleWidget,
)

sys.path.append(os.path.join(os.path.dirname(__file__), ".."))
from MeshwrightLib import command_line, results  # noqa: E402


class MeshwrightSurfaceMesher(ScriptedLoadableModule):
    def __init__(self, parent):
        super().__init__(parent)
        parent.title = "Meshwright: Surface to Mesh"
        parent.categories = ["Mesh Generation"]
        parent.dependencies = []
        parent.contributors = ["The Meshwright developers"]
        parent.helpText = (
            "Fills a closed surface model with tetrahedra. Every triangle of the model stays as it is. "
            "A surface that is open or intersects itself is refused, with the places listed."
        )
        parent.acknowledgementText = "Method: F. Drakopoulos, PhD dissertation, Old Dominion University, 2017."


class MeshwrightSurfaceMesherWidget(ScriptedLoadableModuleWidget):
    def setup(self):
        super().setup()
        from MeshwrightLib import widgets

        self.widgets = widgets
        self.logic = MeshwrightSurfaceMesherLogic()
        inputs = widgets.section(self.layout, "Input")
        self.surface_selector = widgets.node_selector(["vtkMRMLModelNode"], False, "A closed, triangulated surface.")
        inputs.addRow("Surface:", self.surface_selector)
        settings = widgets.section(self.layout, "Settings")
        self.preset = qt.QComboBox()
        self.preset.addItems(list(command_line.SURFACE_PRESETS))
        settings.addRow("Preset:", self.preset)
        self.size = qt.QDoubleSpinBox()
        self.size.setRange(0.0, 1e6)
        self.size.specialValueText = "from the surface"
        self.size.toolTip = "Largest element size; 0 follows the surface's triangles."
        settings.addRow("Largest size:", self.size)
        outputs = widgets.section(self.layout, "Output")
        self.output_selector = widgets.node_selector(["vtkMRMLModelNode"], True, "The mesh.")
        outputs.addRow("Mesh:", self.output_selector)
        self.apply_button = qt.QPushButton("Apply")
        outputs.addRow(self.apply_button)
        self.runner = widgets.CliRunner(slicer.modules.meshwrightsurfacetomesh, outputs, self.on_finished)
        self.histogram = widgets.HistogramView()
        outputs.addRow("Quality:", self.histogram)
        self.layout.addStretch(1)
        for selector in (self.surface_selector, self.output_selector):
            selector.connect("currentNodeChanged(vtkMRMLNode*)", self.on_input_changed)
        self.apply_button.connect("clicked(bool)", self.on_apply)
        self.on_input_changed()

    def on_input_changed(self, _node=None):
        self.apply_button.enabled = bool(self.surface_selector.currentNode() and self.output_selector.currentNode())

    def on_apply(self):
        if self.runner.is_busy():
            self.runner.cancel()
            return
        with slicer.util.tryWithErrorDisplay("The surface cannot be meshed."):
            self.prepared = self.logic.triangulated(self.surface_selector.currentNode())
            overrides = {"dfmax": self.size.value or None}
            parameters = command_line.parameters_of(command_line.SURFACE_PRESETS[self.preset.currentText], overrides, {})
            self.runner.start({"plc": self.prepared, "output": self.output_selector.currentNode()}, parameters)
            self.apply_button.text = "Cancel"

    def on_finished(self, is_done):
        self.apply_button.text = "Apply"
        slicer.mrmlScene.RemoveNode(self.prepared)
        if is_done:
            mesh_node = self.output_selector.currentNode()
            self.widgets.show_volume_mesh(mesh_node)
            self.histogram.show_mesh(mesh_node.GetMesh())


class MeshwrightSurfaceMesherLogic(ScriptedLoadableModuleLogic):
    def triangulated(self, model_node):
        """A copy of the model with triangles only; strips and polygons are split, points are not moved or merged."""
        if model_node is None or model_node.GetPolyData() is None or model_node.GetPolyData().GetNumberOfCells() == 0:
            raise ValueError("Choose a surface model that is not empty.")
        triangles = vtk.vtkTriangleFilter()
        triangles.SetInputData(model_node.GetPolyData())
        triangles.PassLinesOff()
        triangles.PassVertsOff()
        triangles.Update()
        copy = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLModelNode", "Meshwright surface")
        copy.SetAndObservePolyData(triangles.GetOutput())
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
