"""Interface of vision-language models: question, answer and errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from splatbot.grasping.affordance import AffordanceError

Picture = NDArray[np.uint8]  # (H, W, 3) RGB


class VisionError(AffordanceError):
    """A model gives no usable answer; another backend may find the object.

    Args:
        message: see :class:`splatbot.errors.SplatbotError`.
        field: see :class:`splatbot.errors.SplatbotError`.
        hint: see :class:`splatbot.errors.SplatbotError`.
        again: whether another attempt may succeed.
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
    """A question to a model.

    Args:
        rules: system prompt with the answer format.
        text: user prompt.
        pictures: images, numbered from 0.
    """

    rules: str
    text: str
    pictures: Sequence[Picture]


class VisionModel(Protocol):
    """A model that answers with text to text and images."""

    @property
    def name(self) -> str:
        """Name of the model in results."""
        ...

    def ask(self, question: Question) -> str:
        """Return the unchecked answer of the model.

        Raises:
            VisionError: the model gives no answer.
        """
        ...
