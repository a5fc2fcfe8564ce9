"""Looks at a finished mesh: labels, quality histogram, one mesh per label. Needs VTK and NumPy only."""

import numpy as np
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
    """The smallest dihedral angle of each tetrahedron, degrees. vtkMeshQuality takes supplements at two edges."""
    types = mesh.GetCellTypesArray() if hasattr(mesh, "GetCellTypesArray") else mesh.GetCellTypes()
    starts = vtk_to_numpy(mesh.GetCells().GetOffsetsArray())[:-1][vtk_to_numpy(types) == vtk.VTK_TETRA]
    corners = vtk_to_numpy(mesh.GetCells().GetConnectivityArray())[starts[:, None] + np.arange(4)]
    points = vtk_to_numpy(mesh.GetPoints().GetData()).astype(float)[corners]
    normals = []
    for a, b, c in ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1)):  # opposite to corners 0 to 3, outwards
        normal = np.cross(points[:, b] - points[:, a], points[:, c] - points[:, a])
        normals.append(normal / np.linalg.norm(normal, axis=1, keepdims=True))
    cosines = [-np.einsum("ij,ij->i", normals[f], normals[g]) for f in range(4) for g in range(f)]
    return np.degrees(np.arccos(np.clip(np.max(cosines, axis=0), -1.0, 1.0))).tolist()


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
