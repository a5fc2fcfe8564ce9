"""Draws a tetrahedral mesh: three cuts coloured by label with the elements' edges, and the dihedral angles.

Usage: draw_mesh.py MESH.vtu OUT.png       (needs numpy, vtk, matplotlib)
"""
import sys

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import vtk
from matplotlib.collections import PolyCollection
from vtk.util.numpy_support import vtk_to_numpy

EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])


def read(path):
    """Points, tets and labels of a .vtu; read with VTK, because meshio knows no string arrays such as SPACE."""
    reader = vtk.vtkXMLUnstructuredGridReader()
    reader.SetFileName(path)
    reader.Update()
    grid = reader.GetOutput()
    if not grid.IsHomogeneous() or grid.GetCellType(0) != vtk.VTK_TETRA:
        raise SystemExit(f"{path} is not a mesh of tetrahedra")
    tets = vtk_to_numpy(grid.GetCells().GetConnectivityArray()).reshape(-1, 4)
    return vtk_to_numpy(grid.GetPoints().GetData()), tets, vtk_to_numpy(grid.GetCellData().GetArray("labels"))


def cut(points, tets, axis, place):
    """The polygons in which the plane `axis = place` cuts the tets, and which tet each comes from."""
    height = points[tets, axis] - place
    below = (height < 0).sum(axis=1)
    flat = [a for a in range(3) if a != axis]
    polygons, owners = [], []
    for index in np.nonzero((below > 0) & (below < 4))[0]:
        tet, h = points[tets[index]], height[index]
        crossed = EDGES[(h[EDGES[:, 0]] < 0) != (h[EDGES[:, 1]] < 0)]
        t = h[crossed[:, 0]] / (h[crossed[:, 0]] - h[crossed[:, 1]])
        corners = (tet[crossed[:, 0]] + t[:, None] * (tet[crossed[:, 1]] - tet[crossed[:, 0]]))[:, flat]
        turn = corners - corners.mean(axis=0)
        polygons.append(corners[np.argsort(np.arctan2(turn[:, 1], turn[:, 0]))])
        owners.append(index)
    return polygons, np.array(owners)


def dihedral_angles(points, tets):
    p = points[tets]
    angles = []
    for a, b, c, d in [(0, 1, 2, 3), (0, 2, 1, 3), (0, 3, 1, 2), (1, 2, 0, 3), (1, 3, 0, 2), (2, 3, 0, 1)]:
        axis = p[:, b] - p[:, a]
        axis /= np.linalg.norm(axis, axis=1)[:, None]
        u, v = p[:, c] - p[:, a], p[:, d] - p[:, a]
        u -= (u * axis).sum(axis=1)[:, None] * axis
        v -= (v * axis).sum(axis=1)[:, None] * axis
        cosine = (u * v).sum(axis=1) / (np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1))
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return np.concatenate(angles)


def main():
    points, tets, labels = read(sys.argv[1])
    names = ["x (left)", "y (posterior)", "z (superior)"]
    values = np.unique(labels)
    # Golden-ratio hues: neighbouring label numbers get colours that are far apart.
    colors = matplotlib.colormaps["hsv"]((np.arange(len(values)) * 0.61803398875) % 1.0)
    colors[:, :3] = 0.35 + 0.65 * colors[:, :3]
    figure, axes = plt.subplots(2, 2, figsize=(14, 13))
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    for axis, panel in enumerate(axes.flat[:3]):
        # Off the middle by an odd fraction, so that the plane does not run along faces of the lattice.
        polygons, owners = cut(points, tets, axis, middle[axis] + 0.0137)
        faces = colors[np.searchsorted(values, labels[owners])]
        panel.add_collection(PolyCollection(polygons, facecolors=faces, edgecolors="black", linewidths=0.15))
        panel.set_aspect("equal")
        panel.autoscale_view()
        flat = [a for a in range(3) if a != axis]
        panel.set_xlabel(f"{names[flat[0]]}, mm")
        panel.set_ylabel(f"{names[flat[1]]}, mm")
        panel.set_title(f"cut at {names[axis].split()[0]} = {middle[axis]:.0f} mm")
        if flat[1] == 1:
            panel.invert_yaxis()
    angles = dihedral_angles(points, tets)
    panel = axes.flat[3]
    panel.hist(angles, bins=np.arange(0, 181, 5), color="steelblue", edgecolor="black")
    panel.set_xlabel("dihedral angle, degrees")
    panel.set_ylabel("count")
    panel.set_title(f"{len(tets)} tetrahedra, {len(values)} labels, angles {angles.min():.1f} to {angles.max():.1f} degrees")
    figure.tight_layout()
    figure.savefig(sys.argv[2], dpi=110)


main()
