"""The scripts of arm64: the tools that they need, and the wheel that the cross-compiler builds and qemu runs."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
AARCH64 = 183
"""The machine EM_AARCH64 in bytes 18 and 19 of an ELF header."""


@pytest.mark.parametrize("script", ["arm64.sh", "arm64-wheel.sh"])
def test_a_machine_without_the_tools_names_each_and_builds_nothing(script: str, tmp_path: Path) -> None:
    for name in ("bash", "dirname", "id", "ls", "realpath"):
        (tmp_path / name).symlink_to(shutil.which(name) or name)
    environment = {"PATH": str(tmp_path), "ARM64_BUILD": str(tmp_path / "b"), "ARM64_WHEEL_BUILD": str(tmp_path / "b")}
    done = subprocess.run(
        [str(ROOT / ".ci" / script)], env=environment, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "missing: aarch64-linux-gnu-g++ (apt-get install g++-aarch64-linux-gnu)" in done.stdout
    assert "missing: qemu-aarch64 (apt-get install qemu-user-static)" in done.stdout
    assert done.stdout.endswith(": skipped\n")
    assert not (tmp_path / "b").exists()


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.timeout(2400)
def test_the_arm64_wheel_renders_and_answers_as_this_machine_does(tmp_path: Path) -> None:
    tools = ("aarch64-linux-gnu-g++", "qemu-aarch64-static", "apt-get")
    if absent := [tool for tool in tools if not shutil.which(tool)]:
        pytest.skip(f"no {', '.join(absent)}: apt-get install g++-aarch64-linux-gnu qemu-user-static")
    environment = os.environ | {"ARM64_WHEEL_BUILD": str(tmp_path)}
    done = subprocess.run(
        [str(ROOT / ".ci" / "arm64-wheel.sh")], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    if done.stdout.endswith("arm64 wheel: skipped\n"):
        pytest.skip(done.stdout)
    (wheel,) = (tmp_path / "wheel").iterdir()
    assert re.fullmatch(r"splatbot-[\d.]+-cp311-cp311-manylinux_2_\d+_aarch64\.whl", wheel.name)
    with zipfile.ZipFile(wheel) as files:
        headers = [files.read(name)[:20] for name in files.namelist() if name.endswith(".so")]
    assert [header[:4] for header in headers] == [b"\x7fELF"] * 2
    assert [int.from_bytes(header[18:20], "little") for header in headers] == [AARCH64] * 2
    assert done.stdout.endswith(f"arm64 wheel: {wheel.name}, passed\n")
    assert "kernels baseline: " in done.stdout, "the kernels of arm64 have not run"
    assert not (tmp_path / "root").exists(), "the unpacked CPython fills the disk"
