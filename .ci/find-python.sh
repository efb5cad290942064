#!/usr/bin/env bash
# Prints the Python to build the virtual environment with: $PYTHON if set, else python3.11, else any python3 >= 3.11.
# Each candidate is run, because a pyenv shim may exist for a version that is not installed.
set -euo pipefail
for candidate in ${PYTHON:-python3.11 python3}; do
  if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
    command -v "$candidate"
    exit 0
  fi
done
echo "error: no Python >= 3.11 (tried: ${PYTHON:-python3.11, python3}). On Debian 12: apt-get install python3 python3-venv; or set PYTHON=/path/to/python3.11." >&2
exit 1
