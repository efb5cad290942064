"""Picks that look again from the wrist: moved and missing targets, obstacles, failed grasps, all in MuJoCo."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from splatbot.collision.visibility import DepthView
from splatbot.errors import InputError
from splatbot.grasping.pick import Picker
from splatbot.grasping.pick_planner import MapPickPlanner
from splatbot.grasping.pick_types import PickOptions, PickOutcome, PickResult, PickStage
from splatbot.robots.controllers import FakeController
from splatbot.robots.grippers import FakeGripper
from splatbot.robots.panda import panda
from splatbot.sim.contact_monitor import ContactMonitor
from splatbot.sim.controller import TwinController
from splatbot.sim.twin import Twin
from splatbot.sim.wrist_camera import TwinWristCamera
from tests.unit.grasping.test_look import moved, view
from tests.unit.grasping.test_pick import NAMES, grasps, height, sampler, target
from tests.unit.grasping.test_pick import OPTIONS as FAST

OPTIONS = replace(FAST, budget_ms=1000.0)  # a busy machine plans little in 200 ms


class Watched(TwinController):
    """A twin's controller that records the contacts of its arm."""

    def __init__(self, twin: Twin) -> None:
        self.contacts = ContactMonitor(twin.world)
        super().__init__(twin)

    def _advance(self, q: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> None:
        super()._advance(q, velocity, acceleration)
        self.contacts.update(self.twin.data, self._clock)


def pick(world: Twin, name: str, *, look: bool, options: PickOptions = OPTIONS) -> tuple[PickResult, Watched]:
    controller = Watched(world)
    assert controller.gripper is not None
    camera = TwinWristCamera(world) if look else None
    picker = Picker(sampler(), controller, controller.gripper, options=options, camera=camera)
    return picker.pick(target(name), grasps=grasps(name)), controller


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "x", "y", "degrees"), [("can", 0.03, 0.02, 0.0), ("carton", 0.02, 0.02, 0.0), ("ball", 0.03, -0.02, 0.0)]
)
def test_a_target_that_moved_after_it_was_mapped_is_picked(name: str, x: float, y: float, degrees: float) -> None:
    world, _ = moved(name, x, y, degrees)
    before = {each: height(world, each) for each in NAMES}
    result, controller = pick(world, name, look=True)
    assert result, (result.outcome, result.reason, [(step.stage, step.note) for step in result.steps])
    assert result.shift == pytest.approx(np.hypot(x, y), abs=0.005)
    assert result.attempts == 1
    assert height(world, name) - before.pop(name) == pytest.approx(OPTIONS.lift, abs=0.012)
    assert {other: height(world, other) for other in before} == pytest.approx(before, abs=2e-3)
    assert {contact.other for contact in controller.contacts.found} <= {name, "table"}
    assert [step.stage for step in result.steps if step.stage in (PickStage.LOOK, PickStage.ADJUST)] == [
        PickStage.LOOK, PickStage.ADJUST,
    ]  # fmt: skip


def test_without_a_look_the_same_targets_are_missed() -> None:
    failed = 0
    for name, x, y in (("can", 0.03, 0.02), ("ball", 0.03, -0.02)):
        world, _ = moved(name, x, y, 0.0)
        result, _ = pick(world, name, look=False)
        failed += not result
        assert result.shift is None
    assert failed == 2


def test_a_target_that_is_gone_is_not_grasped_at_its_old_place() -> None:
    world, _ = moved("can", -0.1, -0.15, 0.0)
    result, controller = pick(world, "can", look=True)
    assert (result.outcome, result.stage) == (PickOutcome.TARGET_MOVED, PickStage.LOOK)
    assert result.opening is None
    assert not controller.contacts.found


