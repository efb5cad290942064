"""Picking in the twin, and with arms and fingers that fail: held and lifted, or a typed outcome and at rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from splatbot.bench.tabletop import Ball, Block, Can, Tabletop
from splatbot.collision import RobotSpheres
from splatbot.errors import GripperError, InputError
from splatbot.gaussians import GaussianModel
from splatbot.grasping.affordance import Target
from splatbot.grasping.attached import covering_spheres, within
from splatbot.grasping.lift import target_spheres
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.pick import Picker
from splatbot.grasping.pick_planner import MapPickPlanner, PickPlan, Segment
from splatbot.grasping.pick_types import PickError, PickOptions, PickOutcome, PickResult, PickStage
from splatbot.grasping.sampler import GraspSampler
from splatbot.grasping.types import Grasp, GraspResult
from splatbot.planning import GaussianRRTStar, JointGoal
from splatbot.protocols import Array, Gripper, MotionState
from splatbot.robots.controllers import FakeController
from splatbot.robots.grippers import FakeGripper, FakeRobotiq, RobotiqGripper
from splatbot.robots.panda import panda
from splatbot.segmentation import SegmentedMap, segment
from splatbot.sim.controller import TwinController
from splatbot.sim.scene import make_scene
from splatbot.sim.twin import Twin

pytest.importorskip("mujoco")

TABLE = Block((0.55, 0.0, -0.02), (0.6, 0.9, 0.04))
CARTON = Block((0.50, 0.05, 0.05), (0.10, 0.06, 0.10), 0.4)
CAN = Can((0.50, -0.20, 0.0), 0.03, 0.12)
BALL = Ball((0.60, 0.27, 0.03), 0.03)
OPTIONS = PickOptions(speed=1.0, grasp=GraspOptions(samples=200, wanted=5))
NAMES = {"carton": CARTON.center, "can": (0.50, -0.20, 0.06), "ball": BALL.center}


@cache
def scene() -> SegmentedMap:
    found = segment(Tabletop((TABLE, CARTON, CAN, BALL)).gaussians(20_000), np.eye(4))
    assert len(found.objects) == 3
    return found


@cache
def sampler() -> GraspSampler:
    return GraspSampler(scene(), panda())


def target(name: str) -> Target:
    away = [np.linalg.norm(o.center - np.array(NAMES[name])) for o in scene().objects]
    k = int(np.argmin(away))
    return Target(scene().objects[k].rows, None, name, "test", 1.0, (), k)


@cache
def grasps(name: str) -> GraspResult:
    return sampler().sample(target(name), OPTIONS.grasp)


def twin() -> Twin:
    things: list[dict[str, Any]] = [
        {"name": "table", "shapes": [{"kind": "plane"}]},
        {"name": "carton", "shapes": [{"kind": "box", "size": list(CARTON.size)}], "at": list(CARTON.center),
         "rpy": [0, 0, CARTON.yaw], "movable": True, "mass": 0.3},
        {"name": "can", "shapes": [{"kind": "cylinder", "radius": CAN.radius, "height": CAN.height}],
         "at": [*CAN.foot[:2], CAN.height / 2], "movable": True, "mass": 0.3},
        {"name": "ball", "shapes": [{"kind": "sphere", "radius": BALL.radius}], "at": list(BALL.center),
         "movable": True, "mass": 0.1},
    ]  # fmt: skip
    return Twin(make_scene({"name": "pick", "objects": things, "task": {"kind": "grasp"}}))


def height(of: Twin, name: str) -> float:
    return float(of.data.body(f"object/{name}").xpos[2])


@pytest.mark.parametrize("name", list(NAMES))
def test_in_the_twin_it_is_lifted_and_carried_and_stays_in_the_hand(name: str) -> None:
    world = twin()
    controller = TwinController(world)
    assert controller.gripper is not None
    before = height(world, name)
    others = {other: height(world, other) for other in NAMES if other != name}
    result = Picker(sampler(), controller, controller.gripper, options=OPTIONS).pick(target(name), grasps=grasps(name))
    assert result, result.reason
    assert result.unwrap() is result.grasp
    assert [step.stage for step in result.steps] == [
        PickStage.GRASP, PickStage.PLAN, PickStage.OPEN, PickStage.MOVE, PickStage.APPROACH, PickStage.CLOSE,
        PickStage.LIFT, PickStage.LIFT, PickStage.CHECK,
    ]  # fmt: skip
    assert height(world, name) - before == pytest.approx(OPTIONS.lift, abs=0.01)
    assert {other: height(world, other) for other in others} == pytest.approx(others, abs=2e-3)
    assert result.opening == pytest.approx(result.unwrap().width, abs=0.012)  # pads are compliant, most around a ball
    # The attached spheres are at the object, so that later plans include it.
    assert result.attached is not None
    assert result.q is not None
    held = RobotSpheres(panda(), attached=result.attached).centers(result.q[None])[0, -len(result.attached) :]
    assert np.linalg.norm(held.mean(axis=0) - world.data.body(f"object/{name}").xpos) < 0.03
    for _ in range(300):
        controller.step()
    assert controller.gripper.holds()


def test_an_attached_object_is_carried_around_obstacles() -> None:
    world = twin()
    controller = TwinController(world)
    assert controller.gripper is not None
    options = PickOptions(speed=1.0, grasp=OPTIONS.grasp, carry_to=tuple(panda().home), budget_ms=500.0)
    result = Picker(sampler(), controller, controller.gripper, options=options).pick(
        target("can"), grasps=grasps("can")
    )
    assert result, result.reason
    assert result.steps[-1].stage is PickStage.CARRY
    np.testing.assert_allclose(controller.position, panda().home, atol=0.01)
    assert height(world, "can") > 0.2
    # The planner refuses a goal at which only the attached object collides with the table.
    assert result.attached is not None
    longer = result.attached.copy()
    longer[:, 2] += panda().tcp(panda().home)[2, 3]
    planner = GaussianRRTStar(sampler().field, panda(), attached=longer)
    assert planner.plan(panda().home, panda().home + 1e-3).path is None


def _spheres_on(plan: PickPlan) -> tuple[np.ndarray, np.ndarray]:
    """Sample centres (P, S, 3) and radii (P, S) of the arm's moving spheres along a plan."""
    centers, radii = [], []
    for part in (plan.to_pregrasp, plan.approach, plan.lift_off, plan.lift):
        q = part.path.at(np.linspace(0.0, 1.0, 100))
        moving = part.arm.spheres.link > 0
        centers += list(part.arm.centers(q)[:, moving])
        radii += [part.arm.spheres.radii[moving]] * len(q)
    return np.concatenate(centers), np.concatenate(radii)


