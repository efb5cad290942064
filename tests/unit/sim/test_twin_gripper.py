"""The twin's fingers: they reach their goal, press with the commanded force, and report a held object."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.protocols import Gripper
from splatbot.sim.controller import TwinController
from splatbot.sim.gripper import TwinGripper
from splatbot.sim.scene import make_scene
from splatbot.sim.twin import Twin


def between(width: float) -> TwinController:
    """Return an arm at home with a fixed block of a given width between its fingers."""
    robot = Twin(make_scene({"name": "bare", "objects": []})).world.robot
    assert robot is not None
    T = robot.tcp(robot.home)
    yaw = float(np.arctan2(T[1, 0], T[0, 0]))
    block = {
        "name": "block", "at": T[:3, 3].tolist(), "rpy": [0, 0, yaw],
        "shapes": [{"kind": "box", "size": [0.02, width, 0.02]}],
    }  # fmt: skip
    return TwinController(Twin(make_scene({"name": "held", "objects": [block] if width else []})))


def settle(controller: TwinController, seconds: float = 2.0) -> TwinGripper:
    gripper = controller.gripper
    assert gripper is not None
    for _ in range(round(seconds / controller.period)):
        controller.step()
        if not gripper.moving():
            break
    return gripper


def pressed(controller: TwinController) -> float:
    """Return the normal force [N] between the block and one finger from MuJoCo's contacts."""
    twin, total = controller.twin, 0.0
    force = np.zeros(6)
    for i in range(twin.data.ncon):
        owners = {twin.world.owner[g] for g in twin.data.contact.geom[i]}
        if "finger1" in owners:
            mujoco.mj_contactForce(twin.world.model, twin.data, i, force)
            total += float(force[0])
    return total


def test_fingers_go_where_they_are_sent_and_hold_nothing() -> None:
    controller = between(0.0)
    assert isinstance(controller.gripper, Gripper)
    for opening in (0.03, 0.0, 0.08):
        controller.gripper.move(opening)
        controller.step()
        assert controller.gripper.moving()
        gripper = settle(controller)
        assert gripper.opening() == pytest.approx(opening, abs=1.5e-3)
        assert not gripper.holds()


@pytest.mark.parametrize("force", [20.0, 70.0])
@pytest.mark.parametrize("width", [0.01, 0.05])
def test_what_is_held_is_pressed_with_the_force_that_was_required(width: float, force: float) -> None:
    controller = between(width)
    assert controller.gripper is not None
    controller.gripper.move(0.0, force=force)
    gripper = settle(controller)
    for _ in range(300):
        controller.step()
    assert gripper.holds()
    assert pressed(controller) == pytest.approx(force, rel=0.05)
    assert width - 2e-3 < gripper.opening() < width + 1e-3  # contacts are soft


def test_it_never_presses_harder_than_the_gripper_can_and_not_faster_than_commanded() -> None:
    controller = between(0.05)
    gripper = controller.gripper
    assert gripper is not None
    gripper.move(0.0, force=1e4, speed=0.02)
    assert gripper.force == 70.0
    for _ in range(200):
        controller.step()
    assert gripper.opening() == pytest.approx(0.08 - 0.2 * 0.02, abs=2e-3)
    gripper.stop()
    at = gripper.opening()
    for _ in range(300):
        controller.step()
    assert gripper.opening() == pytest.approx(at, abs=1.5e-3)
    with pytest.raises(InputError, match="opening"):
        gripper.move(0.2)


def test_a_twin_without_fingers_has_no_gripper() -> None:
    with pytest.raises(InputError, match="has no gripper"):
        TwinGripper(Twin(make_scene({"name": "bare", "robot": None})))
