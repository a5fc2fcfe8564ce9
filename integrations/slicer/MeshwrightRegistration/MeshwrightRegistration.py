"""Preoperative to intraoperative scan: displacement field and warped scan."""

import os
import sys

import slicer
from slicer.ScriptedLoadableModule import ScriptedLoadableModuleTest

sys.path.append(os.path.join(os.path.dirname(__file__), ".."))
from MeshwrightLib import checks, command_line, modules, widgets  # noqa: E402


class MeshwrightRegistration(modules.DescribedModule):
    TITLE = "Brain Shift Registration"
    CATEGORY = "Registration.Specialized"
    HELP = (
        "Registers a preoperative scan to an intraoperative one with a biomechanical model, also where tissue was removed. "
        "Needs the segmentation of the preoperative scan: label 1 brain, label 2 tumour. The transform maps points of the "
        "intraoperative scan to the preoperative one, as Slicer's resampling expects; apply it to anything of the same patient."
    )


class MeshwrightRegistrationWidget(modules.RunPanel):
    FAILURE = "The scans cannot be registered."

    def setup(self):
        super().setup()
        inputs = widgets.section(self.layout, "Input")
        volume = ["vtkMRMLScalarVolumeNode"]
        self.moving = widgets.node_selector(volume, False, "Preoperative scan.")
        self.fixed = widgets.node_selector(volume, False, "Intraoperative scan, brain extracted.")
        self.labels = widgets.node_selector(["vtkMRMLLabelMapVolumeNode"], False, "Segmentation of the preoperative scan.")
        inputs.addRow("Preoperative (moving):", self.moving)
        inputs.addRow("Intraoperative (fixed):", self.fixed)
        inputs.addRow("Segmentation of moving:", self.labels)
        self.add_preset(inputs, command_line.REGISTRATION_PRESETS)
        outputs = widgets.section(self.layout, "Output")
        self.transform = widgets.node_selector(["vtkMRMLGridTransformNode"], True, "Displacement field as a grid transform.")
        self.warped = widgets.node_selector(volume, True, "The preoperative scan in the place of the intraoperative one.")
        outputs.addRow("Transform:", self.transform)
        outputs.addRow("Warped scan:", self.warped)
        self.add_apply(outputs, slicer.modules.meshwrightregister)
        self.layout.addStretch(1)
        self.follow(self.moving, self.fixed, self.labels, self.transform, self.warped)

    def on_input_changed(self, _node=None):
        has_inputs = self.moving.currentNode() and self.fixed.currentNode() and self.labels.currentNode()
        self.apply_button.enabled = bool(has_inputs and (self.transform.currentNode() or self.warped.currentNode()))

    def prepare(self):
        nodes = {"moving-image": self.moving.currentNode(), "fixed-image": self.fixed.currentNode(), "segmented-image": self.labels.currentNode()}
        roles = ("the preoperative scan", "the intraoperative scan", "the segmentation")
        for node, role in zip(nodes.values(), roles):
            checks.check_volume(node, role)
            checks.check_different(node, self.warped.currentNode())
        checks.check_untransformed(nodes.values())
        if self.transform.currentNode():
            nodes["output-deformation-field"] = self.transform.currentNode()
        if self.warped.currentNode():
            nodes["output-image"] = self.warped.currentNode()
        return nodes, command_line.REGISTRATION_PRESETS[self.preset.currentText]

    def show_result(self):
        if self.warped.currentNode():
            slicer.util.setSliceViewerLayers(background=self.fixed.currentNode(), foreground=self.warped.currentNode(), foregroundOpacity=0.5)


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
