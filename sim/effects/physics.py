"""Protocol of physics effects, and the decision which of them a scene requires."""

from __future__ import annotations

import importlib
from functools import cache
from typing import TYPE_CHECKING, Any

from splatbot.protocols import Array
from splatbot.sim.effects.decisions import EffectDecision, decide
from splatbot.sim.effects.declaration import DeclaredEffect
from splatbot.sim.effects.sensors import sensor_effects_for

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene
    from splatbot.sim.world import Draft

PHYSICS = (
    "soft_bodies",
    "contact",
    "friction",
    "gripper_compliance",
    "torque_limits",
    "actuator_lag",
    "joint_friction",
    "backlash",
    "fluid_drag",
    "moving_obstacles",
    "lighting",
    "view_color",
    "sleep",
)
"""Names in the order in which effects are built; each is a module of this package."""


class Hook:
    """Callbacks of an effect while a twin runs; the base class changes no state."""

    def reset(self) -> None:
        """Reset the state at the start of a run."""

    def on_targets(self, targets: Array) -> Array:
        """Transform the joint targets (J,) [rad] on their path to the motors."""
        return targets

    def on_step(self, data: Any, time: float) -> None:
        """Update the simulation before the physics of a control period that begins at ``time`` [s]."""


class PhysicsEffect(DeclaredEffect):
    """A physical phenomenon that can be left out of the simulation.

    ``cost`` describes the computation in MuJoCo. ``observable`` names the result of a run that changes if a scene that
    requires the effect runs without it.
    """

    def required(self, scene: Scene) -> tuple[bool, str]:
        """Return whether the scene requires the effect, and the reason for or against it."""
        raise NotImplementedError

    def build(self, draft: Draft) -> None:
        """Add the effect to the model."""

    def hook(self, model: Any, scene: Scene) -> Hook | None:
        """Create the callbacks of the effect, or None if it has none."""
        return None


class MotorEffect(PhysicsEffect, observable="tracking_rms"):
    """An effect that the scene requires if one of the ``robot.motors`` parameters is above zero.

    ``parameter`` names that parameter, ``quantity`` describes it.
    """

    parameter: str
    quantity: str

    def required(self, scene: Scene) -> tuple[bool, str]:
        """Return whether the scene gives the parameter, and why."""
        if scene.robot is None:
            return False, "there is no robot"
        value = float(getattr(scene.robot.motors, self.parameter))
        return (True, self.describe(value)) if value > 0 else (False, f"no {self.quantity} is given")

    def describe(self, value: float) -> str:
        """Describe the parameter's effect in a reason."""
        raise NotImplementedError


@cache
def physics_effect(name: str) -> PhysicsEffect:
    """Import and return the effect of a name in :data:`PHYSICS`."""
    effect: PhysicsEffect = importlib.import_module(f"splatbot.sim.effects.{name}").EFFECT
    return effect


def effects_for(scene: Scene) -> tuple[EffectDecision, ...]:
    """Decide on every effect: physics in the order of :data:`PHYSICS`, then the sensor effects of the camera."""
    physics = (physics_effect(name) for name in PHYSICS)
    decided = (decide(effect.name, scene, *effect.required(scene)) for effect in physics)
    return (*decided, *sensor_effects_for(scene))


def names_of(objects: Any, most: int = 3) -> str:
    """Join the names of a few objects, as in "cup, box and 4 more"."""
    names = [obj.name for obj in objects]
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")
