"""Play between motor and joint: after a turn the joint waits until the gap is crossed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from splatbot.protocols import Array
from splatbot.sim.effects.physics import Hook, PhysicsEffect

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene


class Play(Hook):
    """The play operator: the output moves only when the input leaves a gap around it (Visintin 1994, ch. III)."""

    def __init__(self, gap: float) -> None:
        self._half = gap / 2
        self._at: Array | None = None

    def reset(self) -> None:
        """The joint is in the middle of its gap."""
        self._at = None

    def on_targets(self, targets: Array) -> Array:
        """Targets (J,) as the joints feel them."""
        self._at = targets if self._at is None else np.clip(self._at, targets - self._half, targets + self._half)
        return self._at


class Backlash(PhysicsEffect):
    """Hysteresis of the targets."""

    name = "backlash"
    cost = "a clamp for each joint, once a control period"
    observable = "tracking_rms"

    def called_for(self, scene: Scene) -> str:
        """The scene gives a gap."""
        gap = scene.robot.motors.backlash if scene.robot is not None else 0.0
        return f"gears have a play of {1e3 * gap:g} mrad" if gap > 0 else ""

    def not_called_for(self, scene: Scene) -> str:
        """There is none."""
        return "no play is given" if scene.robot is not None else "there is no robot"

    def hook(self, model: Any, scene: Scene) -> Hook | None:
        """Keeps where each joint is in its gap."""
        return Play(scene.robot.motors.backlash) if scene.robot is not None else None


EFFECT = Backlash()
