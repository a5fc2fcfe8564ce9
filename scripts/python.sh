#!/usr/bin/env bash
# A Python environment under target/ with the packages that the demo (usage: python.sh demo) or the tests (without an argument) use.
set -euo pipefail
cd "$(dirname "$0")/.."
environment=${CARGO_TARGET_DIR:-target}/python
wanted=(scripts/requirements.txt)
[ "${1:-test}" = demo ] || wanted+=(tests/python/requirements.txt)
[ -x "$environment/bin/python" ] || python3 -m venv "$environment"
stamp=$environment/installed-${#wanted[@]}
if ! cat "${wanted[@]}" | cmp -s - "$stamp"; then
    "$environment/bin/python" -m pip install --quiet --disable-pip-version-check "${wanted[@]/#/-r}"
    cat "${wanted[@]}" > "$stamp"
fi
