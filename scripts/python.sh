#!/usr/bin/env bash
# A Python environment under target/ with the packages that the tests in tests/python and the demo use.
set -euo pipefail
cd "$(dirname "$0")/.."
environment=${CARGO_TARGET_DIR:-target}/python
[ -x "$environment/bin/python" ] || python3 -m venv "$environment"
stamp=$environment/requirements.txt
if ! cmp -s tests/python/requirements.txt "$stamp"; then
    "$environment/bin/python" -m pip install --quiet --disable-pip-version-check -r tests/python/requirements.txt
    cp tests/python/requirements.txt "$stamp"
fi
