"""The decision whether an effect is active, with its reason."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene


@dataclass(frozen=True)
class EffectDecision:
    """State of an effect (active or not), the reason, and its origin: the scene's content, `forced` or `forbidden`."""

    name: str
    on: bool
    why: str
    by: str = "scene"


def decide(name: str, scene: Scene, required: bool, reason: str) -> EffectDecision:
    """Decide on an effect that the scene requires or not for ``reason``; forbid and force take precedence."""
    if name in scene.effects.forbid:
        return EffectDecision(name, False, f"forbidden by the scene; {reason}", "forbidden")
    if name in scene.effects.force and not required:
        return EffectDecision(name, True, f"forced by the scene; {reason}", "forced")
    return EffectDecision(name, required, reason)
