"""Who says what a name means, for commands that take one."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from splatbot.grasping.affordance import Affordance


def name_backends(*, vlm: bool) -> list[Affordance]:
    """The rules; before them, if asked for, the model of SPLATBOT_VLM_URL and SPLATBOT_VLM_MODEL, which they check.

    Raises:
        InputError: the model is asked for and not named in the environment.
    """
    from splatbot.grasping.language import LanguageAffordance

    rules = LanguageAffordance()
    if not vlm:
        return [rules]
    from splatbot.grasping.vision import EndpointModel, VisionAffordance

    return [VisionAffordance(EndpointModel.from_environment(), rules=rules), rules]
