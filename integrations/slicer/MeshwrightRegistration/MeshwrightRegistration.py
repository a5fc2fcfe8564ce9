"""Preoperative to intraoperative scan: displacement field and warped scan."""

import os
import sys

import qt
import slicer
from slicer.ScriptedLoadableModule import (
    ScriptedLoadableModule,
    ScriptedLoadableModuleLogic,
    ScriptedLoadableModuleTest,
    ScriptedLoadableModuleWidget,
)

sys.path.append(os.path.join(os.path.dirname(__file__), ".."))
from MeshwrightLib import command_line  # noqa: E402


class MeshwrightRegistration(ScriptedLoadableModule):
    def __init__(self, parent):
        super().__init__(parent)
        parent.title = "Meshwright: Brain Shift Registration"
        parent.categories = ["Registration.Specialized"]
        parent.dependencies = []
        parent.contributors = ["The Meshwright developers"]
        parent.helpText = (
            "Registers a preoperative scan to an intraoperative one with a biomechanical model, also where tissue was removed. "
            "Needs the segmentation of the preoperative scan: label 1 brain, label 2 tumour. The transform maps points of the "
            "intraoperative scan to the preoperative one, as Slicer's resampling expects; apply it to anything of the same patient."
        )
        parent.acknowledgementText = "Method: F. Drakopoulos, PhD dissertation, Old Dominion University, 2017."


class MeshwrightRegistrationWidget(ScriptedLoadableModuleWidget):
    def setup(self):
        super().setup()
        from MeshwrightLib import widgets

        inputs = widgets.section(self.layout, "Input")
        volume = ["vtkMRMLScalarVolumeNode"]
        self.moving = widgets.node_selector(volume, False, "Preoperative scan.")
        self.fixed = widgets.node_selector(volume, False, "Intraoperative scan, brain extracted.")
        self.labels = widgets.node_selector(["vtkMRMLLabelMapVolumeNode"], False, "Segmentation of the preoperative scan.")
        inputs.addRow("Preoperative (moving):", self.moving)
        inputs.addRow("Intraoperative (fixed):", self.fixed)
        inputs.addRow("Segmentation of moving:", self.labels)
        self.preset = qt.QComboBox()
        self.preset.addItems(list(command_line.REGISTRATION_PRESETS))
        inputs.addRow("Preset:", self.preset)
        outputs = widgets.section(self.layout, "Output")
        self.transform = widgets.node_selector(["vtkMRMLGridTransformNode"], True, "Displacement field as a grid transform.")
        self.warped = widgets.node_selector(volume, True, "The preoperative scan in the place of the intraoperative one.")
        outputs.addRow("Transform:", self.transform)
        outputs.addRow("Warped scan:", self.warped)
        self.apply_button = qt.QPushButton("Apply")
        outputs.addRow(self.apply_button)
        self.runner = widgets.CliRunner(slicer.modules.meshwrightregister, outputs, self.on_finished)
        self.layout.addStretch(1)
        for selector in (self.moving, self.fixed, self.labels, self.transform, self.warped):
            selector.connect("currentNodeChanged(vtkMRMLNode*)", self.on_input_changed)
        self.apply_button.connect("clicked(bool)", self.on_apply)
        self.on_input_changed()

    def on_input_changed(self, _node=None):
        has_inputs = self.moving.currentNode() and self.fixed.currentNode() and self.labels.currentNode()
        self.apply_button.enabled = bool(has_inputs and (self.transform.currentNode() or self.warped.currentNode()))

    def on_apply(self):
        if self.runner.is_busy():
            self.runner.cancel()
            return
        nodes = {"moving-image": self.moving.currentNode(), "fixed-image": self.fixed.currentNode(), "segmented-image": self.labels.currentNode()}
        if self.transform.currentNode():
            nodes["output-deformation-field"] = self.transform.currentNode()
        if self.warped.currentNode():
            nodes["output-image"] = self.warped.currentNode()
        with slicer.util.tryWithErrorDisplay("The scans cannot be registered."):
            self.runner.start(nodes, command_line.REGISTRATION_PRESETS[self.preset.currentText])
            self.apply_button.text = "Cancel"

    def on_finished(self, is_done):
        self.apply_button.text = "Apply"
        if is_done and self.warped.currentNode():
            slicer.util.setSliceViewerLayers(background=self.fixed.currentNode(), foreground=self.warped.currentNode(), foregroundOpacity=0.5)


class MeshwrightRegistrationLogic(ScriptedLoadableModuleLogic):
    pass


class MeshwrightRegistrationTest(ScriptedLoadableModuleTest):
    def setUp(self):
        slicer.mrmlScene.Clear()

    def runTest(self):
        self.setUp()
        self.test_module_answers_with_an_error_for_missing_input()

    def test_module_answers_with_an_error_for_missing_input(self):
        node = slicer.cli.createNode(slicer.modules.meshwrightregister)
        slicer.modules.meshwrightregister.cliModuleLogic().ApplyAndWait(node, False)
        self.assertTrue(node.GetStatus() & node.ErrorsMask)
        self.delayDisplay("Test passed")
