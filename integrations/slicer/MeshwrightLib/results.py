"""Looks at a finished mesh: labels, quality histogram, one mesh per label. Needs VTK only."""

import vtk
from vtk.util.numpy_support import vtk_to_numpy

LABEL_ARRAY = "label"
HISTOGRAM_BIN_DEGREES = 5


def labels_of(mesh):
    """Sorted labels of the volume elements."""
    array = mesh.GetCellData().GetArray(LABEL_ARRAY)
    if array is None:
        raise ValueError(f"the mesh has no cell array '{LABEL_ARRAY}'")
    return sorted({int(value) for value in vtk_to_numpy(array)})


def split_by_label(mesh):
    """One unstructured grid per label, with its own points."""
    parts = {}
    for label in labels_of(mesh):
        threshold = vtk.vtkThreshold()
        threshold.SetInputData(mesh)
        threshold.SetInputArrayToProcess(0, 0, 0, vtk.vtkDataObject.FIELD_ASSOCIATION_CELLS, LABEL_ARRAY)
        threshold.SetLowerThreshold(label)
        threshold.SetUpperThreshold(label)
        threshold.SetThresholdFunction(vtk.vtkThreshold.THRESHOLD_BETWEEN)
        threshold.Update()
        parts[label] = threshold.GetOutput()
    return parts


def minimum_dihedral_angles(mesh):
    """The smallest dihedral angle of each tetrahedron, degrees."""
    quality = vtk.vtkMeshQuality()
    quality.SetInputData(mesh)
    quality.SetTetQualityMeasureToMinAngle()
    quality.Update()
    angles = vtk_to_numpy(quality.GetOutput().GetCellData().GetArray("Quality"))
    return [angle for cell, angle in enumerate(angles) if mesh.GetCellType(cell) == vtk.VTK_TETRA]


def dihedral_histogram(mesh):
    """`[(from, to, count), ...]` of the smallest dihedral angles in 5-degree steps up to the largest that occurs."""
    angles = minimum_dihedral_angles(mesh)
    if not angles:
        return []
    bins = int(max(angles) // HISTOGRAM_BIN_DEGREES) + 1
    counts = [0] * bins
    for angle in angles:
        counts[min(bins - 1, int(angle // HISTOGRAM_BIN_DEGREES))] += 1
    return [(i * HISTOGRAM_BIN_DEGREES, (i + 1) * HISTOGRAM_BIN_DEGREES, count) for i, count in enumerate(counts)]


def summary(mesh):
    """A few lines for a person."""
    angles = minimum_dihedral_angles(mesh)
    lines = [f"{mesh.GetNumberOfPoints()} points, {mesh.GetNumberOfCells()} elements"]
    if angles:
        lines.append(f"smallest dihedral angle {min(angles):.1f} degrees")
    lines.append("labels " + ", ".join(str(label) for label in labels_of(mesh)))
    return "\n".join(lines)
