"""The twin as a controller: it follows, stops, faults, and holds."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.collision import RobotSpheres
from splatbot.errors import ControllerError, InputError
from splatbot.planning import CertifiedMotion, WaypointMotion, certify_motion
from splatbot.protocols import Controller, MotionState
from splatbot.robots.panda import panda
from splatbot.sim.controller import TwinController
from splatbot.sim.motion import minimum_jerk
from splatbot.sim.scene import load_scene, make_scene
from splatbot.sim.twin import Twin

pytest.importorskip("mujoco")


def _swing(duration: float = 1.0) -> CertifiedMotion:
    """Return a minimum-jerk motion."""
    ends = np.stack([panda().home, panda().home + np.array([0.5, 0.2, -0.3, 0.2, 0.3, -0.2, 0.4])])
    times = np.linspace(0.0, duration, 101)
    motion = WaypointMotion(times, minimum_jerk(times, np.array([0.0, duration]), ends, 0))
    return certify_motion(motion, RobotSpheres(panda()), None)


def test_it_is_a_controller_that_follows_within_two_milliradians_and_arrives() -> None:
    controller = TwinController(Twin(load_scene("empty")))
    assert isinstance(controller, Controller)
    controller.send(_swing())
    errors = []
    while (feedback := controller.step()).state is MotionState.MOVING:
        errors.append(feedback.error)
    assert feedback.state is MotionState.DONE
    assert len(errors) == pytest.approx(1000, abs=2)
    assert max(errors) < 2e-3


def test_on_a_stop_request_it_comes_to_rest_where_it_was() -> None:
    controller = TwinController(Twin(load_scene("empty")))
    controller.send(_swing())
    for _ in range(500):
        moving = controller.step()
    controller.stop()
    assert controller.step().state is MotionState.STOPPED
    for _ in range(500):
        resting = controller.step()
    assert np.abs(moving.velocity).max() > 0.5
    assert np.abs(resting.velocity).max() < 1e-3
    assert np.abs(resting.position - moving.position).max() < 5e-3


def test_an_arm_that_is_held_up_faults() -> None:
    """A wall through which the swing leads."""
    tcp = panda().tcp(panda().home)[:3, 3]
    wall = {"name": "wall", "shapes": [{"kind": "box", "size": [0.4, 0.02, 1.5]}], "at": [tcp[0], 0.14, 0.75]}
    controller = TwinController(Twin(make_scene({"name": "x", "objects": [wall]})), following=0.02)
    controller.send(_swing())
    while (feedback := controller.step()).state is MotionState.MOVING:
        pass
    assert feedback.state is MotionState.FAULT
    assert "from the trajectory" in feedback.fault
    with pytest.raises(ControllerError, match="at fault"):
        controller.send(_swing())
    controller.reset()
    assert controller.step().state is MotionState.IDLE


def test_a_twin_without_a_robot_is_no_controller() -> None:
    with pytest.raises(InputError, match="has no robot"):
        TwinController(Twin(make_scene({"name": "bare", "robot": None})))
