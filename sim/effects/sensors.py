"""Which sensor effects a scene's camera goes through, and why; none of their modules is imported for that."""

from __future__ import annotations

from typing import TYPE_CHECKING

from splatbot.sim.effects.decisions import EffectDecision, decide
from splatbot.sim.effects.registry import EFFECTS

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene


def sensor_effects_for(scene: Scene) -> tuple[EffectDecision, ...]:
    """A decision on every sensor effect, in the order of :data:`EFFECTS`."""
    named = {_name(spec): spec for spec in (scene.camera.sensor if scene.camera is not None else ())}
    absent = "no camera looks" if scene.camera is None else "the camera's sensor does not name it"
    return tuple(
        decide(name, scene, f"the camera's sensor names {named[name]}" if name in named else "", absent)
        for name in EFFECTS
    )


def sensor_specs(scene: Scene) -> tuple[str, ...]:
    """The specs of the sensor's effects in their order, less what is forbidden; what is forced comes last."""
    if scene.camera is None:
        return ()
    kept = tuple(spec for spec in scene.camera.sensor if _name(spec) not in scene.effects.forbid)
    named = {_name(spec) for spec in kept}
    return kept + tuple(name for name in EFFECTS if name in scene.effects.force and name not in named)


def _name(spec: str) -> str:
    return spec.partition(":")[0].strip()
