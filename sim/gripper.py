"""The twin's fingers as a gripper: they go at a speed, and press with the force that is asked for."""

from __future__ import annotations

import numpy as np

from splatbot.errors import InputError
from splatbot.robots.grippers.checks import check_move
from splatbot.sim.twin import Twin
from splatbot.sim.world import gripper_joints

SPEED = 0.1  # [m/s] of the opening
_THERE = 1e-3  # [m]
_STILL = 2e-3  # [m/s] of a finger
_PRESSED = 0.9  # share of the force from which on something is held


class TwinGripper:
    """A :class:`splatbot.protocols.Gripper` of a twin, whose time passes with its controller's.

    The servo is a spring; its command is kept as far from the fingers as the force stretches it. Fingers that something
    keeps from their opening are pressed with that force in full, whatever the width of what they hold.

    Args:
        twin: with a robot that has a gripper.

    Raises:
        InputError: it has none.
    """

    def __init__(self, twin: Twin) -> None:
        robot = twin.world.robot
        if robot is None or robot.gripper is None:
            raise InputError("has no gripper.", field=twin.scene.name, hint="give the scene a robot with fingers")
        self._twin, self._own = twin, robot.gripper
        self._qpos, self._dofs, act = gripper_joints(twin.world.model, robot)
        self._stiffness = float(twin.world.model.actuator_gainprm[act, 0])
        twin.world.model.actuator_ctrllimited[act] = 0  # to press, the command lies beyond the closed fingers
        self._wanted = self._command = self.opening()
        self._force, self._speed = self._own.force, SPEED

    @property
    def stroke(self) -> float:
        """Widest opening [m]."""
        return 2 * self._own.stroke

    @property
    def force(self) -> float:
        """That the fingers press with [N]."""
        return self._force

    def move(self, opening: float, *, force: float | None = None, speed: float | None = None) -> None:
        """Go towards an opening [m]; by default with the gripper's own force [N] (the Panda's 70), at 0.1 m/s.

        Raises:
            InputError: a value is out of range.
        """
        check_move(self.stroke, opening, force, speed)
        self._wanted = opening
        self._force = self._own.force if force is None else min(force, self._own.force)
        self._speed = SPEED if speed is None else min(speed, 2 * self._own.speed)

    def moving(self) -> bool:
        """Whether the fingers are still on their way."""
        fast = float(np.abs(self._twin.data.qvel[self._dofs]).max()) > _STILL
        return not self._there() and (fast or not self._presses())

    def opening(self) -> float:
        """Between the fingers now [m]."""
        return float(self._twin.data.qpos[self._qpos].sum())

    def holds(self) -> bool:
        """Whether the fingers press on something, away from where they were sent."""
        return not self._there() and self._presses()

    def stop(self) -> None:
        """Stay where they are."""
        self._wanted = self.opening()

    def command(self, period: float) -> float:
        """What the servo is told for the next control period [s]: an opening [m] that may lie beyond what there is."""
        now, reach = self.opening(), self._force / self._stiffness
        goal = self._wanted if self._there() else now + np.copysign(reach, self._wanted - now)
        if abs(self._wanted - now) > reach:
            goal = self._wanted
        step = float(np.clip(goal - self._command, -self._speed * period, self._speed * period))
        self._command = float(np.clip(self._command + step, now - reach, now + reach))
        return self._command

    def _there(self) -> bool:
        return abs(self.opening() - self._wanted) < _THERE

    def _presses(self) -> bool:
        return abs(self._command - self.opening()) * self._stiffness > _PRESSED * self._force
