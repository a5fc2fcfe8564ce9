"""Segmentation to tetrahedral mesh, with one row per segment."""

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


class MeshwrightImageMesher(ScriptedLoadableModule):
    def __init__(self, parent):
        super().__init__(parent)
        parent.title = "Meshwright: Segmentation to Mesh"
        parent.categories = ["Mesh Generation"]
        parent.dependencies = []
        parent.contributors = ["The Meshwright developers"]
        parent.helpText = (
            "Makes a tetrahedral mesh of a segmentation. Choose the segments, a preset, and press Apply. "
            "Fidelity is the share of each segment that the mesh covers; a segment may have its own. "
            "The mesh lies where the segmentation lies, whatever the orientation of the scan, and keeps every segment."
        )
        parent.acknowledgementText = "Method: F. Drakopoulos, PhD dissertation, Old Dominion University, 2017."


class MeshwrightImageMesherWidget(ScriptedLoadableModuleWidget):
    def setup(self):
        super().setup()
        from MeshwrightLib import widgets

        self.widgets = widgets
        self.logic = MeshwrightImageMesherLogic()
        inputs = widgets.section(self.layout, "Input")
        self.segmentation_selector = widgets.node_selector(["vtkMRMLSegmentationNode"], False, "The segmentation to mesh.")
        inputs.addRow("Segmentation:", self.segmentation_selector)
        self.table = widgets.SegmentTable()
        inputs.addRow(self.table)

        settings = widgets.section(self.layout, "Settings")
        self.preset = qt.QComboBox()
        self.preset.addItems(list(command_line.IMAGE_PRESETS))
        self.preset.setCurrentText("Simulation (default)")
        settings.addRow("Preset:", self.preset)
        self.spacing = self._optional_number(settings, "Lattice spacing (mm):", 0.0, 100.0, "Size of the coarsest elements; 0 leaves it to the preset.")
        self.fidelity = self._optional_number(settings, "Fidelity:", 0.0, 1.0, "For segments without their own; 0 leaves it to the preset.")

        outputs = widgets.section(self.layout, "Output")
        self.output_selector = widgets.node_selector(["vtkMRMLModelNode"], True, "The mesh.")
        outputs.addRow("Mesh:", self.output_selector)
        self.per_label = qt.QCheckBox()
        self.per_label.toolTip = "Make one model per segment beside the whole mesh."
        outputs.addRow("One model per segment:", self.per_label)
        self.apply_button = qt.QPushButton("Apply")
        self.apply_button.enabled = False
        outputs.addRow(self.apply_button)
        self.runner = widgets.CliRunner(slicer.modules.meshwrightimagetomesh, outputs, self.on_finished)
        self.histogram = widgets.HistogramView()
        outputs.addRow("Quality:", self.histogram)
        self.layout.addStretch(1)

        self.segmentation_selector.connect("currentNodeChanged(vtkMRMLNode*)", self.on_input_changed)
        self.output_selector.connect("currentNodeChanged(vtkMRMLNode*)", self.on_input_changed)
        self.apply_button.connect("clicked(bool)", self.on_apply)
        self.on_input_changed()

    def _optional_number(self, layout, label, low, high, tool_tip):
        box = qt.QDoubleSpinBox()
        box.setRange(low, high)
        box.decimals = 2
        box.singleStep = (high - low) / 100
        box.specialValueText = "preset"
        box.toolTip = tool_tip
        layout.addRow(label, box)
        return box

    def on_input_changed(self, _node=None):
        segmentation = self.segmentation_selector.currentNode()
        self.table.show_segmentation(segmentation)
        self.apply_button.enabled = bool(segmentation and self.output_selector.currentNode())

    def on_apply(self):
        if self.runner.is_busy():
            self.runner.cancel()
            return
        with slicer.util.tryWithErrorDisplay("The segmentation cannot be meshed."):
            segments = self.table.chosen_segments()
            self.labels = self.logic.export_labels(self.segmentation_selector.currentNode(), segments)
            overrides = {"lattice-spacing": self.spacing.value or None, "fidelity": self.fidelity.value or None}
            preset = command_line.IMAGE_PRESETS[self.preset.currentText]
            parameters = command_line.parameters_of(preset, overrides, {"fidelity": self.table.fidelities()})
            self.runner.start({"image": self.labels, "output": self.output_selector.currentNode()}, parameters)
            self.apply_button.text = "Cancel"

    def on_finished(self, is_done):
        self.apply_button.text = "Apply"
        slicer.mrmlScene.RemoveNode(self.labels)
        if is_done:
            mesh_node = self.output_selector.currentNode()
            self.widgets.show_volume_mesh(mesh_node)
            self.histogram.show_mesh(mesh_node.GetMesh())
            if self.per_label.checked:
                self.widgets.make_label_models(mesh_node, self.logic.segment_names)


class MeshwrightImageMesherLogic(ScriptedLoadableModuleLogic):
    def __init__(self):
        super().__init__()
        self.segment_names = {}

    def export_labels(self, segmentation_node, segment_ids):
        """A label map of the chosen segments on the reference geometry; labels count from 1 in the order chosen."""
        if segmentation_node is None or not segment_ids:
            raise ValueError("Choose a segmentation with at least one segment.")
        labels = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLLabelMapVolumeNode", "Meshwright labels")
        ids = vtk.vtkStringArray()
        for segment_id in segment_ids:
            ids.InsertNextValue(segment_id)
        exported = slicer.modules.segmentations.logic().ExportSegmentsToLabelmapNode(
            segmentation_node, ids, labels, segmentation_node.GetNodeReference(segmentation_node.GetReferenceImageGeometryReferenceRole())
        )
        if not exported:
            slicer.mrmlScene.RemoveNode(labels)
            raise RuntimeError("The segments could not be turned into a label map.")
        segmentation = segmentation_node.GetSegmentation()
        self.segment_names = {i: segmentation.GetSegment(s).GetName() for i, s in enumerate(segment_ids, start=1)}
        return labels


class MeshwrightImageMesherTest(ScriptedLoadableModuleTest):
    def setUp(self):
        slicer.mrmlScene.Clear()

    def runTest(self):
        self.setUp()
        self.test_meshes_a_sphere_segment()

    def test_meshes_a_sphere_segment(self):
        source = vtk.vtkSphereSource()
        source.SetRadius(20)
        source.SetCenter(10, -5, 30)
        source.Update()
        segmentation = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSegmentationNode")
        segmentation.CreateDefaultDisplayNodes()
        segmentation.AddSegmentFromClosedSurfaceRepresentation(source.GetOutput(), "ball", [1, 0, 0])
        logic = MeshwrightImageMesherLogic()
        labels = logic.export_labels(segmentation, [segmentation.GetSegmentation().GetNthSegmentID(0)])
        mesh = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLModelNode")
        node = slicer.cli.createNode(slicer.modules.meshwrightimagetomesh)
        node.SetParameterAsNode("image", labels)
        node.SetParameterAsNode("output", mesh)
        slicer.modules.meshwrightimagetomesh.cliModuleLogic().ApplyAndWait(node, False)
        self.assertFalse(node.GetStatus() & node.ErrorsMask, node.GetErrorText())
        self.assertEqual(results.labels_of(mesh.GetMesh()), [1])
        bounds = mesh.GetMesh().GetBounds()
        for found, expected in zip(bounds, (-10, 30, -25, 15, 10, 50)):
            self.assertAlmostEqual(found, expected, delta=2.0)
        self.assertGreater(min(results.minimum_dihedral_angles(mesh.GetMesh())), 5.0)
        self.delayDisplay("Test passed")
