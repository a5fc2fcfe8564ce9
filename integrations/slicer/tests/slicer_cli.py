"""Runs a command-line module through 3D Slicer's own module logic, headless, from the `slicer-core` wheel.

The wheel has no Qt module factory, so that what the factory does (ask the executable for its XML, parse it, hand the description
to the logic) is done here through ctypes on the wheel's own libraries. The wheel keeps the old `std::string` ABI.
"""

import ctypes
import glob
import os
import subprocess
import tempfile
import time

import slicer_core as slicer

_FOLDER = os.path.dirname(slicer.__file__)
_CXX = ctypes.CDLL("libstdc++.so.6")
_LOGIC = ctypes.CDLL(os.path.join(_FOLDER, "libvtkSlicerBaseLogic.so"))
_PARSER = ctypes.CDLL(glob.glob(os.path.join(_FOLDER, "third_party.libs", "libModuleDescriptionParser.so*"))[0])
_DESCRIPTION_BYTES = 65536  # larger than any ModuleDescription, whose size the wheel does not tell


def _call(library, symbol, *arguments, result=None):
    function = getattr(library, symbol)
    function.argtypes = [ctypes.c_void_p] * len(arguments)
    function.restype = result
    return function(*[ctypes.addressof(a) if isinstance(a, ctypes.Array) else a for a in arguments])


def _std_string(text):
    storage, allocator = (ctypes.c_char * 16)(), (ctypes.c_char * 8)()
    characters = ctypes.create_string_buffer(text.encode())
    _call(_CXX, "_ZNSsC1EPKcRKSaIcE", storage, characters, allocator)
    storage._keep_alive = characters
    return storage


def describe(command):
    """The module description of an executable, parsed by Slicer's parser."""
    xml = subprocess.run([command, "--xml"], capture_output=True, text=True, check=True).stdout
    description = (ctypes.c_char * _DESCRIPTION_BYTES)()
    _call(_PARSER, "_ZN17ModuleDescriptionC1Ev", description)
    parser = (ctypes.c_char * 64)()
    if _call(_PARSER, "_ZN23ModuleDescriptionParser5ParseERKSsR17ModuleDescription", parser, _std_string(xml), description, result=ctypes.c_int):
        raise RuntimeError("Slicer's parser refuses the XML of " + command)
    for name, value in (("SetType", "CommandLineModule"), ("SetTarget", command), ("SetLocation", command)):
        _call(_PARSER, f"_ZN17ModuleDescription{len(name)}{name}ERKSs", description, _std_string(value))
    return description


class SlicerModule:
    """One command-line module in a scene of its own."""

    def __init__(self, command):
        folder = tempfile.mkdtemp()
        self.scene = slicer.vtkMRMLScene()
        cache = slicer.vtkCacheManager()
        cache.SetRemoteCacheDirectory(folder)
        cache.SetMRMLScene(self.scene)
        self.scene.SetCacheManager(cache)
        self.scene.RegisterNodeClass(slicer.vtkMRMLCommandLineModuleNode())
        self.application = slicer.vtkSlicerApplicationLogic()
        self.application.SetTemporaryPath(folder)
        self.application.SetMRMLScene(self.scene)
        self.application.CreateProcessingThread()  # without it outputs are silently not loaded
        self.logic = slicer.vtkSlicerCLIModuleLogic()
        self.logic.SetMRMLApplicationLogic(self.application)
        self.logic.SetMRMLScene(self.scene)
        self.folder = folder
        self._description = describe(os.path.abspath(command))
        _call(
            _LOGIC,
            "_ZN23vtkSlicerCLIModuleLogic27SetDefaultModuleDescriptionERK17ModuleDescription",
            int(self.logic.__this__.split("_")[1], 16),
            self._description,
        )
        self.node = self.logic.CreateNodeInScene()

    def add(self, node):
        self.scene.AddNode(node)
        return node

    def run(self, cancel_at=None, timeout=300):
        """Runs to the end; returns the list of (status, percent) seen on the way."""
        seen = []
        end = time.monotonic() + timeout
        self.logic.Apply(self.node, False)
        while time.monotonic() < end:
            self.application.ProcessModified()
            self.application.ProcessReadData()
            state = (self.node.GetStatusString(), self.node.GetProgress())
            if not seen or seen[-1] != state:
                seen.append(state)
            if cancel_at is not None and state[0] == "Running" and state[1] >= cancel_at:
                self.node.Cancel()
            if state[0].startswith(("Completed", "Cancelled")):
                return seen
            time.sleep(0.02)
        raise TimeoutError(f"no end after {timeout} s: {seen[-3:]}")

    def close(self):
        self.application.TerminateProcessingThread()
