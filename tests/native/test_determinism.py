"""Determinism of the kernels: the number of threads changes no bit, the instruction set only rounding."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch
from torch import Tensor

from splatbot.rasterize.native import native
from tests.scenes import NAMES, Scene, compare, hard_scene, relative_l2

TESTS = Path(__file__).parents[1]

pytestmark = pytest.mark.usefixtures("default_kernels")


def large_scene() -> Scene:
    """Return a scene with several projection blocks, sort shares and tiles, so that work is divided."""
    scene = hard_scene(1, n=30_000)
    scene.scales *= 0.2
    scene.width, scene.height = 200, 140
    scene.Ks[:, :2] *= 2.6
    return scene


def render_all(scene: Scene, mode: str = "RGB+ED") -> dict[str, Tensor]:
    """Return the image, alpha and all gradients."""
    leaves = scene.to(torch.float32, requires_grad=True)
    image, alpha, _ = leaves.render(mode, depth_mode="plane")
    weights = torch.linspace(-1.0, 1.0, image.numel()).reshape(image.shape)
    ((image * weights).sum() + (alpha**2).sum()).backward()
    return {"image": image.detach(), "alpha": alpha.detach()} | {
        n: getattr(leaves, n).grad for n in NAMES if n != "covars"
    }


@pytest.mark.parametrize("threads", [2, 3, 8])
def test_the_number_of_threads_changes_no_bit(threads: int) -> None:
    scene = large_scene()
    native().set_num_threads(1)
    want = render_all(scene)
    native().set_num_threads(threads)
    assert native().num_threads() == threads
    for _ in range(3):
        got = render_all(scene)
        for name, value in want.items():
            assert torch.equal(got[name], value), name


@pytest.mark.parametrize("isa", native().available_isas())
def test_every_instruction_set_gives_the_same_up_to_rounding(isa: str) -> None:
    scene = large_scene()
    native().set_isa(native().available_isas()[-1])
    want = render_all(scene)
    native().set_isa(isa)
    assert native().isa() == isa
    got = render_all(scene)
    # Single pixels may fall on the other side of the 1/255 and 1e-4 jumps.
    for name in ("image", "alpha"):
        differs = (got[name] - want[name]).abs() > 1e-4
        assert differs.double().mean() < 1e-3, name
        assert float((got[name] - want[name]).abs().max()) < 0.05, name
    for name in set(want) - {"image", "alpha"}:
        assert relative_l2(got[name], want[name]) < 2e-3, name


@pytest.mark.parametrize("isa", native().available_isas())
def test_every_instruction_set_equals_the_float64_reference(isa: str) -> None:
    native().set_isa(isa)
    result = compare(hard_scene(2), "RGB+D")
    assert result.forward <= 5e-5
    assert max(result.gradients.values()) <= 1e-4, result.gradients


def test_unknown_kernels_are_refused_with_the_names_that_run_here() -> None:
    with pytest.raises(RuntimeError, match=native().available_isas()[0]):
        native().set_isa("v9")


def test_renders_from_several_threads_at_once_do_not_disturb_each_other() -> None:
    scenes = [hard_scene(seed, n=3000) for seed in range(4)]
    native().set_num_threads(2)
    want = [render_all(scene) for scene in scenes]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(3):
            for got, exact in zip(pool.map(render_all, scenes), want, strict=True):
                for name, value in exact.items():
                    assert torch.equal(got[name], value), name


@pytest.mark.parametrize(
    ("variable", "value"), [("SPLATBOT_ISA", "v9"), ("SPLATBOT_NUM_THREADS", "zero"), ("SPLATBOT_NUM_THREADS", "0")]
)
def test_an_environment_that_cannot_be_honoured_is_an_error_that_names_it(
    variable: str, value: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = (
        "from splatbot.errors import NativeError\n"
        "from splatbot.rasterize.native import native\n"
        "try:\n    native()\nexcept NativeError as error:\n    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, variable: value},
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert variable in done.stdout


@pytest.mark.long
@pytest.mark.parametrize("isa", [isa for isa in native().available_isas() if isa != native().isa()])
def test_the_rasterizer_keeps_its_promises_on_lesser_instruction_sets(isa: str) -> None:
    suites = [
        str(TESTS / name)
        for name in (
            "unit/rasterize",
            "stability/test_rasterizer.py",
            "stability/test_cameras.py",
            "stability/test_surfels.py",
        )
    ]
    command = [sys.executable, "-m", "pytest", "-q", "-m", "not long", "-p", "no:cacheprovider", *suites]
    done = subprocess.run(
        command, cwd=TESTS.parent, env=os.environ | {"SPLATBOT_ISA": isa}, capture_output=True, text=True, timeout=500
    )
    assert done.returncode == 0, done.stdout[-4000:]
    assert " passed" in done.stdout
