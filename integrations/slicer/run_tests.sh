#!/usr/bin/env bash
# Runs the binary MESHWRIGHT as Slicer's command-line modules, headless, with the Python PYTHON; needs the slicer-core wheel.
set -euo pipefail
cd "$(dirname "$0")"
export MESHWRIGHT_EXECUTABLE=${MESHWRIGHT:?the meshwright binary}
python=${PYTHON:-python3}
if ! "$python" -c "import slicer_core" 2>/dev/null; then
    echo "SKIPPED: the slicer-core wheel is not installed, so Slicer's module logic was not run"
    exit 0
fi
# The three scripted modules must at least be valid Python.
"$python" -m compileall -q MeshwrightLib MeshwrightImageMesher MeshwrightSurfaceMesher MeshwrightRegistration
"$python" -m json.tool Meshwright.json > /dev/null
exec "$python" -m pytest -q -p no:cacheprovider tests