def test_what_was_put_in_the_way_after_the_map_is_not_touched() -> None:
    world, _ = moved("can", 0.0, 0.0, 0.0)
    # The carton, 10 cm high, now stands where a finger of the best grasp would be.
    best = grasps("can").grasps[0]
    joint = world.data.joint(int(world.world.model.body("object/carton").jntadr[0]))
    side = best.T_world_tcp[:2, 1] / np.linalg.norm(best.T_world_tcp[:2, 1])
    half = np.arctan2(side[1], side[0]) / 2 + np.pi / 4  # its narrow side faces the can
    joint.qpos[:] = [*(best.T_world_tcp[:2, 3] + 0.066 * side), 0.05, np.cos(half), 0.0, 0.0, np.sin(half)]
    mujoco.mj_forward(world.world.model, world.data)
    result, controller = pick(world, "can", look=True)
    assert "carton" not in {contact.other for contact in controller.contacts.found}
    obstructed = any(PickOutcome.OBSTRUCTED in step.note for step in result.steps)
    assert result.outcome in (PickOutcome.PICKED, PickOutcome.OBSTRUCTED, PickOutcome.NO_PLAN)
    assert obstructed or result.outcome is PickOutcome.OBSTRUCTED


class Scene:
    """A wrist camera that sees the can in its place until the fingers hold it."""

    def __init__(self, taken: Callable[[], bool]) -> None:
        self.taken = taken
        center = sampler().surface(target("can")).center
        self.there = view(moved("can", 0.0, 0.0, 0.0)[0], center)
        self.empty = view(moved("can", 0.0, -0.4, 0.0)[0], center)
        self.looks = 0

    def look(self) -> DepthView:
        self.looks += 1
        return self.empty if self.taken() else self.there


class MissesOnce(FakeGripper):
    """Fingers that miss the object in the first attempt."""

    def __init__(self, wrong: float) -> None:
        super().__init__(width=wrong)
        self.closed = 0

    def move(self, opening: float, *, force: float | None = None, speed: float | None = None) -> None:
        if opening == 0.0:
            self.closed += 1
            self.width = self.width if self.closed == 1 else 0.062
        super().move(opening, force=force, speed=speed)


@pytest.mark.parametrize(("wrong", "outcome"), [(0.0, "nothing held"), (0.02, "unexpected width")])
def test_a_failed_grasp_is_followed_by_the_next_one(wrong: float, outcome: str) -> None:
    gripper = MissesOnce(wrong)
    camera = Scene(lambda: gripper.closed == 2)
    controller = FakeController(panda().home, period=4e-3)
    result = Picker(sampler(), controller, gripper, options=OPTIONS, camera=camera).pick(
        target("can"), grasps=grasps("can")
    )
    assert result, (result.outcome, result.reason, [(step.stage, step.note) for step in result.steps])
    assert (result.attempts, camera.looks) == (2, 3)  # before each grasp, and after the lift
    assert any(outcome in step.note and "next grasp" in step.note for step in result.steps)
    assert result.grasp is not grasps("can").grasps[0]
    assert result.steps[-1].note.endswith("of its place is empty")


def test_attempts_are_bounded_and_none_is_repeated_without_a_camera() -> None:
    gripper = FakeGripper(width=0.0)
    camera = Scene(lambda: False)
    controller = FakeController(panda().home, period=4e-3)
    options = PickOptions(speed=1.0, grasp=OPTIONS.grasp, attempts=2)
    seen = Picker(sampler(), controller, gripper, options=options, camera=camera).pick(
        target("can"), grasps=grasps("can")
    )
    assert (seen.outcome, seen.attempts) == (PickOutcome.NOTHING_HELD, 2)
    blind = Picker(sampler(), FakeController(panda().home, period=4e-3), FakeGripper(width=0.0), options=options).pick(
        target("can"), grasps=grasps("can")
    )
    assert (blind.outcome, blind.attempts) == (PickOutcome.NOTHING_HELD, 1)


def test_an_object_that_is_still_in_its_place_was_not_lifted() -> None:
    gripper = FakeGripper(width=0.062)  # the fingers hold something, but the can stands where it was
    camera = Scene(lambda: False)
    result = Picker(sampler(), FakeController(panda().home, period=4e-3), gripper, options=OPTIONS, camera=camera).pick(
        target("can"), grasps=grasps("can")
    )
    assert (result.outcome, result.stage) == (PickOutcome.LOST, PickStage.CHECK)
    assert "place is empty, so the fingers hold something else" in result.reason


def test_a_camera_needs_the_planner_of_the_map() -> None:
    with pytest.raises(InputError, match="camera: needs the planner of the map"):
        Picker(
            sampler(),
            FakeController(panda().home),
            FakeGripper(),
            make_planner=lambda found: MapPickPlanner(sampler(), found, OPTIONS),
            camera=Scene(lambda: False),
        )
