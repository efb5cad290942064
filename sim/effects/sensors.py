"""Sensor effects of a scene's camera with their reasons; their modules are not imported."""

from __future__ import annotations

from typing import TYPE_CHECKING

from splatbot.sim.effects.decisions import EffectDecision, decide
from splatbot.sim.effects.registry import EFFECTS

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene


def sensor_effects_for(scene: Scene) -> tuple[EffectDecision, ...]:
    """Decide on every sensor effect, in the order of :data:`EFFECTS`."""
    named = {_name(spec): spec for spec in (scene.camera.sensor if scene.camera is not None else ())}
    absent = "there is no camera" if scene.camera is None else "the camera's sensor does not name it"
    return tuple(
        decide(name, scene, name in named, f"the camera's sensor names {named[name]}" if name in named else absent)
        for name in EFFECTS
    )


def sensor_specs(scene: Scene) -> tuple[str, ...]:
    """Return the specs of the sensor's effects in order, without forbidden ones; forced ones come last."""
    if scene.camera is None:
        return ()
    kept = tuple(spec for spec in scene.camera.sensor if _name(spec) not in scene.effects.forbid)
    named = {_name(spec) for spec in kept}
    return kept + tuple(name for name in EFFECTS if name in scene.effects.force and name not in named)


def _name(spec: str) -> str:
    return spec.partition(":")[0].strip()
