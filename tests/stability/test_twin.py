"""Hard cases of the twin: stacks, large mass ratios, long steps. Errors are bounded, or the run has a warning."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from splatbot.sim.motion import JointMotion
from splatbot.sim.scene import Scene, make_scene
from splatbot.sim.twin import Twin

pytest.importorskip("mujoco")

FLOOR = {"name": "floor", "shapes": [{"kind": "plane"}]}


def _scene(*objects: dict[str, Any], **values: Any) -> Scene:
    return make_scene({"name": "hard", "robot": None, "objects": [FLOOR, *objects], **values})


def _box(name: str, z: float, size: float = 0.05, **values: Any) -> dict[str, Any]:
    shapes = [{"kind": "box", "size": [size] * 3}]
    return {"name": name, "shapes": shapes, "at": [0.0, 0.0, z], "movable": True, **values}


def _wait(seconds: float) -> JointMotion:
    still = np.zeros((2, 0))
    return JointMotion(np.array([0.0, seconds]), still, still, still)


def _lowest_and_fastest(twin: Twin, seconds: float) -> tuple[float, float]:
    seen = [np.inf, 0.0]

    def watch(data: Any, now: float) -> None:
        seen[0] = min(seen[0], float(data.xpos[2:, 2].min()))
        seen[1] = max(seen[1], float(np.abs(data.qvel).max()))

    twin.follow(_wait(seconds), watch=watch)
    return seen[0], seen[1]


@pytest.mark.parametrize("sleep", [True, False])
def test_a_stack_of_ten_boxes_stands_for_ten_seconds_within_a_millimetre(sleep: bool) -> None:
    """Check positions and energy after the contacts have settled for one second."""
    boxes = [_box(f"box{i}", 0.025 + 0.05 * i, mass=0.2) for i in range(10)]
    twin = Twin(_scene(*boxes).with_effects(forbid=() if sleep else ("sleep",)))
    places: dict[int, np.ndarray] = {}
    energy: list[float] = []

    def watch(data: Any, now: float) -> None:
        step = round(now / twin.timestep)
        if step in (500, 5000):
            places[step] = data.xpos[2:].copy()
        if step >= 500 and step % 50 == 0:
            energy.append(
                0.2 * 9.81 * float(data.xpos[2:, 2].sum()) + 0.1 * float((data.qvel.reshape(-1, 6)[:, :3] ** 2).sum())
            )

    result = twin.follow(_wait(10.0), watch=watch)
    assert np.abs(places[5000] - places[500]).max() < 1e-3
    assert max(energy) - energy[0] < 1e-3  # [J] of 5 J
    assert result.dropped == ()
    assert result.warnings == ()


@pytest.mark.parametrize(("mass", "size"), [(0.001, 0.01), (0.001, 0.05), (100.0, 0.05), (100.0, 0.5)])
def test_a_gram_and_a_hundred_kilograms_come_to_rest_on_the_floor(mass: float, size: float) -> None:
    twin = Twin(_scene(_box("box", size / 2 + 0.02, size=size, mass=mass)))
    lowest, fastest = _lowest_and_fastest(twin, 2.0)
    # A contact is a critically damped spring of 20 ms: a landing at v goes v tau / e deep.
    assert lowest > size / 2 - 1.1 * np.sqrt(2 * 9.81 * 0.02) * 0.02 / np.e
    assert float(twin.data.xpos[2, 2]) > size / 2 - 0.5e-3
    assert fastest < 2 * np.sqrt(2 * 9.81 * 0.02) / min(size, 1.0) * 1.5
    assert float(np.abs(twin.data.qvel).max()) < 1e-2


def test_a_hundred_kilograms_on_a_gram_do_not_explode() -> None:
    twin = Twin(_scene(_box("gram", 0.025, mass=0.001), _box("lead", 0.10, size=0.10, mass=100.0)))
    lowest, fastest = _lowest_and_fastest(twin, 2.0)
    assert np.isfinite(twin.data.qpos).all()
    assert fastest < 50.0
    assert lowest > -0.05


def test_steps_of_ten_milliseconds_are_bounded_and_reported() -> None:
    twin = Twin(_scene(_box("a", 0.025), _box("b", 0.075)), timestep=0.010)
    result = twin.follow(_wait(5.0))
    assert any("steps of 10 ms: contacts are too soft" in text for text in result.warnings)
    assert max(result.moved.values()) < 5e-3


def test_an_arm_with_steps_of_ten_milliseconds_follows_or_warns() -> None:
    scene = make_scene({"name": "x", "task": {"kind": "reach", "moves": [{"t": 1.5, "tcp": [0.45, 0.3, 0.4]}]}})
    result = Twin(scene, timestep=0.010).follow()
    assert result.tracking is not None
    unstable = any("unstable" in text for text in result.warnings)
    assert unstable or result.tracking.tcp < 0.02


def test_physics_that_blows_up_has_a_warning() -> None:
    """Use springs that are a thousand times too stiff for the step."""
    twin = Twin(make_scene({"name": "x"}), timestep=0.02)
    twin.world.model.actuator_gainprm[:, 0] *= -1e6
    twin.world.model.actuator_biasprm[:, 1:] *= -1e6
    result = twin.follow()
    assert any("physics became unstable" in text for text in result.warnings)
    assert result.stopped is not None
