"""What a user may have chosen wrongly: each function raises ValueError with a sentence for the dialog. Needs MRML only."""

LOWEST_FIDELITY = 0.1  # of the parameter table


def check_segments(node, segment_ids):
    """A segmentation with at least one chosen segment that it holds."""
    _check_class(node, "vtkMRMLSegmentationNode", "a segmentation")
    if node.GetSegmentation() is None or node.GetSegmentation().GetNumberOfSegments() == 0:
        raise ValueError(f"The segmentation '{node.GetName()}' has no segments: add one in the Segment Editor.")
    if not segment_ids:
        raise ValueError("Tick at least one segment.")
    missing = [s for s in segment_ids if node.GetSegmentation().GetSegment(s) is None]
    if missing:
        raise ValueError("The segmentation no longer has the segment " + ", ".join(missing) + ".")


def check_volume(node, role):
    """A volume of three dimensions, with voxels."""
    _check_class(node, "vtkMRMLScalarVolumeNode", role)
    image = node.GetImageData()
    if image is None or image.GetNumberOfPoints() == 0:
        raise ValueError(f"The volume '{node.GetName()}' ({role}) has no voxels.")
    if min(image.GetDimensions()) < 2:
        raise ValueError(f"The volume '{node.GetName()}' ({role}) is a single slice; three dimensions are needed.")


def check_untransformed(nodes):
    """Volumes under no transform: a command-line module is given a volume without the transforms above it."""
    for node in nodes:
        if node.GetParentTransformNode() is not None:
            raise ValueError(f"'{node.GetName()}' is under the transform '{node.GetParentTransformNode().GetName()}': harden it first.")


def check_surface(node):
    """A model that is a surface with cells."""
    _check_class(node, "vtkMRMLModelNode", "a surface model")
    if node.GetMesh() is not None and node.GetPolyData() is None:
        raise ValueError(f"The model '{node.GetName()}' is a volume mesh; choose a surface.")
    if node.GetPolyData() is None or node.GetPolyData().GetNumberOfPolys() + node.GetPolyData().GetNumberOfStrips() == 0:
        raise ValueError(f"The model '{node.GetName()}' has no triangles.")


def check_different(node, other):
    """Input and output are not one node."""
    if node is not None and node is other:
        raise ValueError(f"'{node.GetName()}' is the input; choose another node for the output.")


def fidelity_of(text, segment_name):
    """The number of a fidelity field; None where it is empty."""
    text = text.strip().replace(",", ".")
    if not text:
        return None
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not LOWEST_FIDELITY <= value <= 1.0:
        raise ValueError(f"The fidelity '{text}' of segment '{segment_name}' is not a number from {LOWEST_FIDELITY} to 1.")
    return value


def _check_class(node, class_name, what):
    if node is None:
        raise ValueError(f"Choose {what}.")
    if not node.IsA(class_name):
        raise ValueError(f"'{node.GetName()}' is not {what}.")