def test_a_plan_avoids_moving_regions_and_its_certificate_covers_both() -> None:
    start = panda().home + np.eye(7)[0] * 1.2  # on the other side of the obstacle
    plain = MapPickPlanner(sampler(), target("can"), OPTIONS).plan_to(grasps("can").grasps[0], start)
    assert isinstance(plain, PickPlan)
    assert plain.avoids_moving
    middle = plain.to_pregrasp.arm.forward(plain.to_pregrasp.path.at(np.array([0.5])))[0, -1, :3, 3]
    moving = np.array([[*middle, 0.04]])
    wary = GraspSampler(scene(), panda(), moving=moving)
    found = wary.sample(target("can"), OPTIONS.grasp)
    planner = MapPickPlanner(wary, target("can"), replace(OPTIONS, budget_ms=1000.0))
    grasp = next(g for g in found.grasps if g.avoids_moving)
    avoiding, direct = (planner.plan_to(grasp, start, avoid_moving=avoid) for avoid in (True, False))
    assert isinstance(avoiding, PickPlan)
    assert isinstance(direct, PickPlan)
    assert avoiding.avoids_moving
    assert not direct.avoids_moving
    for plan, free in ((avoiding, True), (plain, False)):
        centers, radii = _spheres_on(plan)
        assert (np.linalg.norm(centers - middle, axis=1) - radii > moving[0, 3]).all() == free
        assert all(s.path.certificate.certified for s in (plan.to_pregrasp, plan.approach, plan.lift_off, plan.lift))


def test_a_pick_without_a_plan_around_moving_regions_is_executed_with_a_note() -> None:
    world = twin()
    controller = TwinController(world)
    assert controller.gripper is not None
    over = np.array([[*NAMES["can"][:2], 0.18, 0.08]])
    wary = GraspSampler(scene(), panda(), moving=over)
    result = Picker(wary, controller, controller.gripper, options=OPTIONS).pick(target("can"))
    assert result, result.reason
    assert result.grasp is not None
    assert any("motion was observed" in note for note in result.notes)
    clean = with_fake(FakeGripper(width=0.06))
    assert clean.notes == ()


