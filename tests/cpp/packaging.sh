#!/usr/bin/env bash
# The package as its users meet it: install tree, moved install tree, build tree, pkg-config, add_subdirectory; and what
# the shared library looks like from outside. usage: packaging.sh SOURCE BUILD CMAKE
set -euo pipefail
source_dir=$1
build_dir=$2
cmake=$3
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
failed=0
fail() { echo "FAILED: $*" >&2; failed=1; }

# ---- the shared library from outside
library=$build_dir/lib/libmeshwright.so
version=$(sed -n 's/^version = "\(.*\)"/\1/p' "$source_dir/Cargo.toml" | head -1)
case $version in 0.*) abi=$(echo "$version" | cut -d. -f1,2) ;; *) abi=${version%%.*} ;; esac
readelf -d "$library" > "$work/dynamic"
grep -q "SONAME.*\[libmeshwright.so.$abi\]" "$work/dynamic" || fail "SONAME is not libmeshwright.so.$abi"
grep -q NODELETE "$work/dynamic" || fail "not linked with -z nodelete"
! grep -qE 'RPATH|RUNPATH|TEXTREL' "$work/dynamic" || fail "has an RPATH or TEXTREL"
needed=$(sed -n 's/.*(NEEDED).*\[\(.*\)\]/\1/p' "$work/dynamic" | grep -vE '^(libc|libm|libgcc_s)\.so|^ld-linux' || true)
[ -z "$needed" ] || fail "needs $needed"
nm -D --defined-only "$library" | awk '{print $3}' | sort > "$work/symbols"
diff "$source_dir/abi/symbols.txt" "$work/symbols" || fail "exported symbols differ from abi/symbols.txt"
size=$(stat -L -c %s "$library")
[ "$size" -lt $((15 * 1024 * 1024)) ] || fail "the shared library has $size bytes, the limit is 15 MB"

# ---- the four ways to use it
consumer() { # NAME, then options of the consumer project
    local name=$1
    shift
    if "$cmake" -S "$source_dir/cmake/consumer" -B "$work/$name" "$@" > "$work/$name.log" 2>&1 &&
        "$cmake" --build "$work/$name" >> "$work/$name.log" 2>&1 &&
        (cd "$work/$name" && ctest --output-on-failure) >> "$work/$name.log" 2>&1; then
        echo "consumer: $name: passed"
    else
        tail -40 "$work/$name.log" >&2
        fail "consumer: $name"
    fi
}

"$cmake" --install "$build_dir" --prefix "$work/installed" > "$work/install.log"
for file in include/meshwright.h include/meshwright.hpp lib*/libmeshwright.so lib*/libmeshwright.so.$abi \
    lib*/libmeshwright.so.$version lib*/libmeshwright.a bin/meshwright \
    share/doc/*/LICENSE-MIT share/doc/*/LICENSE-APACHE share/doc/*/THIRD_PARTY.md; do
    compgen -G "$work/installed/$file" > /dev/null || compgen -G "$work/installed/${file/lib\*/lib\*\/\*}" > /dev/null ||
        fail "$file is not installed"
done
consumer build_tree -DMeshwright_DIR="$build_dir"
consumer install_tree -DCMAKE_PREFIX_PATH="$work/installed"
mv "$work/installed" "$work/moved"
consumer moved_tree -DCMAKE_PREFIX_PATH="$work/moved"
pc=$(dirname "$(find "$work/moved" -name meshwright.pc)")
consumer pkg_config -DCONSUMER_WAY=pkgconfig -DCMAKE_BUILD_RPATH="$(dirname "$pc")" -DCMAKE_PREFIX_PATH="$work/moved"
PKG_CONFIG_PATH=$pc pkg-config --static --libs meshwright | grep -q -- -lm || fail "pkg-config --static"
consumer subdirectory -DCONSUMER_WAY=subdirectory -DCONSUMER_SUBDIRECTORY="$source_dir" \
    -DMESHWRIGHT_CARGO_TARGET_DIR="${CARGO_TARGET_DIR:-$work/cargo}" -DMESHWRIGHT_OFFLINE=ON -DMESHWRIGHT_BUILD_CLI=ON

exit $failed
