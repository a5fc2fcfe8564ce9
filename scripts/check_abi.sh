#!/usr/bin/env bash
# Compares the exported symbols and the C types of the shared library with abi/. `--update` writes abi/ anew.
# The types are those of the header, which is made from the exported functions and checked against them: a C compiler lays them out.
set -euo pipefail
cd "$(dirname "$0")/.."
target=${CARGO_TARGET_DIR:-target}
cargo build --quiet --release --locked --lib --bins
library=$target/release/libmeshwright.so
stubs=$target/release/abi_stubs.so
symbols() { nm -D --defined-only "$1" | awk '{print $3}' | sort; }
# Every declared function gets a body, so that the debug information tells of it.
soname=$(readelf -d "$library" | sed -n 's/.*SONAME.*\[\(.*\)\]/\1/p')
sed -E '/^MW_API /,/\);$/ s/\);$/) { __builtin_trap(); }/' include/meshwright.h |
    ${CC:-cc} -g -O0 -shared -fPIC -Wl,-soname,"$soname" -o "$stubs" -x c -
dump() { abidw --no-corpus-path --no-comp-dir-path --no-show-locs --drop-undefined-syms "$stubs"; }
if [ "${1:-}" = "--update" ]; then
    symbols "$library" > abi/symbols.txt
    dump > abi/meshwright.abi
    exit
fi
for exporter in "$library" "$stubs"; do
    symbols "$exporter" | diff abi/symbols.txt - || { echo "the exported symbols changed: make abi, if meant" >&2; exit 1; }
done
dump > "$target/release/now.abi"
if ! abidiff abi/meshwright.abi "$target/release/now.abi"; then
    echo "the ABI changed: make abi, if meant, and a new minor version where it is no addition" >&2
    exit 1
fi
