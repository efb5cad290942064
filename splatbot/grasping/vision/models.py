"""What a vision-language model is asked, and how it fails."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from splatbot.grasping.affordance import AffordanceError

Picture = NDArray[np.uint8]  # (H, W, 3) RGB


class VisionError(AffordanceError):
    """A model gives no answer that can be used; another backend may.

    Args:
        message: as of :class:`splatbot.errors.SplatbotError`.
        field: likewise.
        hint: likewise.
        again: whether asking again may help.
    """

    def __init__(self, message: str, *, field: str | None = None, hint: str | None = None, again: bool = False) -> None:
        self.again = again
        super().__init__(message, field=field, hint=hint)


class VisionTimeoutError(VisionError):
    """A model did not answer in time (TIMED_OUT)."""

    http_status = 504
    code = -6


@dataclass(frozen=True, eq=False)
class Question:
    """What is asked.

    Args:
        rules: how to answer.
        text: what is wanted.
        pictures: that the answer is about, numbered from 0.
    """

    rules: str
    text: str
    pictures: Sequence[Picture]


class VisionModel(Protocol):
    """Text from text and pictures."""

    @property
    def name(self) -> str:
        """As results tell it."""
        ...

    def ask(self, question: Question) -> str:
        """Its answer, to be checked.

        Raises:
            VisionError: there is none.
        """
        ...
