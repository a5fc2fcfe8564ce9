#!/usr/bin/env bash
# Installs from the distribution what the tests and the demo need and this machine lacks. Rust itself is expected.
set -euo pipefail
packages=(build-essential cmake pkg-config clang valgrind abigail-tools libvtk9-dev libcgal-dev libtet1.5-dev tetgen
    mricron-data python3-venv)
missing=()
for package in "${packages[@]}"; do
    dpkg-query -W -f='${Status}' "$package" 2> /dev/null | grep -q "ok installed" || missing+=("$package")
done
if [ ${#missing[@]} -gt 0 ]; then
    echo "installing: ${missing[*]}"
    as_root=()
    [ "$(id -u)" -eq 0 ] || as_root=(sudo)
    "${as_root[@]}" apt-get update -qq
    DEBIAN_FRONTEND=noninteractive "${as_root[@]}" apt-get install -y -qq --no-install-recommends "${missing[@]}"
fi
command -v cargo > /dev/null || { echo "cargo not found: install Rust 1.88 or later" >&2; exit 1; }
