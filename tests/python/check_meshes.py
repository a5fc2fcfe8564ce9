"""Meshes against VTK, meshio and Gmsh: they read what we write, we read what they write.

Usage: check_meshes.py MESHWRIGHT_BINARY       (needs numpy, vtk, meshio, gmsh)
"""
import itertools, json, os, subprocess, sys, tempfile

import meshio
import numpy as np
import vtk
from vtk.util.numpy_support import vtk_to_numpy

BINARY = os.path.abspath(sys.argv[1])
FOLDER = tempfile.mkdtemp()


def path(name):
    return os.path.join(FOLDER, name)


def convert(source, target, *options):
    subprocess.run([BINARY, "convert", path(source), path(target), *options], check=True)


def info(name):
    return json.loads(subprocess.run([BINARY, "info", path(name), "--json"], capture_output=True, text=True, check=True).stdout)


def vtk_read(name):
    reader = {"vtu": vtk.vtkXMLUnstructuredGridReader, "vtk": vtk.vtkUnstructuredGridReader}[name.split(".")[-1]]()
    reader.SetFileName(path(name))
    reader.Update()
    grid = reader.GetOutput()
    points = vtk_to_numpy(grid.GetPoints().GetData())
    cells = [[grid.GetCell(i).GetPointId(k) for k in range(grid.GetCell(i).GetNumberOfPoints())] for i in range(grid.GetNumberOfCells())]
    types = [grid.GetCellType(i) for i in range(grid.GetNumberOfCells())]
    arrays = {grid.GetCellData().GetArrayName(i): vtk_to_numpy(grid.GetCellData().GetArray(i)) for i in range(grid.GetCellData().GetNumberOfArrays())}
    space = grid.GetFieldData().GetAbstractArray("SPACE")
    return points, types, cells, arrays, space.GetValue(0) if space else None, reader


# A cube of five tets beside a hexahedron, a wedge, a pyramid; numbers with many digits.
rng = np.random.default_rng(3)
corner = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], float)
points = np.vstack([corner, corner + [1, 0, 0], [[0.5, 0.5, 2]]]) * [1.1, 2.3, 3.7] + rng.normal(size=(17, 3)) * 1e-3
tets = np.array([[0, 1, 3, 4], [1, 2, 3, 6], [1, 6, 4, 5], [3, 4, 6, 7], [1, 3, 4, 6]])
for tet in tets:
    a, b, c, d = points[tet]
    assert np.dot(np.cross(b - a, c - a), d - a) > 0
mixed = meshio.Mesh(points, [("tetra", tets), ("hexahedron", [list(range(8, 16))]), ("pyramid", [[4, 5, 6, 7, 16]])],
                    cell_data={"label": [np.array([1, 1, 2, 2, 7], np.int32), np.array([3], np.int32), np.array([9], np.int32)],
                               "quality": [rng.normal(size=5), rng.normal(size=1), rng.normal(size=1)]})
mixed.write(path("source.vtu"))
labels = np.array([1, 1, 2, 2, 7, 3, 9])
reference = info("source.vtu")
assert reference["elements"] == 7 and reference["labels"] == {"1": 2, "2": 2, "3": 1, "7": 1, "9": 1}, reference


def same_as_source(name, space=None, flip=False):
    got, types, cells, arrays, frame, _ = vtk_read(name)
    expected = points * [-1, -1, 1] if flip else points
    assert np.array_equal(got, expected), name
    assert types == [10] * 5 + [12, 14] and cells[:5] == tets.tolist(), name
    for key in ("label", "labels"):
        assert np.array_equal(arrays[key], labels), name
    assert "quality" in arrays, name
    assert frame == space, (name, frame)


for target, options in itertools.product(["vtu", "vtk"], [[], ["--ascii"], ["--compress"], ["--format-version", "5.1"]]):
    if target == "vtu" and "5.1" in options or target == "vtk" and "--compress" in options:
        continue
    convert("source.vtu", f"a.{target}", *options)
    same_as_source(f"a.{target}")
    assert info(f"a.{target}")["labels"] == reference["labels"]
    convert(f"a.{target}", "b.vtu")
    same_as_source("b.vtu")
convert("source.vtu", "lps.vtu", "--space", "lps")
same_as_source("lps.vtu", "LPS")
convert("lps.vtu", "ras.vtu", "--space", "ras")
same_as_source("ras.vtu", "RAS", flip=True)
convert("lps.vtu", "ras.vtk", "--space", "ras")
assert "SPACE=RAS" in vtk_read("ras.vtk")[5].GetHeader()
convert("ras.vtk", "back.vtu", "--space", "lps")
same_as_source("back.vtu", "LPS")

# meshio knows no text arrays, which is what Slicer wants SPACE to be: it reads untagged files, and legacy ones with a tag.
for target, options in [("u.vtu", ["--space", "none"]), ("z.vtu", ["--space", "none", "--compress"]), ("u.vtk", ["--space", "lps"])]:
    convert("lps.vtu", target, *options)
    other = meshio.read(path(target))
    assert np.array_equal(other.points, points) and sum(len(block.data) for block in other.cells) >= 7, target
    assert vtk_read(target)[4] is None
assert "SPACE=LPS" in vtk_read("u.vtk")[5].GetHeader()