class Scripted:
    """Fingers that do as a test wants."""

    def __init__(self, inner: Gripper, *, fails: str = "", at: int = 0, then: Callable[[], None] | None = None) -> None:
        self.inner, self.fails, self.at, self.calls, self.then = inner, fails, at, 0, then
        self.stroke = inner.stroke

    def _count(self, name: str) -> None:
        if name == self.fails:
            self.calls += 1
            if self.calls > self.at:
                raise GripperError("is gone.", field="port")

    def move(self, opening: float, *, force: float | None = None, speed: float | None = None) -> None:
        self._count("move")
        self.inner.move(opening, force=force, speed=speed)

    def moving(self) -> bool:
        self._count("moving")
        return self.inner.moving()

    def opening(self) -> float:
        return self.inner.opening()

    def holds(self) -> bool:
        self._count("holds")
        return self.inner.holds()

    def stop(self) -> None:
        self.inner.stop()


def with_fake(gripper: Gripper, *, stop: Callable[[], bool] | None = None, lag: float = 0.0) -> PickResult:
    controller = FakeController(panda().home, lag=lag, period=4e-3)
    result = Picker(sampler(), controller, gripper, options=OPTIONS, stop=stop).pick(
        target("can"), grasps=grasps("can")
    )
    at = controller.position
    for _ in range(20):
        assert controller.step().state is not MotionState.MOVING
    np.testing.assert_array_equal(controller.position, at)
    return result


def test_with_fingers_that_work_every_stage_is_done() -> None:
    gripper = FakeGripper(width=0.06)
    result = with_fake(gripper)
    assert result.outcome is PickOutcome.PICKED
    assert result.opening == 0.06


def test_fingers_that_close_on_nothing_open_again() -> None:
    gripper = FakeGripper(width=0.0)
    result = with_fake(gripper)
    assert (result.outcome, result.stage) == (PickOutcome.NOTHING_HELD, PickStage.CLOSE)
    assert gripper.opening() > 0.06
    with pytest.raises(PickError, match="nothing held") as caught:
        result.unwrap()
    assert caught.value.result is result
    assert caught.value.code == -4


def test_an_object_that_slips_out_on_the_way_up_is_lost() -> None:
    gripper = FakeGripper(width=0.06)
    checks = 0

    class Slips(Scripted):
        def holds(self) -> bool:
            nonlocal checks
            checks += 1
            return checks == 1

    result = with_fake(Slips(gripper))
    assert (result.outcome, result.stage) == (PickOutcome.LOST, PickStage.CHECK)
    assert result.attached is None


@pytest.mark.parametrize(
    ("fails", "at", "stage"),
    [("move", 0, PickStage.OPEN), ("move", 1, PickStage.CLOSE), ("moving", 1, PickStage.CLOSE),
     ("holds", 1, PickStage.CHECK)],
)  # fmt: skip
def test_a_gripper_that_fails_ends_the_pick_where_it_is(fails: str, at: int, stage: PickStage) -> None:
    result = with_fake(Scripted(FakeGripper(width=0.06), fails=fails, at=at))
    assert (result.outcome, result.stage) == (PickOutcome.GRIPPER_FAILED, stage)
    assert isinstance(result.error, GripperError)


def test_an_arm_that_cannot_follow_is_not_followed() -> None:
    result = with_fake(FakeGripper(width=0.06), lag=0.5)
    assert (result.outcome, result.stage) == (PickOutcome.NOT_FOLLOWED, PickStage.MOVE)
    assert "from the trajectory" in result.reason


@pytest.mark.parametrize("after", [0, 60, 400])
def test_a_stop_request_stops_the_pick_and_is_reported(after: int) -> None:
    polls = 0

    def stop() -> bool:
        nonlocal polls
        polls += 1
        return polls > after

    result = with_fake(FakeGripper(width=0.06), stop=stop)
    assert result.outcome is PickOutcome.STOPPED
    assert result.steps[-1].note == "a stop was requested"


def test_with_a_gripper_on_a_serial_port() -> None:
    with FakeRobotiq(width=0.06, hurry=20.0) as device, RobotiqGripper(device.port, timeout=5.0) as gripper:
        gripper.activate()
        result = with_fake(gripper)
        assert result, result.reason
        assert result.opening == pytest.approx(0.06, abs=1e-3)
    with FakeRobotiq(width=0.06, hurry=20.0) as device, RobotiqGripper(device.port, timeout=5.0) as gripper:
        gripper.activate()
        device.fault = 0x0E
        result = with_fake(gripper)
        assert (result.outcome, result.stage) == (PickOutcome.GRIPPER_FAILED, PickStage.OPEN)


