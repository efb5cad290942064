"""The arm's low-level controller: joint targets to actuator commands, with feedforward of gravity and inertia."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from splatbot.protocols import Array
from splatbot.sim.motion import JointMotion
from splatbot.sim.world import World, gripper_joints, robot_joints


class Follower:
    """Computes the actuator commands of each control period by computed torque (Siciliano et al. 2009, ch. 8.5.2).

    The motors are spring-dampers: τ = k (u - q) - d q̇. The command u = q + (d q̇ + M q̈ + b) / k makes the undisturbed
    arm follow q exactly. M is the inertia and b the gravity and Coriolis forces at the current state.
    """

    def __init__(self, world: World) -> None:
        assert world.robot is not None
        assert world.scene.robot is not None
        self._world, m = world, world.model
        self.qpos, self.dofs, self._acts = robot_joints(m, world.robot)
        self._stiffness = np.array(m.actuator_gainprm[self._acts, 0])
        damping = np.asarray(m.dof_damping).reshape(m.nv, -1)[:, 0]  # MuJoCo 4 has polynomials of the speed
        self._damping = -np.array(m.actuator_biasprm[self._acts, 2]) + damping[self.dofs]
        self._feedforward = world.scene.robot.motors.feedforward
        self._gripper = gripper_joints(m, world.robot) if world.robot.gripper is not None else None
        self._acceleration, self._torque = np.zeros(m.nv), np.zeros(m.nv)

    def place(self, data: Any, q: Array, opening: float | None) -> None:
        """Place the arm at rest at ``q`` (J,), with the gripper at ``opening`` [m]."""
        data.qpos[self.qpos] = q
        if self._gripper is not None and opening is not None:
            data.qpos[self._gripper[0]] = opening / 2
            data.ctrl[self._gripper[2]] = opening

    def command(self, data: Any, q: Array, velocity: Array, acceleration: Array, opening: float | None) -> None:
        """Set the actuator commands for targets (J,)."""
        u = q + self._damping * velocity / self._stiffness
        if self._feedforward:
            self._acceleration[self.dofs] = acceleration
            mujoco.mj_mulM(self._world.model, data, self._torque, self._acceleration)
            u = u + (self._torque + data.qfrc_bias)[self.dofs] / self._stiffness
        data.ctrl[self._acts] = u
        if self._gripper is not None and opening is not None:
            data.ctrl[self._gripper[2]] = opening

    def opening(self, data: Any) -> float:
        """Return the opening of the gripper [m]; 0 without one."""
        return float(data.qpos[self._gripper[0]].sum()) if self._gripper is not None else 0.0

    def settle_lag(self, data: Any) -> None:
        """Initialize the activations of lagging actuators with their first command instead of zero."""
        m = self._world.model
        for k in self._acts:
            if m.actuator_actadr[k] >= 0:
                data.act[m.actuator_actadr[k]] = data.ctrl[k]


def targets_of(motion: JointMotion, steps: int, period: float) -> tuple[Array, Array, Array, Array | None]:
    """Sample the targets at the ends of ``steps`` control periods."""
    return motion.at(period * np.arange(1, steps + 1))
