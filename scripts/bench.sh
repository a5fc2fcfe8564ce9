#!/usr/bin/env bash
# Runs every benchmark under benches/ and prints one CSV row per case.
set -euo pipefail
cd "$(dirname "$0")/.."
for script in benches/*.sh; do
    [ ! -e "$script" ] || bash "$script"
done
