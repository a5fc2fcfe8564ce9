"""What the three scripted modules have in common: their description, and a panel with one button for Apply and Cancel."""

import qt
import slicer
from slicer.ScriptedLoadableModule import ScriptedLoadableModule, ScriptedLoadableModuleWidget

from MeshwrightLib import widgets


class DescribedModule(ScriptedLoadableModule):
    """A module that describes itself by TITLE, CATEGORY and HELP."""

    CATEGORY = "Mesh Generation"

    def __init__(self, parent):
        super().__init__(parent)
        parent.title = f"Meshwright: {self.TITLE}"
        parent.categories = [self.CATEGORY]
        parent.dependencies = []
        parent.contributors = ["The Meshwright developers"]
        parent.helpText = self.HELP
        parent.acknowledgementText = "Method: F. Drakopoulos, PhD dissertation, Old Dominion University, 2017."


class RunPanel(ScriptedLoadableModuleWidget):
    """Apply starts the command-line module with what `prepare` returns, and becomes Cancel while it runs.

    A subclass has `prepare` (nodes and parameters by name; raises ValueError with a sentence for the user), `clean_up` (removes
    the nodes that `prepare` made) and `show_result`.
    """

    FAILURE = "Meshwright cannot run."

    def add_preset(self, layout, presets):
        self.preset = qt.QComboBox()
        self.preset.addItems(list(presets))
        layout.addRow("Preset:", self.preset)

    def add_apply(self, layout, cli_module):
        self.apply_button = qt.QPushButton("Apply")
        layout.addRow(self.apply_button)
        self.apply_button.connect("clicked(bool)", self.on_apply)
        self.runner = widgets.CliRunner(cli_module, layout, self.on_finished)

    def follow(self, *selectors):
        """Enables Apply as the choice of nodes asks."""
        for selector in selectors:
            selector.connect("currentNodeChanged(vtkMRMLNode*)", self.on_input_changed)
        self.on_input_changed()

    def on_apply(self, _checked=False):
        if self.runner.is_busy():
            self.runner.cancel()
            return
        with slicer.util.tryWithErrorDisplay(self.FAILURE):
            try:
                self.runner.start(*self.prepare())
            except Exception:
                self.clean_up()
                raise
            self.apply_button.text = "Cancel"

    def on_finished(self, is_done):
        self.apply_button.text = "Apply"
        if is_done:
            self.show_result()
        self.clean_up()

    def clean_up(self):
        pass
