"""Who says where to grasp: hints, the backends that understand them, and the target that they find."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import SplatbotError
from splatbot.protocols import Array
from splatbot.segmentation import SegmentedMap


@dataclass(frozen=True, eq=False)
class ObservedView:
    """A camera that looks at the map.

    Args:
        camera: without distortion.
        T_world_camera: (4, 4).
        rgb: (H, W, 3) uint8, what it saw, for backends that look at pictures; None: the map as it renders.
    """

    camera: Camera
    T_world_camera: Array
    rgb: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class NameHint:
    """Words: a name, or what the thing looks like ("red cup", "largest box", "the box left of the tape")."""

    text: str


@dataclass(frozen=True, eq=False)
class PixelHint:
    """A pixel (u, v) of a view; integers are centres of pixels."""

    u: float
    v: float
    view: ObservedView


@dataclass(frozen=True, eq=False)
class PointHint:
    """A point (3,) on or in the thing [m, world]."""

    point: Array


@dataclass(frozen=True, eq=False)
class MaskHint:
    """Pixels (H, W) bool of a view."""

    mask: NDArray[np.bool_]
    view: ObservedView


@dataclass(frozen=True, eq=False)
class BoxHint:
    """A rectangle of a view [px], both corners within it."""

    u0: float
    v0: float
    u1: float
    v1: float
    view: ObservedView


@dataclass(frozen=True, eq=False)
class TagHint:
    """An AprilTag on the thing, in any of the views.

    Args:
        number: of the tag.
        views: with pictures.
        family: of the tag, as OpenCV's ``DICT_APRILTAG_36h11``.
    """

    number: int
    views: tuple[ObservedView, ...]
    family: str = "36h11"


Hint = NameHint | PixelHint | PointHint | MaskHint | BoxHint | TagHint


@dataclass(frozen=True, eq=False)
class Target:
    """What shall be grasped.

    Args:
        rows: (M,) int64, its Gaussians in the scene's map.
        point: (3,) on it [m, world]: grasps near to it are better, where one was pointed at; None: anywhere.
        label: what it is called in answers.
        backend: who found it.
        score: 0..1, how sure that is.
        notes: what was considered, in words.
        number: of the object in the scene; -1: it is no segmented object.
    """

    rows: NDArray[np.int64]
    point: Array | None
    label: str
    backend: str
    score: float
    notes: tuple[str, ...] = field(default=())
    number: int = -1


class AffordanceError(SplatbotError):
    """No backend can say which object is meant, or more than one is (INVALID_OBJECT_NAME).

    Args:
        message: as of :class:`splatbot.errors.SplatbotError`.
        field: likewise.
        hint: likewise.
        candidates: what it could have been.
    """

    http_status = 422
    exit_code = 2
    code = -20

    def __init__(
        self, message: str, *, field: str | None = None, hint: str | None = None, candidates: tuple[str, ...] = ()
    ) -> None:
        self.candidates = candidates
        super().__init__(message, field=field, hint=hint)


@runtime_checkable
class Affordance(Protocol):
    """A backend that finds the target of some kinds of hints."""

    @property
    def name(self) -> str:
        """As results tell it."""
        ...

    def understands(self, hint: Hint) -> bool:
        """Whether it is worth asking."""
        ...

    def locate(self, hint: Hint, scene: SegmentedMap) -> Target:
        """The target.

        Raises:
            AffordanceError: there is none, or it is not clear which is meant.
            InputError: the hint makes no sense, as a pixel out of its view.
        """
        ...


def find_target(hint: Hint, scene: SegmentedMap, backends: Sequence[Affordance]) -> Target:
    """The answer of the first backend that has one; what those before it said is among its notes.

    Raises:
        AffordanceError: none has one; the message says what each said.
        InputError: the hint makes no sense.
    """
    said: list[str] = []
    candidates: tuple[str, ...] = ()
    for backend in backends:
        if not backend.understands(hint):
            continue
        try:
            target = backend.locate(hint, scene)
        except AffordanceError as error:
            said.append(f"{backend.name}: {error}")
            candidates = candidates or error.candidates
            continue
        return _with_notes(target, tuple(said))
    if not said:
        raise AffordanceError(
            f"is a {type(hint).__name__}, which none of {len(backends)} backends understands.", field="target"
        )
    raise AffordanceError(" | ".join(said), field="target", candidates=candidates)


def _with_notes(target: Target, more: tuple[str, ...]) -> Target:
    return Target(
        target.rows, target.point, target.label, target.backend, target.score, (*more, *target.notes), target.number
    )
