#!/usr/bin/env bash
# Runs every check, goes on after a failure, and counts. The last line is "N passed, N failed".
set -uo pipefail
cd "$(dirname "$0")/.."
export CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-$PWD/target}
# Tests need the release build soon rather than as fast as it gets: the same code, compiled in parts on all cores.
export CARGO_PROFILE_RELEASE_CODEGEN_UNITS=16
# Without inlining across the parts the library's tests take 58 s less to compile and 20 s more to run (measured: 290 + 104 s and
# 232 + 125 s).
export CARGO_PROFILE_RELEASE_LTO=off
logs=$CARGO_TARGET_DIR/test-logs
build=$CARGO_TARGET_DIR/cmake
mkdir -p "$logs"
passed=0
failed=0
failures=()
declare -A jobs_by_name
started=$SECONDS

# step NAME COMMAND...: one check; its output is shown when it fails.
step() {
    local name=$1 begin=$SECONDS
    shift
    if "$@" > "$logs/$name.log" 2>&1; then
        passed=$((passed + 1))
        echo "ok      $name ($((SECONDS - begin)) s)"
        return 0
    else
        failed=$((failed + 1))
        failures+=("$name")
        echo "FAILED  $name ($((SECONDS - begin)) s), $logs/$name.log:"
        tail -60 "$logs/$name.log"
        return 1
    fi
}

# counted NAME READER COMMAND...: a command that runs many tests; READER takes "passed failed" from its log.
counted() {
    local name=$1 reader=$2 begin=$SECONDS status=0 good bad
    shift 2
    "$@" > "$logs/$name.log" 2>&1 || status=$?
    read -r good bad < <($reader "$logs/$name.log")
    # A command that fails without a failed test (it did not build, it crashed) is a failure too.
    [ $status -eq 0 ] || [ "$bad" -gt 0 ] || bad=1
    passed=$((passed + good))
    failed=$((failed + bad))
    if [ "$bad" -gt 0 ] || [ $status -ne 0 ]; then
        failures+=("$name")
        echo "FAILED  $name: $good passed, $bad failed ($((SECONDS - begin)) s), $logs/$name.log:"
        grep -nE "^(error|test .*FAILED|FAILED |failures:|thread .* panicked|.*\*\*\*(Failed|Timeout|Exception))" -A8 \
            "$logs/$name.log" | head -120
        tail -20 "$logs/$name.log"
    else
        echo "ok      $name: $good passed ($((SECONDS - begin)) s)"
    fi
}
# background NAME COMMAND...: begins a command beside the next checks; `step NAME finished NAME` ends it.
background() {
    local name=$1
    shift
    "$@" > "$logs/$name.background.log" 2>&1 &
    jobs_by_name[$name]=$!
}
finished() {
    local status=0
    wait "${jobs_by_name[$1]}" || status=$?
    cat "$logs/$1.background.log"
    return $status
}
# kept NAME COMMAND...: runs a command within a background one; `step NAME told NAME` tells what it said once that is finished.
kept() {
    local name=$1 status=0
    shift
    "$@" > "$logs/$name.background.log" 2>&1 || status=$?
    echo "$status" > "$logs/$name.status"
}
told() {
    cat "$logs/$1.background.log"
    return "$(cat "$logs/$1.status")"
}
# Python programs that compare with SimpleITK, meshio, Gmsh and others, and tests of the integrations, where their folder brings a
# script for it; each is one check.
python_checks=(tests/python/check_*.py)
integrations=(integrations/*/run_tests.sh)
name_of_integration() {
    basename "$(dirname "$1")"
}
others() {
    local script python=$CARGO_TARGET_DIR/python/bin/python
    for script in "${python_checks[@]}"; do
        kept "$(basename "$script" .py)" "$python" "$script" "$CARGO_TARGET_DIR/release/meshwright"
    done
    for script in "${integrations[@]}"; do
        kept "$(name_of_integration "$script")" env MESHWRIGHT="$CARGO_TARGET_DIR/release/meshwright" PYTHON="$python" \
            MESHWRIGHT_BUILD="$build" "$script"
    done
}
read_cargo() {
    awk '/^test result:/ { good += $4; bad += $6 } END { print good + 0, bad + 0 }' "$1"
}
read_ctest() {
    awk '/tests passed,/ { bad = $4; all = $9 } /out of/ { for (i = 1; i < NF; i++) if ($i == "of") all = $(i + 1) }
         END { print all - bad + 0, bad + 0 }' "$1"
}
# The library's own tests, with its internal assertions on. They share the dependencies of the release build, where only this
# crate differs; at level 1 it takes a sixth less time to compile than at 2, and the tests a tenth more (measured: 231 + 148 s
# and 277 + 135 s).
library_tests() {
    local ours=profile.release.package.meshwright
    cargo test --locked --no-fail-fast --release --lib --config $ours.opt-level=1 \
        --config $ours.debug-assertions=true --config $ours.overflow-checks=true
}

# The release build and the checks that need no code lock different folders of cargo's target.
step configure cmake -S . -B "$build" -DCMAKE_BUILD_TYPE=Release -DMESHWRIGHT_CARGO_TARGET_DIR="$CARGO_TARGET_DIR"
background build cmake --build "$build" -j "$(nproc)"
background python scripts/python.sh
step format cargo fmt --check
step clippy cargo clippy --locked --all-targets --quiet -- -D warnings
step licences python3 scripts/third_party.py --check THIRD_PARTY.md
step rustdoc env RUSTDOCFLAGS="-D warnings" cargo doc --locked --no-deps --lib --quiet
step build finished build
background ctest ctest --test-dir "$build" -j "$(nproc)" --output-on-failure --no-tests=error
step python finished python
# The library's tests leave a core free while the compiler reads the crate.
rm -f "$logs"/*.status
background others others
counted library read_cargo library_tests
# Tests from outside run the library that is built anyway.
counted interfaces read_cargo cargo test --locked --no-fail-fast --release --bins --test '*'
counted documentation read_cargo cargo test --locked --no-fail-fast --release --doc
counted ctest read_ctest finished ctest
step abi scripts/check_abi.sh
finished others > /dev/null
for script in "${python_checks[@]}"; do
    name=$(basename "$script" .py)
    step "$name" told "$name"
done
for script in "${integrations[@]}"; do
    name=$(name_of_integration "$script")
    step "$name" told "$name"
    grep -h "^SKIPPED" "$logs/$name.log" || true
done

echo "in $(((SECONDS - started) / 60)) min $(((SECONDS - started) % 60)) s"
[ ${#failures[@]} -eq 0 ] || echo "failed: ${failures[*]}"
echo "$passed passed, $failed failed"
[ $failed -eq 0 ]
