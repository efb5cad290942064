"""Checks of `splatbot doctor`. Each check returns findings: state, subject, detail and fix."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from typing import Literal


@dataclass(frozen=True)
class CheckConstants:
    """Constants of checks of the installation.

    Args:
        egl_timeout: [s] longest time of the check of EGL.
        self_check_bound: largest error of the kernels' self check.
    """

    egl_timeout: float = 60.0
    self_check_bound: float = 1e-4


CONSTANTS = CheckConstants()


_APT = "apt-get install libegl1 libgl1 libegl-mesa0 libgl1-mesa-dri"

# Alternative distributions, and the feature that needs one of them ("": every feature).
_PACKAGES: tuple[tuple[tuple[str, ...], str], ...] = (
    (("torch",), ""),
    (("numpy",), ""),
    (("opencv-contrib-python-headless", "opencv-contrib-python"), ""),
    (("open3d",), "synthetic logs"),
    (("mujoco",), "the simulation"),
    (("roboticstoolbox-python",), "robot models"),
    (("depthai",), "OAK cameras"),
    (("pyserial",), "serial grippers"),
    (("fastapi",), "the service"),
)

# Runs in a separate process, because a broken graphics driver may crash or hang it.
_EGL_PROGRAM = """
import mujoco
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><light pos='0 0 2'/><geom type='sphere' size='.3'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 48, 64) as renderer:
    renderer.update_scene(data)
    image = renderer.render()
print("rendered" if image.any() else "black")
"""


@dataclass(frozen=True)
class Finding:
    """One line of the doctor's output."""

    state: Literal["ok", "warn", "fail"]
    what: str
    detail: str
    fix: str = ""


def all_checks() -> list[Callable[[], list[Finding]]]:
    """Return the checks in the order of the output."""
    return [check_python, check_packages, check_native, check_rasterizer, check_egl, check_serial]


def check_python() -> list[Finding]:
    """Report the interpreter and the machine."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return [
        Finding("ok", "python", platform.python_version()),
        Finding("ok", "platform", f"{platform.system()} {platform.machine()}, {cores} cores"),
    ]


def check_packages() -> list[Finding]:
    """Report the versions of the libraries, without importing them."""
    return [_check_package(names, loss) for names, loss in _PACKAGES]


def _check_package(names: tuple[str, ...], loss: str) -> Finding:
    for name in names:
        try:
            return Finding("ok", name, metadata.version(name))
        except metadata.PackageNotFoundError:
            continue
    fix = f"pip install {names[0]}"
    return (
        Finding("warn", names[0], f"missing: without it no {loss}", fix)
        if loss
        else Finding("fail", names[0], "missing", fix)
    )


def check_native() -> list[Finding]:
    """Check that the compiled kernels exist, and report those that this processor uses."""
    try:
        from splatbot import _native
    except ImportError as error:
        return [Finding("fail", "native module", str(error), "build it: pip install -e . (or make test)")]
    return [Finding("ok", "native module", f"kernels {_native.isa()}, {_native.num_threads()} threads")]


def check_rasterizer() -> list[Finding]:
    """Compare a render of the native kernels with the float64 reference."""
    try:
        error = rasterizer_error()
    except Exception as problem:  # the doctor reports any error and continues
        return [Finding("fail", "rasterizer", f"{type(problem).__name__}: {problem}", "rebuild: pip install -e .")]
    detail = f"differs from the float64 reference by {error:.1e}"
    if error > CONSTANTS.self_check_bound:
        return [Finding("fail", "rasterizer", detail, "try SPLATBOT_ISA=v2; if that helps, report this processor")]
    return [Finding("ok", "rasterizer", detail)]


def rasterizer_error() -> float:
    """Return the largest colour difference between kernels and reference for eight smooth Gaussians, 0..1."""
    import torch

    from splatbot.rasterize import Gaussians, Viewpoints, rasterization, rasterization_reference

    n, turn = 8, torch.arange(8) * (2 * torch.pi / 8)
    scene = (
        torch.stack([0.4 * turn.cos(), 0.3 * turn.sin(), 2.0 + 0.1 * torch.arange(n)], dim=1),  # means
        torch.stack([turn.cos(), turn.sin(), 0.3 * torch.ones(n), 0.1 * turn], dim=1),  # quats
        torch.tensor([0.08, 0.05, 0.02]).expand(n, 3).contiguous(),  # scales
        torch.linspace(0.3, 0.9, n),  # opacities
        torch.stack([turn / 7, 1 - turn / 7, 0.5 * torch.ones(n)], dim=1).clamp(0, 1),  # colors
        torch.eye(4)[None],  # viewmats
        torch.tensor([[[80.0, 0.0, 32.0], [0.0, 80.0, 24.0], [0.0, 0.0, 1.0]]]),  # Ks
    )
    means, quats, scales, opacities, colors, viewmats, Ks = scene
    fast = rasterization(means, quats, scales, opacities, colors, viewmats, Ks, 64, 48)[0]
    means, quats, scales, opacities, colors, viewmats, Ks = (t.double() for t in scene)
    exact = rasterization_reference(
        Gaussians(means, quats, scales, opacities, colors), Viewpoints(viewmats, Ks, 64, 48)
    )[0]
    return float((fast.double() - exact).abs().max())


def check_egl() -> list[Finding]:
    """Check rendering without a display, which the simulated camera needs."""
    try:
        answer = subprocess.run(
            [sys.executable, "-c", _EGL_PROGRAM],
            env={**os.environ, "MUJOCO_GL": "egl"},
            capture_output=True,
            text=True,
            timeout=CONSTANTS.egl_timeout,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return [Finding("warn", "EGL", f"no picture within {CONSTANTS.egl_timeout:.0f} s", f"as root: {_APT}")]
    if answer.returncode == 0 and "rendered" in answer.stdout:
        return [Finding("ok", "EGL", "MuJoCo renders without a display")]
    last = (answer.stderr.strip() or answer.stdout.strip() or f"exit {answer.returncode}").splitlines()[-1]
    return [Finding("warn", "EGL", f"no simulated camera: {last}", f"as root: {_APT}")]


def check_serial() -> list[Finding]:
    """Check the serial ports that a gripper may use."""
    try:
        from serial.tools import list_ports
    except ImportError:
        return [Finding("warn", "serial ports", "pyserial is missing", "pip install pyserial")]
    ports = [port.device for port in list_ports.comports()]
    closed = [port for port in ports if not os.access(port, os.R_OK | os.W_OK)]
    if closed:
        return [Finding("warn", "serial ports", f"no access to {', '.join(closed)}", "usermod -aG dialout $USER")]
    return [Finding("ok", "serial ports", ", ".join(ports) or "none")]
