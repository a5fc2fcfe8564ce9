"""Enough of `qt`, `ctk` and `slicer` to load the scripted modules without Slicer's window. MRML nodes are the real ones of the
`slicer-core` wheel; widgets only remember what they are told; messages to the user are collected."""

import contextlib
import sys
import types
from unittest.mock import MagicMock

import slicer_core


class Widget:
    """Takes any call and any attribute."""

    def __init__(self, *_arguments):
        pass

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return MagicMock()


class ComboBox(Widget):
    def addItems(self, items):
        self.currentText = items[0]

    def setCurrentText(self, text):
        self.currentText = text


class NodeComboBox(Widget):
    node = None

    def currentNode(self):
        return self.node


class TableItem(Widget):
    def __init__(self, text=""):
        self.words, self.state = text, None

    def text(self):
        return self.words

    def setCheckState(self, state):
        self.state = state

    def checkState(self):
        return self.state


class Table(Widget):
    def __init__(self, *_arguments):
        self.cells = {}

    def setItem(self, row, column, item):
        self.cells[row, column] = item

    def item(self, row, column):
        return self.cells[row, column]


class SpinBox(Widget):
    value = 0.0


class CheckBox(Widget):
    checked = False


def install():
    """Puts the fakes where `import` finds them; returns the list that collects what the user is shown."""
    messages = []
    qt = types.ModuleType("qt")
    qt.QComboBox, qt.QTableWidget, qt.QTableWidgetItem = ComboBox, Table, TableItem
    qt.QDoubleSpinBox, qt.QCheckBox, qt.QTextEdit, qt.Qt = SpinBox, CheckBox, Widget, MagicMock()
    for name in ("QPushButton", "QFormLayout", "QHeaderView"):
        setattr(qt, name, type(name, (Widget,), {}))
    qt.QHeaderView.Stretch = 1
    ctk = types.ModuleType("ctk")
    ctk.ctkCollapsibleButton = Widget

    scripted = types.ModuleType("slicer.ScriptedLoadableModule")

    class ScriptedLoadableModule:
        def __init__(self, parent):
            self.parent = parent

    class ScriptedLoadableModuleWidget:
        layout = Widget()

        def setup(self):
            pass

    scripted.ScriptedLoadableModule = ScriptedLoadableModule
    scripted.ScriptedLoadableModuleWidget = ScriptedLoadableModuleWidget
    scripted.ScriptedLoadableModuleLogic = scripted.ScriptedLoadableModuleTest = object

    @contextlib.contextmanager
    def try_with_error_display(message):
        try:
            yield
        except Exception as error:  # as Slicer does: a dialog, and the application goes on
            messages.append(f"{message} {error}")

    slicer = types.ModuleType("slicer")
    slicer.__dict__.update({name: value for name, value in vars(slicer_core).items() if name.startswith("vtk")})
    slicer.mrmlScene = slicer_core.vtkMRMLScene()
    slicer.qMRMLNodeComboBox, slicer.qSlicerCLIProgressBar = NodeComboBox, Widget
    slicer.util = types.SimpleNamespace(tryWithErrorDisplay=try_with_error_display, errorDisplay=lambda text, **_: messages.append(text), setSliceViewerLayers=lambda **_: None)
    slicer.modules = MagicMock()
    slicer.modules.segmentations.logic.return_value = slicer_core.vtkSlicerSegmentationsModuleLogic
    slicer.ScriptedLoadableModule = scripted
    sys.modules.update({"qt": qt, "ctk": ctk, "slicer": slicer, "slicer.ScriptedLoadableModule": scripted})
    return messages
