#!/usr/bin/env bash
# Cross-compiles the native tests for arm64 and runs them under qemu-user. Prints "skipped" and what is missing, and
# exits 0, where the cross-compiler or qemu is not installed; a failing test fails.
set -euo pipefail
cd "$(dirname "$0")/.."

build=${ARM64_BUILD:-build/arm64}
compiler=$(command -v aarch64-linux-gnu-g++ || true)
qemu=$(command -v qemu-aarch64-static || command -v qemu-aarch64 || true)
cmake=$(command -v cmake || ls .venv/bin/cmake 2>/dev/null || true)
sysroot=/usr/aarch64-linux-gnu

missing=()
[ -n "$compiler" ] || missing+=("aarch64-linux-gnu-g++ (apt-get install g++-aarch64-linux-gnu)")
[ -n "$qemu" ] || missing+=("qemu-aarch64 (apt-get install qemu-user-static)")
[ -n "$cmake" ] || missing+=("cmake (make check installs it into .venv)")
if [ ${#missing[@]} -gt 0 ]; then
  printf 'missing: %s\n' "${missing[@]}"
  echo "arm64: skipped"
  exit 0
fi

"$cmake" -S splatbot/native -B "$build" \
  -DCMAKE_SYSTEM_NAME=Linux -DCMAKE_SYSTEM_PROCESSOR=aarch64 -DCMAKE_CXX_COMPILER="$compiler" \
  -DSPLATBOT_NATIVE_TESTS=ON -DSPLATBOT_WERROR=ON
"$cmake" --build "$build" --parallel "${ARM64_JOBS:-2}"
"$qemu" -L "$sysroot" "$build/native_tests"
echo "arm64: passed"
