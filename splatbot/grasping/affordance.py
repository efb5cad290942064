"""Target selection: hints, the backends that resolve them, and the target that results."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import InputError, SplatbotError
from splatbot.protocols import Array
from splatbot.segmentation import SegmentedMap


@dataclass(frozen=True, eq=False)
class ObservedView:
    """A camera pose with an optional image.

    Args:
        camera: undistorted pinhole camera.
        T_world_camera: (4, 4) pose of the camera.
        rgb: (H, W, 3) uint8 image for backends that use images. If None, the map is rendered.
        depth: (H, W) measured depth [m], 0 where missing or at the robot. Masks count where it agrees with the map.
            If None, the map is rendered.
    """

    camera: Camera
    T_world_camera: Array
    rgb: NDArray[np.uint8] | None = None
    depth: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class NameHint:
    """A name or a description of the object ("red cup", "largest box", "the box left of the tape")."""

    text: str


@dataclass(frozen=True, eq=False)
class PixelHint:
    """A pixel (u, v) of a view; integers are centres of pixels."""

    u: float
    v: float
    view: ObservedView


@dataclass(frozen=True, eq=False)
class PointHint:
    """A point (3,) on or in the object [m, world]."""

    point: Array


@dataclass(frozen=True, eq=False)
class MaskHint:
    """Pixels (H, W) bool of a view."""

    mask: NDArray[np.bool_]
    view: ObservedView


@dataclass(frozen=True, eq=False)
class MasksHint:
    """Masks of one object in several views, as video segmentation gives them; they separate touching objects."""

    masks: tuple[MaskHint, ...]


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
    """An AprilTag on the object, visible in at least one view.

    Args:
        number: id of the tag.
        views: views with images.
        family: tag family, the suffix of OpenCV's ``DICT_APRILTAG_36h11``.
    """

    number: int
    views: tuple[ObservedView, ...]
    family: str = "36h11"


Hint = NameHint | PixelHint | PointHint | MaskHint | MasksHint | BoxHint | TagHint
H = TypeVar("H", NameHint, TagHint)


@dataclass(frozen=True, eq=False)
class Target:
    """The object to grasp.

    Args:
        rows: (M,) int64 indices of its Gaussians in the map of the scene.
        point: (3,) indicated point on it [m, world], near which grasps score higher. If None, no point is preferred.
        label: name of the target in results.
        backend: name of the backend that found it.
        score: confidence, 0..1.
        notes: remarks on the selection, each a sentence.
        number: index of the object in the scene; -1 if it is not a segmented object.
    """

    rows: NDArray[np.int64]
    point: Array | None
    label: str
    backend: str
    score: float
    notes: tuple[str, ...] = field(default=())
    number: int = -1


class AffordanceError(SplatbotError):
    """No backend found the object, or the hint is ambiguous (INVALID_OBJECT_NAME).

    Args:
        message: see :class:`splatbot.errors.SplatbotError`.
        field: see :class:`splatbot.errors.SplatbotError`.
        hint: see :class:`splatbot.errors.SplatbotError`.
        candidates: descriptions of the objects that match best.
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
    """A backend that resolves some kinds of hints to a target."""

    @property
    def name(self) -> str:
        """Name of the backend in results."""
        ...

    def understands(self, hint: Hint) -> bool:
        """Return whether the backend can resolve this kind of hint."""
        ...

    def locate(self, hint: Hint, scene: SegmentedMap) -> Target:
        """Find the target of a hint.

        Raises:
            AffordanceError: no object matches, or the hint is ambiguous.
            InputError: the hint is invalid, for example a pixel outside of its view.
        """
        ...


class OneKindAffordance(ABC, Generic[H]):
    """The common part of backends that resolve one kind of hint; see :class:`Affordance`."""

    kind: type[H]
    wanted: str
    """The hint to give, in words, for the error about another kind."""

    def understands(self, hint: Hint) -> bool:
        """Return whether the hint is of the kind."""
        return isinstance(hint, self.kind)

    def locate(self, hint: Hint, scene: SegmentedMap) -> Target:
        """Find the target of a hint; see :meth:`Affordance.locate`."""
        if not isinstance(hint, self.kind):
            raise InputError(f"is a {type(hint).__name__}.", field="hint", hint=f"give {self.wanted}")
        return self._find(hint, scene)

    @abstractmethod
    def _find(self, hint: H, scene: SegmentedMap) -> Target: ...


def find_target(hint: Hint, scene: SegmentedMap, backends: Sequence[Affordance]) -> Target:
    """Return the target from the first backend that finds one; its notes include the errors of earlier backends.

    Raises:
        AffordanceError: no backend found a target; the message contains the error of each.
        InputError: the hint is invalid.
    """
    errors: list[str] = []
    candidates: tuple[str, ...] = ()
    for backend in backends:
        if not backend.understands(hint):
            continue
        try:
            target = backend.locate(hint, scene)
        except AffordanceError as error:
            errors.append(f"{backend.name}: {error}")
            candidates = candidates or error.candidates
            continue
        return _with_notes(target, tuple(errors))
    if not errors:
        raise AffordanceError(
            f"is a {type(hint).__name__}, which none of {len(backends)} backends understands.", field="target"
        )
    raise AffordanceError(" | ".join(errors), field="target", candidates=candidates)


def _with_notes(target: Target, more: tuple[str, ...]) -> Target:
    return Target(
        target.rows, target.point, target.label, target.backend, target.score, (*more, *target.notes), target.number
    )
