#!/usr/bin/env bash
# Chromium, for the tests that look at the viewer and at pages: through apt when run as root; elsewhere a word on it.
set -euo pipefail
for name in chromium chromium-browser google-chrome; do
  command -v "$name" >/dev/null && exit 0
done
if [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null; then
  echo "installing chromium for the browser's tests"
  export DEBIAN_FRONTEND=noninteractive
  apt-get update && exec apt-get install -y --no-install-recommends chromium
fi
echo "no Chromium in PATH: the tests that need a browser will be skipped (sudo apt-get install chromium)" >&2