for target, options in [("m.msh", []), ("m.msh", ["--ascii"]), ("m.msh", ["--format-version", "2.2"]), ("m.msh", ["--format-version", "2.2", "--ascii"]), ("m.mesh", []), ("m.meshb", [])]:
    convert("source.vtu", target, *options)
    convert(target, "n.vtu")
    got, types, cells, arrays, _, _ = vtk_read("n.vtu")
    assert np.array_equal(got, points), (target, options)
    key = [tuple(c) + (l,) for c, l in zip(cells, arrays["label"])]
    assert sorted(key) == sorted([tuple(t) + (l,) for t, l in zip(tets.tolist(), labels)] + [tuple(range(8, 16)) + (3,), (4, 5, 6, 7, 16, 9)]), (target, options)
    # meshio cannot match element data to several blocks of one type: it reads a file without.
    mixed.cell_data.pop("quality", None)
    mixed.write(path("plain.vtu"))
    convert("plain.vtu", target, *options)
    other = meshio.read(path(target))
    assert np.array_equal(other.points, points), (target, options)
    tag = "medit:ref" if target.startswith("m.mesh") else "gmsh:physical"
    counts = {}
    for block, values in zip(other.cells, other.cell_data[tag]):
        for cell, value in zip(block.data, values):
            counts.setdefault(block.type, []).append((tuple(int(n) for n in cell), int(value)))
    assert sorted(counts["tetra"]) == sorted((tuple(t), l) for t, l in zip(tets.tolist(), labels)), (target, options)
    assert len(counts["triangle"]) > 0 and len(counts["quad"]) > 0

import gmsh
gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
for options in ([], ["--ascii"], ["--format-version", "2.2"], ["--format-version", "2.2", "--ascii"]):
    convert("source.vtu", "g.msh", *options)
    gmsh.open(path("g.msh"))
    tags, nodes, _ = gmsh.model.mesh.getNodes()
    assert np.array_equal(nodes.reshape(-1, 3)[np.argsort(tags)], points), options
    quality = gmsh.model.mesh.getElementQualities(gmsh.model.mesh.getElementsByType(4)[0], "minSJ")
    assert (np.array(quality) > 0).all()
    assert len(gmsh.model.getPhysicalGroups(3)) == 5
    for version in (2.2, 4.1):
        for binary in (0, 1):
            gmsh.option.setNumber("Mesh.MshFileVersion", version)
            gmsh.option.setNumber("Mesh.Binary", binary)
            gmsh.write(path("h.msh"))
            assert info("h.msh")["labels"] == reference["labels"], (version, binary)
    gmsh.clear()
gmsh.finalize()

# VTK's own files in every encoding.
reader = vtk.vtkXMLUnstructuredGridReader()
reader.SetFileName(path("source.vtu"))
reader.Update()
for mode, packed, width in itertools.product(("ascii", "binary", "appended", "rawappended"), (0, 1), (32, 64)):
    writer = vtk.vtkXMLUnstructuredGridWriter()
    writer.SetFileName(path("v.vtu")), writer.SetInputData(reader.GetOutput())
    {"ascii": writer.SetDataModeToAscii, "binary": writer.SetDataModeToBinary}.get(mode, writer.SetDataModeToAppended)()
    writer.SetEncodeAppendedData(mode == "appended")
    (writer.SetCompressorTypeToZLib if packed else writer.SetCompressorTypeToNone)()
    (writer.SetHeaderTypeToUInt32 if width == 32 else writer.SetHeaderTypeToUInt64)()
    assert writer.Write()
    convert("v.vtu", "w.vtu")
    same_as_source("w.vtu")
for version, binary in itertools.product((42, 51), (0, 1)):
    writer = vtk.vtkUnstructuredGridWriter()
    writer.SetFileName(path("v.vtk")), writer.SetInputData(reader.GetOutput()), writer.SetFileVersion(version)
    (writer.SetFileTypeToBinary if binary else writer.SetFileTypeToASCII)()
    writer.Write()
    convert("v.vtk", "w.vtu")
    if binary:
        same_as_source("w.vtu")
    assert info("w.vtu")["labels"] == reference["labels"]

# Quadratic tets.
p2 = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
edges = [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]
nodes = np.vstack([p2, [(p2[a] + p2[b]) / 2 for a, b in edges]])
meshio.Mesh(nodes, [("tetra10", [list(range(10))])], cell_data={"label": [np.array([4], np.int32)]}).write(path("q.vtu"))
for target in ("q.msh", "q.mesh", "q.meshb", "q.vtk"):
    convert("q.vtu", target)
    convert(target, "r.vtu")
    assert vtk_read("r.vtu")[2] == [list(range(10))], target
    if target in ("q.msh", "q.vtk"):  # meshio knows no quadratic tets of MEDIT
        other = meshio.read(path(target))
        block = [b for b in other.cells if b.type == "tetra10"][0]
        assert block.data.tolist() == [list(range(10))], target

# Surfaces.
surface = meshio.Mesh(points[:8], [("triangle", [[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4], [1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]])])
for source in ("off", "obj", "stl", "ply", "vtk", "mesh"):
    surface.write(path(f"s.{source}"), **({"binary": False} if source in ("stl", "vtk") else {}))
    assert info(f"s.{source}")["triangles"] == 12
    for target in ("off", "obj", "stl", "ply", "vtk", "vtp", "mesh", "msh", "surf"):
        convert(f"s.{source}", f"t.{target}", "--ascii")
        assert info(f"t.{target}")["points"] == 8, (source, target)
        convert(f"t.{target}", "u.off")
        back = np.loadtxt(path("u.off"), skiprows=2, max_rows=8)
        assert np.array_equal(np.array(sorted(map(tuple, back))), np.array(sorted(map(tuple, points[:8])))), (source, target)
convert("s.off", "t.vtp")
reader = vtk.vtkXMLPolyDataReader()
reader.SetFileName(path("t.vtp")), reader.Update()
assert reader.GetOutput().GetNumberOfCells() == 12
print("meshes: VTK, meshio, Gmsh and we read each other")