def test_a_target_without_a_plan_moves_nothing() -> None:
    """A wall between the arm and the table: hands would fit, but no arm gets there."""
    wall = Tabletop((Block((0.35, 0.0, 0.6), (0.02, 2.0, 1.4)),)).gaussians(30_000)
    plain = scene()
    labels = np.concatenate([plain.labels, np.full(len(wall), -1, np.int32)])
    closed = replace(plain, model=GaussianModel.concatenate([plain.model, wall]), labels=labels)
    gripper = FakeGripper(width=0.06)
    controller = FakeController(panda().home)
    at = controller.position
    result = Picker(GraspSampler(closed, panda()), controller, gripper, options=OPTIONS).pick(target("can"))
    assert result.outcome in (PickOutcome.NO_GRASP, PickOutcome.NO_PLAN)
    assert result.reason
    np.testing.assert_array_equal(controller.position, at)
    assert gripper.opening() == gripper.stroke


class Refusing:
    """A planner that refuses each grasp, the second for a reason of its own."""

    def __init__(self) -> None:
        self.calls = 0

    def plan_to(self, grasp: Grasp, start: Array, *, avoid_moving: bool = False) -> PickPlan | str:
        self.calls += 1
        return "it is too far" if self.calls == 2 else "it is blocked"

    def plan_carry(self, plan: PickPlan, start: Array, goal: JointGoal) -> Segment | str:
        raise NotImplementedError


def test_grasps_refused_for_one_reason_share_its_line() -> None:
    options = replace(OPTIONS, tries=3)
    picker = Picker(
        sampler(), FakeController(panda().home), FakeGripper(width=0.06), options=options,
        make_planner=lambda _: Refusing(),
    )  # fmt: skip
    result = picker.pick(target("can"), grasps=grasps("can"))
    assert result.reason == "grasp 0, 2: it is blocked; grasp 1: it is too far"
    assert result.steps[0].note == f"{len(grasps('can').grasps)} grasps"


def test_spheres_of_a_held_object_cover_it_and_are_few() -> None:
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (2000, 3)) * [1.0, 0.5, 0.2]
    reach = np.full(len(points), 1e-3)
    spheres = covering_spheres(points, reach, max_spheres=30)
    assert 5 < len(spheres) <= 30
    inside = spheres[None, :, 3] - np.linalg.norm(points[:, None] - spheres[None, :, :3], axis=2)
    assert (inside.max(axis=1) >= reach - 1e-12).all()
    with pytest.raises(InputError):
        covering_spheres(points[:0], reach[:0])


def test_spheres_of_a_held_box_reach_less_than_9_mm_beyond_it() -> None:
    half = 0.05
    u, v = (grid.ravel() for grid in np.meshgrid(*2 * [np.linspace(-half, half, 26)]))
    faces = [np.insert(np.c_[u, v], axis, side, axis=1) for axis in range(3) for side in (-half, half)]
    spheres = covering_spheres(np.concatenate(faces), np.zeros(6 * len(u)))
    assert (np.abs(spheres[:, :3]).max(axis=1) + spheres[:, 3]).max() < half + 0.009


@pytest.mark.parametrize(("own", "most"), [(249, 300), (600, 40), (640, 1)])
def test_an_arm_with_many_spheres_carries_an_object_of_fewer(own: int, most: int) -> None:
    carried = sampler()
    arm = SimpleNamespace(spheres=lambda: range(own))
    few: Any = SimpleNamespace(robot=arm, surface=carried.surface)
    assert most / 3 <= len(target_spheres(few, target("can"))) <= most


def test_points_inside_of_an_object_belong_to_it_and_points_around_it_do_not() -> None:
    y, z = np.meshgrid(np.linspace(-0.04, 0.04, 9), np.linspace(0.0, 0.08, 9))
    sides = [np.c_[np.full(81, x), y.ravel(), z.ravel()] for x in (-0.04, 0.04)]
    walls = np.concatenate([*sides, *(side[:, [1, 0, 2]] for side in sides)])  # open above and below
    spheres = np.c_[walls, np.full(len(walls), 0.008)]
    floor = np.c_[y.ravel(), z.ravel() - 0.04, np.zeros(81), np.full(81, 0.008)]
    cup = np.concatenate([spheres, floor])
    queries = np.array([[0.0, 0.0, 0.03], [0.04, 0.01, 0.05], [0.06, 0.0, 0.04], [0.0, 0.0, -0.03], [0.0, 0.0, 0.12]])
    np.testing.assert_array_equal(within(queries, cup), [True, True, False, False, False])
    np.testing.assert_array_equal(within(queries, spheres), [False, True, False, False, False])


def test_options_that_make_no_sense_are_refused() -> None:
    for wrong in ({"lift": 0.0}, {"lift_off": 0.3}, {"speed": 0.0}, {"tries": 0}, {"force": -1.0}, {"budget_ms": 0.0}):
        with pytest.raises(InputError, match="options"):
            PickOptions(**wrong)
    with pytest.raises(InputError, match="gripper"):
        Picker(sampler(), FakeController(panda().home), FakeGripper(stroke=0.05))
