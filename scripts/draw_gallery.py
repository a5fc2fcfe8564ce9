"""Draws what the examples wrote, for docs/gallery.md.

Usage: draw_gallery.py FOLDER_THE_EXAMPLES_RAN_IN OUTPUT_FOLDER       (needs numpy, vtk, matplotlib)
"""
import gzip, os, sys

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import vtk

SOURCE, TARGET = sys.argv[1], sys.argv[2]
COLORS = {0: (0.75, 0.78, 0.82), 1: (0.80, 0.68, 0.55), 2: (0.75, 0.20, 0.20)}


def actor(data, color, edges=True):
    mapper = vtk.vtkDataSetMapper()
    mapper.SetInputData(data)
    mapper.ScalarVisibilityOff()
    result = vtk.vtkActor()
    result.SetMapper(mapper)
    result.GetProperty().SetColor(color)
    result.GetProperty().SetEdgeVisibility(edges)
    result.GetProperty().SetEdgeColor(0.25, 0.25, 0.25)
    result.GetProperty().SetLineWidth(0.7)
    return result


def whole_cells_behind(mesh, origin, normal):
    """The cells of which every point lies on the side that the normal points away from."""
    plane = vtk.vtkPlane()
    plane.SetOrigin(origin)
    plane.SetNormal(normal)
    cut = vtk.vtkExtractGeometry()
    cut.SetInputData(mesh)
    cut.SetImplicitFunction(plane)
    cut.Update()
    return cut.GetOutput()


def cells_of_label(mesh, label):
    threshold = vtk.vtkThreshold()
    threshold.SetInputData(mesh)
    threshold.SetInputArrayToProcess(0, 0, 0, vtk.vtkDataObject.FIELD_ASSOCIATION_CELLS, "label")
    threshold.SetLowerThreshold(label), threshold.SetUpperThreshold(label)
    threshold.Update()
    return threshold.GetOutput()


def draw(name, actors, position, focus, zoom, up=(0, 0, 1)):
    renderer = vtk.vtkRenderer()
    renderer.SetBackground(1, 1, 1)
    for item in actors:
        renderer.AddActor(item)
    window = vtk.vtkRenderWindow()
    window.SetOffScreenRendering(1)
    window.SetSize(900, 620)
    window.SetMultiSamples(8)
    window.AddRenderer(renderer)
    camera = renderer.GetActiveCamera()
    camera.SetPosition(position), camera.SetFocalPoint(focus), camera.SetViewUp(up)
    if zoom:
        renderer.ResetCamera()
        camera.Zoom(zoom)
    renderer.ResetCameraClippingRange()
    window.Render()
    picture = vtk.vtkWindowToImageFilter()
    picture.SetInput(window)
    writer = vtk.vtkPNGWriter()
    writer.SetFileName(os.path.join(TARGET, name))
    writer.SetInputConnection(picture.GetOutputPort())
    writer.Write()


def read_vtu(name):
    reader = vtk.vtkXMLUnstructuredGridReader()
    reader.SetFileName(os.path.join(SOURCE, name))
    reader.Update()
    return reader.GetOutput()


def draw_image_mesh():
    half = whole_cells_behind(read_vtu("01_mesh_image.vtu"), (0, 3, 0), (0, -1, 0))
    draw("gallery_image.png", [actor(cells_of_label(half, label), COLORS[label]) for label in (1, 2)], (20, -100, 40), (0, 0, 0), 1.25)


def draw_aircraft():
    """The OpenFOAM case, read by VTK: the skin, and the elements behind the plane of symmetry."""
    reader = vtk.vtkOpenFOAMReader()
    reader.SetFileName(os.path.join(SOURCE, "07_aircraft_case", "aircraft.foam"))
    reader.UpdateInformation()
    reader.EnableAllPatchArrays()
    reader.Update()
    blocks = reader.GetOutput().NewIterator()
    blocks.InitTraversal()
    parts = {}
    while not blocks.IsDoneWithTraversal():
        parts[blocks.GetCurrentMetaData().Get(vtk.vtkCompositeDataSet.NAME())] = blocks.GetCurrentDataObject()
        blocks.GoToNextItem()
    volume = whole_cells_behind(parts["internalMesh"], (0, 0.5, 0), (0, -1, 0))
    draw("gallery_aircraft.png", [actor(parts["aircraft"], (0.35, 0.5, 0.75)), actor(volume, (0.9, 0.9, 0.88))], (-20, -52, 34), (8, -1, 0), None)


def read_nrrd(name):
    """Voxels of an attached, little-endian NRRD file of reals, x fastest last; VTK's reader refuses a fourth axis."""
    header, voxels = open(os.path.join(SOURCE, name), "rb").read().split(b"\n\n", 1)
    fields = dict(line.split(": ", 1) for line in header.decode().splitlines() if ": " in line)
    voxels = gzip.decompress(voxels) if fields["encoding"] in ("gzip", "gz") else voxels
    return np.frombuffer(voxels, {"float": "<f4", "double": "<f8"}[fields["type"]]).reshape([int(n) for n in fields["sizes"].split()][::-1])


def draw_registration():
    """A slice of the displacement field's length and of the warped scan."""
    warped, displacement = read_nrrd("08_warped.nrrd"), read_nrrd("08_displacement.nrrd")
    middle = warped.shape[1] // 2
    length = np.linalg.norm(displacement[:, middle], axis=-1)
    slices = [warped[:, middle], np.where(warped[:, middle] > 0, length, np.nan)]  # nothing is known of the air
    figure, axes = plt.subplots(1, 2, figsize=(9, 4.2), constrained_layout=True)
    axes[0].imshow(slices[0], cmap="gray", origin="lower")
    axes[0].set_title("the moving scan, warped")
    shown = axes[1].imshow(slices[1], cmap="viridis", origin="lower")
    figure.colorbar(shown, ax=axes[1], label="mm")
    axes[1].set_title("length of the displacement")
    figure.savefig(os.path.join(TARGET, "gallery_registration.png"), dpi=100)


draw_image_mesh()
draw_aircraft()
draw_registration()
