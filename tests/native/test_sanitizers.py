"""The C++ core under the sanitizers: its own test program, which needs no Python, built and run."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

NATIVE = Path(__file__).parents[2] / "splatbot" / "native"


def tool(name: str) -> str | None:
    """Return a build tool of this environment or of the system."""
    beside_python = Path(sys.executable).parent / name
    return str(beside_python) if beside_python.exists() else shutil.which(name)


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.timeout(1500)
@pytest.mark.parametrize(
    ("sanitizers", "portable"),
    [("address,undefined", False), ("thread,undefined", True)],
    ids=["memory and undefined behaviour", "data races and undefined behaviour, with the kernels of any CPU"],
)
def test_the_core_runs_clean_under_sanitizers(sanitizers: str, portable: bool, tmp_path: Path) -> None:
    cmake = tool("cmake")
    if cmake is None or not any(map(shutil.which, ("c++", "g++", "clang++"))):
        pytest.skip("no cmake or no C++ compiler: the sanitizer build needs both")
    ninja = tool("ninja")
    generator = ["-G", "Ninja", f"-DCMAKE_MAKE_PROGRAM={ninja}"] if ninja else []
    options = [f"-DSPLATBOT_SANITIZE={sanitizers}", f"-DSPLATBOT_PORTABLE={'ON' if portable else 'OFF'}"]
    options.append(f"-DPython_EXECUTABLE={sys.executable}")  # its packages hold Eigen's headers
    subprocess.run([cmake, "-S", str(NATIVE), "-B", str(tmp_path), *generator, *options], check=True)
    subprocess.run([cmake, "--build", str(tmp_path), "--parallel", "2"], check=True)
    environment = {k: v for k, v in os.environ.items() if k not in ("SPLATBOT_ISA", "SPLATBOT_NUM_THREADS")}
    done = subprocess.run(
        [str(tmp_path / "native_tests")], capture_output=True, text=True, env=environment, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "all promises kept" in done.stdout
