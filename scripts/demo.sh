#!/usr/bin/env bash
# Meshes the AAL atlas (116 regions, 1 mm) and draws it: mesh, statistics and picture in target/demo.
set -euo pipefail
cd "$(dirname "$0")/.."
target=${CARGO_TARGET_DIR:-target}
out=$target/demo
mkdir -p "$out"
atlas=$(find /usr/share/mricron /usr/share/data -name 'aal.nii.gz' 2> /dev/null | head -1)
[ -n "$atlas" ] || { echo "aal.nii.gz not found: is mricron-data installed?" >&2; exit 1; }
"$target/release/meshwright" image-to-mesh --image "$atlas" --output "$out/aal.vtu" --json "$out/aal.json"
scripts/python.sh
"$target/python/bin/python" scripts/draw_mesh.py "$out/aal.vtu" "$out/aal.json" "$out/aal.png"
ls -l "$out"
