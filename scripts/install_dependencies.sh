#!/usr/bin/env bash
# Installs from the distribution what the demo (usage: install_dependencies.sh demo) or the tests (without an argument) need and
# this machine lacks. Rust itself is expected.
set -euo pipefail
packages=(gcc libc6-dev mricron-data python3 python3-venv)
if [ "${1:-test}" != demo ]; then
    packages+=(build-essential cmake pkg-config clang valgrind abigail-tools libvtk9-dev libcgal-dev libtet1.5-dev tetgen
        openfoam xvfb xauth)
fi
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
