#!/usr/bin/env bash
# Compares the exported symbols and the C types of the shared library with abi/. `--update` writes abi/ anew.
# The types are read from the debug information of the release build.
set -euo pipefail
cd "$(dirname "$0")/.."
target=${CARGO_TARGET_DIR:-target}
cargo build --quiet --release --locked --lib --bins
library=$target/release/libmeshwright.so
symbols() { nm -D --defined-only "$library" | awk '{print $3}' | sort; }
dump() { abidw --no-corpus-path --no-comp-dir-path --drop-undefined-syms "$library" | python3 scripts/prune_abi.py; }
if [ "${1:-}" = "--update" ]; then
    symbols > abi/symbols.txt
    dump > abi/meshwright.abi
    exit
fi
symbols | diff abi/symbols.txt - || { echo "the exported symbols changed: make abi, if meant" >&2; exit 1; }
dump > "$target/release/now.abi"
if ! abidiff abi/meshwright.abi "$target/release/now.abi"; then
    echo "the ABI changed: make abi, if meant, and a new minor version where it is no addition" >&2
    exit 1
fi
