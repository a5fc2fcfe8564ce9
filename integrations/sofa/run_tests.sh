#!/usr/bin/env bash
# Builds the plugin and runs its test where SOFA is installed (CMAKE_PREFIX_PATH or Sofa.Config_DIR), against the Meshwright built by
# the top-level CMake project in MESHWRIGHT_BUILD. Says plainly that it skipped where SOFA is not there.
set -euo pipefail
cd "$(dirname "$0")"
build=$(mktemp -d)
trap 'rm -rf "$build"' EXIT
cat > "$build/CMakeLists.txt" <<'CMAKE'
cmake_minimum_required(VERSION 3.22)
project(probe LANGUAGES CXX)
find_package(Sofa.Config QUIET)
if(NOT Sofa.Config_FOUND)
  message(FATAL_ERROR "no SOFA")
endif()
CMAKE
if ! cmake -S "$build" -B "$build/probe" > /dev/null 2>&1; then
    echo "SKIPPED: SOFA is not installed, so the plugin was not built; set CMAKE_PREFIX_PATH to a SOFA v24.12 or later"
    exit 0
fi
cmake -S . -B "$build/plugin" -DCMAKE_BUILD_TYPE=Release -DSOFAMESHWRIGHT_BUILD_TESTS=ON \
    ${MESHWRIGHT_BUILD:+-DMeshwright_DIR="$MESHWRIGHT_BUILD"}
cmake --build "$build/plugin"
ctest --test-dir "$build/plugin" --output-on-failure
