"""What a physics effect is, and which of them a scene calls for."""

from __future__ import annotations

import importlib
from functools import cache
from typing import TYPE_CHECKING, Any

from splatbot.protocols import Array
from splatbot.sim.effects.decisions import EffectDecision, decide
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
"""The names, in the order in which they are built; each is a module of this package."""


class Hook:
    """What an effect does while a twin runs; does nothing unless overridden. Counts its calls."""

    def reset(self) -> None:
        """The run begins anew."""

    def on_targets(self, targets: Array) -> Array:
        """The joints' targets (J,) as they reach the motors."""
        return targets

    def on_step(self, data: Any, time: float) -> None:
        """Before the physics of a control period that begins at ``time`` [s]."""


class PhysicsEffect:
    """Physics that can be left out.

    ``name`` is its module's; ``cost`` says what it makes MuJoCo do; ``observable`` names the figure of a run that
    changes when a scene that calls for it goes without.
    """

    name: str
    cost: str
    observable: str

    def called_for(self, scene: Scene) -> str:
        """Why the scene needs it; empty if it does not."""
        raise NotImplementedError

    def not_called_for(self, scene: Scene) -> str:
        """Why not, in a few words."""
        raise NotImplementedError

    def build(self, draft: Draft) -> None:
        """Put it into the model."""

    def hook(self, model: Any, scene: Scene) -> Hook | None:
        """What it does while the twin runs, if anything."""
        return None


@cache
def physics_effect(name: str) -> PhysicsEffect:
    """The effect of a name of :data:`PHYSICS`; its module is imported now."""
    effect: PhysicsEffect = importlib.import_module(f"splatbot.sim.effects.{name}").EFFECT
    return effect


def effects_for(scene: Scene) -> tuple[EffectDecision, ...]:
    """A decision on every effect: physics in the order of :data:`PHYSICS`, then the camera's sensor."""
    physics = (physics_effect(name) for name in PHYSICS)
    decided = (decide(e.name, scene, e.called_for(scene), e.not_called_for(scene)) for e in physics)
    return (*decided, *sensor_effects_for(scene))


def names_of(things: Any, most: int = 3) -> str:
    """Names of a few objects, as in "cup, box and 4 more"."""
    names = [thing.name for thing in things]
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")
