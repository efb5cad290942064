"""The twin's fingers as a gripper with speed and force control."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatbot.errors import InputError
from splatbot.robots.grippers.checks import check_move
from splatbot.sim.twin import Twin
from splatbot.sim.world import gripper_joints


@dataclass(frozen=True)
class GripperConstants:
    """Constants of the twin's gripper.

    Args:
        speed: [m/s] speed of the opening.
        opening_tolerance: [m] error of the opening at the goal.
        rest_speed: [m/s] speed of a finger below which it rests.
        pressed_share: fraction of the force above which an object is held.
    """

    speed: float = 0.1
    opening_tolerance: float = 1e-3
    rest_speed: float = 2e-3
    pressed_share: float = 0.9


CONSTANTS = GripperConstants()


class TwinGripper:
    """A :class:`splatbot.protocols.Gripper` of a twin, which advances with the twin's controller.

    The servo is a spring. Its command differs from the finger position by at most force / stiffness, so blocked fingers
    press with the commanded force at any object width.

    Args:
        twin: with a robot that has a gripper.

    Raises:
        InputError: the robot has no gripper.
    """

    def __init__(self, twin: Twin) -> None:
        robot = twin.world.robot
        if robot is None or robot.gripper is None:
            raise InputError("has no gripper.", field=twin.scene.name, hint="give the scene a robot with fingers")
        self._twin, self._own = twin, robot.gripper
        self._qpos, self._dofs, act = gripper_joints(twin.world.model, robot)
        self._stiffness = float(twin.world.model.actuator_gainprm[act, 0])
        twin.world.model.actuator_ctrllimited[act] = 0  # to press, the command lies beyond the closed fingers
        self._goal = self._command = self.opening()
        self._force, self._speed = self._own.force, CONSTANTS.speed

    @property
    def stroke(self) -> float:
        """Widest opening [m]."""
        return 2 * self._own.stroke

    @property
    def force(self) -> float:
        """Commanded normal force [N] of the fingers."""
        return self._force

    def move(self, opening: float, *, force: float | None = None, speed: float | None = None) -> None:
        """Move to an opening [m]; see :class:`splatbot.protocols.Gripper`.

        The default is the gripper's own force (70 N for the Panda) and 0.1 m/s.
        """
        check_move(self.stroke, opening, force, speed)
        self._goal = opening
        self._force = self._own.force if force is None else min(force, self._own.force)
        self._speed = CONSTANTS.speed if speed is None else min(speed, 2 * self._own.speed)

    def moving(self) -> bool:
        """Return whether the fingers are still moving to their goal."""
        fast = float(np.abs(self._twin.data.qvel[self._dofs]).max()) > CONSTANTS.rest_speed
        return not self._at_goal() and (fast or not self._presses())

    def opening(self) -> float:
        """Return the distance between the fingers [m]."""
        return float(self._twin.data.qpos[self._qpos].sum())

    def holds(self) -> bool:
        """Return whether the fingers press on an object before they reach their goal."""
        return not self._at_goal() and self._presses()

    def stop(self) -> None:
        """Hold the current opening."""
        self._goal = self.opening()

    def command(self, period: float) -> float:
        """Compute the servo command of the next control period [s]: an opening [m] that can be beyond its range."""
        now, reach = self.opening(), self._force / self._stiffness
        goal = self._goal if self._at_goal() else now + np.copysign(reach, self._goal - now)
        if abs(self._goal - now) > reach:
            goal = self._goal
        step = float(np.clip(goal - self._command, -self._speed * period, self._speed * period))
        self._command = float(np.clip(self._command + step, now - reach, now + reach))
        return self._command

    def _at_goal(self) -> bool:
        return abs(self.opening() - self._goal) < CONSTANTS.opening_tolerance

    def _presses(self) -> bool:
        return abs(self._command - self.opening()) * self._stiffness > CONSTANTS.pressed_share * self._force
