"""Backlash of the gears: after a reversal the joint rests until the motor has crossed the gap."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from splatbot.protocols import Array
from splatbot.sim.effects.physics import Hook, MotorEffect

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene


class PlayOperator(Hook):
    """Play operator y = clip(y, u - gap / 2, u + gap / 2) (Visintin 1994, ch. III)."""

    def __init__(self, gap: float) -> None:
        self._half = gap / 2
        self._at: Array | None = None

    def reset(self) -> None:
        """Place each joint in the middle of its gap."""
        self._at = None

    def on_targets(self, targets: Array) -> Array:
        """Return the targets (J,) [rad] behind the backlash."""
        self._at = targets if self._at is None else np.clip(self._at, targets - self._half, targets + self._half)
        return self._at


class Backlash(MotorEffect, cost="one clamp for each joint and control period"):
    """Hysteresis of the joint targets by the play operator (Visintin 1994, ch. III).

    The gap [rad] is ``robot.motors.backlash`` of the scene, the same for each joint.
    """

    parameter = "backlash"
    quantity = "backlash"

    def describe(self, value: float) -> str:
        """Describe the parameter's effect in a reason."""
        return f"gears have a backlash of {1e3 * value:g} mrad"

    def hook(self, model: Any, scene: Scene) -> Hook | None:
        """Create the play operator, which stores the position of each joint in its gap."""
        return PlayOperator(scene.robot.motors.backlash) if scene.robot is not None else None


EFFECT = Backlash()
