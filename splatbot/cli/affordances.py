"""Affordance backends that resolve the name of a target."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from splatbot.grasping.affordance import Affordance


def name_backends(*, vlm: bool) -> list[Affordance]:
    """Return the rules; with ``vlm``, first the model of SPLATBOT_VLM_URL and SPLATBOT_VLM_MODEL, which they check.

    Raises:
        InputError: ``vlm`` is set and the environment names no model.
    """
    from splatbot.grasping.language import LanguageAffordance

    rules = LanguageAffordance()
    if not vlm:
        return [rules]
    from splatbot.grasping.vision import EndpointModel, VisionAffordance

    return [VisionAffordance(EndpointModel.from_environment(), rules=rules), rules]
