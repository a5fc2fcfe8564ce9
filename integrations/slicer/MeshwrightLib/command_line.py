"""Turns what a user chose into parameters of the command-line modules."""

IMAGE_PRESETS = {
    "Draft": {"lattice-spacing": 12.0, "fidelity": 0.7, "smoothing-iterations": 2},
    "Simulation (default)": {},
    "Fine": {"lattice-spacing": 4.0, "fidelity": 0.95},
    "Unsmoothed lattice": {"smoothing-iterations": 0},
}

SURFACE_PRESETS = {
    "Simulation (default)": {},
    "Surface only, no points inside": {"refine": "off"},
    "Coarse interior": {"growth-rate": 1.5},
    "High quality": {"quality-passes": 5},
}

REGISTRATION_PRESETS = {
    "Adaptive (resection)": {"tumor-resection": "on"},
    "Brain shift, nothing removed": {"tumor-resection": "off"},
}


def per_label_list(values):
    """`{3: 0.9, 1: 0.8}` as `1=0.8,3=0.9`; the order of labels is fixed so that equal choices give equal commands."""
    return ",".join(f"{label}={value:g}" for label, value in sorted(values.items()))


def parameters_of(preset, overrides, per_label):
    """Merges a preset, single values and per-label values; `per_label` maps a parameter to `{label: value}`."""
    merged = dict(preset)
    merged.update({name: value for name, value in overrides.items() if value is not None})
    for name, values in per_label.items():
        if values:
            merged[name + "-for"] = per_label_list(values)
    return merged


def set_cli_parameters(node, parameters):
    """Sets `parameters` on a CLI node; Slicer's names have underscores or none where flags have hyphens."""
    known = {name: name for name in parameter_names(node)}
    known.update({_plain(name): name for name in list(known)})
    unknown = [name for name in parameters if _plain(name) not in known]
    if unknown:
        raise ValueError("the command-line module has no parameter " + ", ".join(sorted(unknown)))
    for name, value in parameters.items():
        text = ("true" if value else "false") if isinstance(value, bool) else str(value)
        node.SetParameterAsString(known[_plain(name)], text)


def parameter_names(node):
    """All parameter names of a CLI node."""
    return [
        node.GetParameterName(group, index)
        for group in range(node.GetNumberOfParameterGroups())
        for index in range(node.GetNumberOfParametersInGroup(group))
    ]


def _plain(name):
    return name.replace("-", "").replace("_", "").lower()
