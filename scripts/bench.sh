#!/usr/bin/env bash
# Runs every benchmark under benches/: one CSV row per case.
set -euo pipefail
cd "$(dirname "$0")/.."
cargo bench --locked --benches
for script in benches/*.sh; do
    [ ! -e "$script" ] || bash "$script"
done
