"""Pieces of user interface that the three modules share; imported inside Slicer only."""

import ctk
import qt
import slicer
import vtk

from MeshwrightLib import checks, command_line, results


class CliRunner:
    """Runs a command-line module in the background, with Slicer's own progress bar and its Cancel."""

    def __init__(self, module, layout, on_finished):
        self.module = module
        self.on_finished = on_finished
        self.node = None
        self.observer = None
        self.progress_bar = slicer.qSlicerCLIProgressBar()
        layout.addRow(self.progress_bar)

    def is_busy(self):
        return self.node is not None and self.node.IsBusy()

    def start(self, nodes, parameters):
        """`nodes` maps parameter names to MRML nodes, `parameters` names to values."""
        logic = self.module.cliModuleLogic()
        self.node = logic.CreateNodeInScene()
        for name, node in nodes.items():
            self.node.SetParameterAsNode(name, node)
        command_line.set_cli_parameters(self.node, parameters)
        self.progress_bar.setCommandLineModuleNode(self.node)
        self.observer = self.node.AddObserver(slicer.vtkMRMLCommandLineModuleNode.StatusModifiedEvent, self._on_status)
        logic.Apply(self.node, True)

    def cancel(self):
        if self.is_busy():
            self.node.Cancel()

    def _on_status(self, node, _event):
        if node.IsBusy():
            return
        node.RemoveObserver(self.observer)
        if node.GetStatus() & node.ErrorsMask:
            slicer.util.errorDisplay(node.GetErrorText().strip() or "Meshwright ended with an error.", detailedText=node.GetOutputText())
            self.on_finished(False)
        else:
            self.on_finished(bool(node.GetStatus() & node.Completed))


class SegmentTable(qt.QTableWidget):
    """One row per segment: whether to mesh it, and its own fidelity (empty: the general one)."""

    def __init__(self, parent=None):
        super().__init__(0, 3, parent)
        self.setHorizontalHeaderLabels(["Mesh", "Segment", "Fidelity"])
        self.horizontalHeader().setSectionResizeMode(1, qt.QHeaderView.Stretch)
        self.verticalHeader().hide()
        self.segment_ids = []

    def show_segmentation(self, node):
        segmentation = node.GetSegmentation() if node else None
        self.segment_ids = [segmentation.GetNthSegmentID(i) for i in range(segmentation.GetNumberOfSegments())] if segmentation else []
        self.setRowCount(len(self.segment_ids))
        for row, segment_id in enumerate(self.segment_ids):
            use = qt.QTableWidgetItem()
            use.setFlags(qt.Qt.ItemIsUserCheckable | qt.Qt.ItemIsEnabled)
            use.setCheckState(qt.Qt.Checked)
            name = qt.QTableWidgetItem(segmentation.GetSegment(segment_id).GetName())
            name.setFlags(qt.Qt.ItemIsEnabled)
            self.setItem(row, 0, use)
            self.setItem(row, 1, name)
            self.setItem(row, 2, qt.QTableWidgetItem(""))

    def chosen_segments(self):
        return [s for row, s in enumerate(self.segment_ids) if self.item(row, 0).checkState() == qt.Qt.Checked]

    def fidelities(self):
        """`{label: fidelity}`; labels of an exported label map count the chosen segments from 1."""
        values = {}
        for label, segment_id in enumerate(self.chosen_segments(), start=1):
            row = self.segment_ids.index(segment_id)
            value = checks.fidelity_of(self.item(row, 2).text(), self.item(row, 1).text())
            if value is not None:
                values[label] = value
        return values


class HistogramView(qt.QTextEdit):
    """The dihedral histogram as text bars, so that it can be copied into a report."""

    BAR_WIDTH = 40

    def __init__(self, parent=None):
        super().__init__(parent)
        self.setReadOnly(True)
        self.setFontFamily("monospace")

    def show_mesh(self, mesh):
        rows = results.dihedral_histogram(mesh)
        largest = max((count for _, _, count in rows), default=1)
        bars = [f"{low:3d}-{high:3d} {'#' * round(self.BAR_WIDTH * count / largest)} {count}" for low, high, count in rows]
        self.setPlainText(results.summary(mesh) + "\n\n" + "\n".join(bars))


def show_volume_mesh(model_node):
    """Colours by label, shows edges, and clips whole cells by the slice planes."""
    model_node.CreateDefaultDisplayNodes()
    display = model_node.GetDisplayNode()
    display.SetActiveScalar(results.LABEL_ARRAY, vtk.vtkAssignAttribute.CELL_DATA)
    display.SetScalarVisibility(True)
    display.SetAndObserveColorNodeID("vtkMRMLColorTableNodeFileGenericAnatomyColors.txt")
    display.SetScalarRangeFlag(slicer.vtkMRMLDisplayNode.UseColorNodeScalarRange)
    display.SetEdgeVisibility(True)
    display.SetVisibility2D(True)
    display.SetClipping(True)
    clip = slicer.mrmlScene.GetFirstNodeByClass("vtkMRMLClipModelsNode") or slicer.mrmlScene.AddNewNodeByClass("vtkMRMLClipModelsNode")
    clip.SetClippingMethod(slicer.vtkMRMLClipModelsNode.WholeCells)


def make_label_models(model_node, names):
    """One model per label, in a folder of the subject hierarchy; `names` maps labels to segment names."""
    hierarchy = slicer.mrmlScene.GetSubjectHierarchyNode()
    folder = hierarchy.CreateFolderItem(hierarchy.GetSceneItemID(), model_node.GetName() + " by label")
    for label, part in results.split_by_label(model_node.GetMesh()).items():
        part_node = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLModelNode", names.get(label, f"label {label}"))
        part_node.SetAndObserveMesh(part)
        part_node.CreateDefaultDisplayNodes()
        hierarchy.SetItemParent(hierarchy.GetItemByDataNode(part_node), folder)


def node_selector(node_classes, can_create, tool_tip):
    """A node combo box of the usual kind."""
    selector = slicer.qMRMLNodeComboBox()
    selector.nodeTypes = node_classes
    selector.addEnabled = can_create
    selector.renameEnabled = can_create
    selector.removeEnabled = can_create
    selector.noneEnabled = True
    selector.setMRMLScene(slicer.mrmlScene)
    selector.toolTip = tool_tip
    return selector


def section(parent_layout, title, collapsed=False):
    """A collapsible section; returns its form layout."""
    button = ctk.ctkCollapsibleButton()
    button.text = title
    button.collapsed = collapsed
    parent_layout.addWidget(button)
    return qt.QFormLayout(button)
