#!/usr/bin/env bash
# Meshes the AAL atlas (116 regions, 1 mm) and draws it: mesh, statistics and picture in demo/.
set -euo pipefail
cd "$(dirname "$0")/.."
target=${CARGO_TARGET_DIR:-target}
mkdir -p demo
atlas=/usr/share/mricron/templates/aal.nii.gz
[ -f "$atlas" ] || { echo "$atlas not found: install mricron-data" >&2; exit 1; }
"$target/release/meshwright" image-to-mesh --image "$atlas" --output demo/aal.vtu --json demo/aal.json
"$target/release/meshwright" quality demo/aal.vtu
scripts/python.sh demo
"$target/python/bin/python" scripts/draw_mesh.py demo/aal.vtu demo/aal.png
ls -l demo
