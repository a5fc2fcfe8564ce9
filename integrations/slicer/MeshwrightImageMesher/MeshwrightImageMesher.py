"""Segmentation to tetrahedral mesh, with one row per segment."""

import os
import sys

import qt
import slicer
import vtk
from slicer.ScriptedLoadableModule import ScriptedLoadableModuleLogic, ScriptedLoadableModuleTest

sys.path.append(os.path.join(os.path.dirname(__file__), ".."))
from MeshwrightLib import checks, command_line, modules, results, widgets  # noqa: E402


class MeshwrightImageMesher(modules.DescribedModule):
    TITLE = "Segmentation to Mesh"
    HELP = (
        "Makes a tetrahedral mesh of a segmentation. Choose the segments, a preset, and press Apply. "
        "Fidelity is the share of each segment that the mesh covers; a segment may have its own. "
        "The mesh lies where the segmentation lies, whatever the orientation of the scan, and keeps every segment."
    )


class MeshwrightImageMesherWidget(modules.RunPanel):
    FAILURE = "The segmentation cannot be meshed."

    def setup(self):
        super().setup()
        self.logic = MeshwrightImageMesherLogic()
        self.labels = None
        inputs = widgets.section(self.layout, "Input")
        self.segmentation_selector = widgets.node_selector(["vtkMRMLSegmentationNode"], False, "The segmentation to mesh.")
        inputs.addRow("Segmentation:", self.segmentation_selector)
        self.table = widgets.SegmentTable()
        inputs.addRow(self.table)

        settings = widgets.section(self.layout, "Settings")
        self.add_preset(settings, command_line.IMAGE_PRESETS)
        self.preset.setCurrentText("Simulation (default)")
        self.spacing = self._optional_number(settings, "Lattice spacing (mm):", 0.0, 100.0, "Size of the coarsest elements; 0 leaves it to the preset.")
        self.fidelity = self._optional_number(settings, "Fidelity:", 0.0, 1.0, "For segments without their own; 0 leaves it to the preset.")

        outputs = widgets.section(self.layout, "Output")
        self.output_selector = widgets.node_selector(["vtkMRMLModelNode"], True, "The mesh.")
        outputs.addRow("Mesh:", self.output_selector)
        self.per_label = qt.QCheckBox()
        self.per_label.toolTip = "Make one model per segment beside the whole mesh."
        outputs.addRow("One model per segment:", self.per_label)
        self.add_apply(outputs, slicer.modules.meshwrightimagetomesh)
        self.histogram = widgets.HistogramView()
        outputs.addRow("Quality:", self.histogram)
        self.layout.addStretch(1)
        self.follow(self.segmentation_selector, self.output_selector)

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

    def prepare(self):
        overrides = {"lattice-spacing": self.spacing.value or None, "fidelity": self.fidelity.value or None}
        preset = command_line.IMAGE_PRESETS[self.preset.currentText]
        parameters = command_line.parameters_of(preset, overrides, {"fidelity": self.table.fidelities()})
        self.labels = self.logic.export_labels(self.segmentation_selector.currentNode(), self.table.chosen_segments())
        return {"image": self.labels, "output": self.output_selector.currentNode()}, parameters

    def clean_up(self):
        slicer.mrmlScene.RemoveNode(self.labels)
        self.labels = None

    def show_result(self):
        mesh_node = self.output_selector.currentNode()
        # The module saw the labels without the transforms above the segmentation.
        mesh_node.SetAndObserveTransformNodeID(self.labels.GetTransformNodeID())
        widgets.show_volume_mesh(mesh_node)
        self.histogram.show_mesh(mesh_node.GetMesh())
        if self.per_label.checked:
            widgets.make_label_models(mesh_node, self.logic.segment_names)


class MeshwrightImageMesherLogic(ScriptedLoadableModuleLogic):
    def __init__(self):
        super().__init__()
        self.segment_names = {}

    def export_labels(self, segmentation_node, segment_ids):
        """A label map of the chosen segments on the reference geometry; labels count from 1 in the order chosen."""
        checks.check_segments(segmentation_node, segment_ids)
        labels = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLLabelMapVolumeNode", "Meshwright labels")
        ids = vtk.vtkStringArray()
        for segment_id in segment_ids:
            ids.InsertNextValue(segment_id)
        exported = slicer.modules.segmentations.logic().ExportSegmentsToLabelmapNode(
            segmentation_node, ids, labels, segmentation_node.GetNodeReference(segmentation_node.GetReferenceImageGeometryReferenceRole())
        )
        if not exported:
            slicer.mrmlScene.RemoveNode(labels)
            raise RuntimeError("The segments could not be turned into a label map: are they empty?")
        segmentation = segmentation_node.GetSegmentation()
        self.segment_names = {i: segmentation.GetSegment(s).GetName() for i, s in enumerate(segment_ids, start=1)}
        return labels


class MeshwrightImageMesherTest(ScriptedLoadableModuleTest):
    def setUp(self):
        slicer.mrmlScene.Clear()

    def runTest(self):
        self.setUp()
        self.test_meshes_a_sphere_segment()
        self.test_a_segmentation_without_segments_is_refused()

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

    def test_a_segmentation_without_segments_is_refused(self):
        segmentation = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSegmentationNode", "empty")
        with self.assertRaisesRegex(ValueError, "no segments"):
            MeshwrightImageMesherLogic().export_labels(segmentation, [])
        self.assertIsNone(slicer.mrmlScene.GetFirstNodeByClass("vtkMRMLLabelMapVolumeNode"))
