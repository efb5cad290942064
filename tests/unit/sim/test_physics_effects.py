"""A scene gets the physics that it requires, and no other."""

from __future__ import annotations

import subprocess
import sys
from functools import cache

import mujoco
import numpy as np
import pytest

from splatbot.robots.panda import panda
from splatbot.sim.effects.physics import PHYSICS, effects_for, physics_effect
from splatbot.sim.effects.registry import EFFECTS
from splatbot.sim.motion import hold
from splatbot.sim.scene import load_scene, scene_names
from splatbot.sim.twin import Twin, TwinResult

pytest.importorskip("mujoco")

CALLED_FOR = {
    "empty": set(),
    "tabletop_clutter": {"contact", "friction", "sleep"},
    "shelf_bin": {"contact", "friction", "sleep"},
    "mug_hanging": {"contact", "friction", "gripper_compliance", "torque_limits", "sleep"},
    "wiping": {"contact", "friction", "torque_limits", "actuator_lag", "joint_friction", "backlash"},
    "dynamic_obstacle": {"contact", "friction", "fluid_drag", "moving_obstacles", "lighting"},
    "soft_object": {"soft_bodies", "contact", "friction", "gripper_compliance", "torque_limits"},
}
LISTED = [(scene, name) for scene, names in CALLED_FOR.items() for name in sorted(names)]
SENSORS = {"tabletop_clutter": {"depth_noise", "depth_holes"}, "dynamic_obstacle": {"exposure", "frame_drops"}}


@cache
def run(scene: str, *, force: tuple[str, ...] = (), forbid: tuple[str, ...] = ()) -> TwinResult:
    return Twin(load_scene(scene).with_effects(force=force, forbid=forbid)).follow()


def test_every_shipped_scene_is_spoken_of_here() -> None:
    assert set(scene_names()) == set(CALLED_FOR)


@pytest.mark.parametrize("scene", sorted(CALLED_FOR))
def test_a_shipped_scene_runs_and_its_ledger_lists_only_what_it_calls_for(scene: str) -> None:
    result = run(scene)
    assert result.stopped is None
    assert {d.name for d in result.decisions if d.on} == CALLED_FOR[scene] | SENSORS.get(scene, set())
    assert [d.name for d in result.decisions] == [*PHYSICS, *EFFECTS]
    assert all(d.why for d in result.decisions)
    assert not any("unstable" in warning for warning in result.warnings)


@pytest.mark.parametrize(("scene", "name"), LISTED)
def test_without_an_effect_that_a_scene_requires_its_observable_changes(scene: str, name: str) -> None:
    without = run(scene, forbid=(name,))
    (decision,) = (d for d in without.decisions if d.name == name)
    assert not decision.on
    assert decision.by == "forbidden"
    observable = physics_effect(name).observable
    change = abs(without.figures[observable] - run(scene).figures[observable])
    assert change > 1e-3 * abs(run(scene).figures[observable])


@pytest.mark.parametrize(
    "name",
    [
        "contact",
        "friction",
        "soft_bodies",
        "moving_obstacles",
        "fluid_drag",
        "actuator_lag",
        "joint_friction",
        "lighting",
    ],
)
def test_physics_that_cannot_apply_changes_no_bit_when_it_is_forced_on(name: str) -> None:
    forced = run("empty", force=(name,))
    (decision,) = (d for d in forced.decisions if d.name == name)
    assert decision.on
    assert decision.by == "forced"
    assert forced.digest == run("empty").digest


def test_forced_contact_looks_for_what_might_touch_and_forced_drag_computes_its_forces() -> None:
    """Each effect is really computed: the flags and the medium are in the model."""
    scene = load_scene("empty")
    plain = Twin(scene).world.model
    forced = Twin(scene.with_effects(force=("contact", "fluid_drag"))).world.model
    assert plain.opt.disableflags & 16
    assert not forced.opt.disableflags & 16
    assert plain.opt.density == 0
    assert forced.opt.density > 0


def test_forced_physics_that_cannot_apply_is_really_done_in_every_step() -> None:
    """Counted, not timed, by MuJoCo's own account of its stages."""
    scene = load_scene("empty")
    motion = hold(panda().home, 0.1)
    calls = []
    for force in (tuple[str, ...](), ("contact",)):
        twin = Twin(scene.with_effects(force=force))
        twin.follow(motion)
        calls.append(int(twin.data.timer[int(mujoco.mjtTimer.mjTIMER_COL_BROAD)].number))
    assert calls[0] == 0
    assert calls[1] >= 100


def test_what_stands_still_is_never_tested_against_what_stands_still() -> None:
    model = Twin(load_scene("shelf_bin")).world.model
    fixed = np.asarray(model.body_weldid)[np.asarray(model.geom_bodyid)] == 0
    fixed &= ~Twin(load_scene("shelf_bin")).world.of_robot
    assert fixed.sum() == 11
    assert (np.asarray(model.geom_conaffinity)[fixed] == 0).all()


def test_the_latest_word_on_an_effect_counts() -> None:
    scene = load_scene("tabletop_clutter").with_effects(forbid=("sleep",))
    assert {d.name: d.on for d in effects_for(scene)}["sleep"] is False
    again = scene.with_effects(force=("sleep",))
    assert {d.name: d.on for d in effects_for(again)}["sleep"] is True


def test_sensor_effects_that_no_one_required_are_not_even_imported() -> None:
    code = (
        "import sys; from splatbot.sim.scene import load_scene; from splatbot.sim.twin import Twin\n"
        "from splatbot.sim.motion import hold\n"
        "t = Twin(load_scene('empty')); t.follow(hold(t.world.robot.home, 0.05))\n"
        f"print([n for n in {EFFECTS!r} if f'splatbot.sim.effects.{{n}}' in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
