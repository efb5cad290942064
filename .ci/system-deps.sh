#!/usr/bin/env bash
# The system packages that pip cannot bring: a C++ compiler, Python's headers and venv, the shared libraries that open3d
# loads, and Mesa's EGL for MuJoCo's off-screen renderer. Installs through apt what is missing when run as root;
# otherwise prints the command and fails.
# Usage: .ci/system-deps.sh PYTHON
set -euo pipefail
python=$1

missing=()
need() { missing+=("$1"); }

libraries=$(PATH="$PATH:/sbin:/usr/sbin" ldconfig -p)
while read -r soname package; do
  grep -qF "$soname " <<<"$libraries" || need "$package"
done <<'TABLE'
libEGL.so.1 libegl1
libGL.so.1 libgl1
libX11.so.6 libx11-6
libusb-1.0.so.0 libusb-1.0-0
libudev.so.1 libudev1
libidn2.so.0 libidn2-0
libEGL_mesa.so.0 libegl-mesa0
TABLE
compgen -G '/usr/lib/*/dri/*swrast*' >/dev/null || compgen -G '/usr/lib/*/libgallium*' >/dev/null || need libgl1-mesa-dri
command -v c++ >/dev/null || need g++
"$python" -c 'import ensurepip, venv' 2>/dev/null || need python3-venv
"$python" -c 'import sysconfig, pathlib, sys; sys.exit(not (pathlib.Path(sysconfig.get_path("include")) / "Python.h").exists())' ||
  need python3-dev

[ ${#missing[@]} -eq 0 ] && exit 0
if [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null; then
  echo "installing system packages: ${missing[*]}"
  export DEBIAN_FRONTEND=noninteractive
  apt-get update
  exec apt-get install -y --no-install-recommends "${missing[@]}"
fi
cat >&2 <<TEXT
error: system packages are missing. Install them, then run make again:

    sudo apt-get update && sudo apt-get install -y --no-install-recommends ${missing[*]}

(On another distribution: the packages that bring these libraries and tools.)
TEXT
exit 1
