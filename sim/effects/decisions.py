"""Whether an effect is on, why, and who said so."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene


@dataclass(frozen=True)
class EffectDecision:
    """Whether an effect is on, why, and who said so: the scene's content, or `forced`, `forbidden`."""

    name: str
    on: bool
    why: str
    by: str = "scene"


def decide(name: str, scene: Scene, called_for: str, not_called_for: str) -> EffectDecision:
    """What becomes of an effect that the scene calls for, or does not (empty), each with its reason."""
    if name in scene.effects.forbid:
        return EffectDecision(name, False, f"forbidden by the scene; {called_for or not_called_for}", "forbidden")
    if name in scene.effects.force and not called_for:
        return EffectDecision(name, True, f"forced by the scene; {not_called_for}", "forced")
    return EffectDecision(name, bool(called_for), called_for or not_called_for)
