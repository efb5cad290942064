"""Refinement of the intrinsics of the cameras that took the training views."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from splatbot.camera import Camera
from splatbot.optimize.adam import adam_step
from splatbot.training.datasets import TrainingView

SIGMA = 0.05
"""Standard deviation of the prior of each relative change."""

_PRIOR_WEIGHT = 1e-3
_VALUES = ("fx", "fy", "cx", "cy", "width", "height")


@dataclass(frozen=True)
class RefinedCamera:
    """A camera of a dataset before and after the training, at the size of the training images.

    Args:
        name: of the camera in the dataset; empty if it has none.
        given: the intrinsics of the dataset.
        refined: the estimated ones.
        views: number of training views.
    """

    name: str
    given: Camera
    refined: Camera
    views: int

    def to_json(self) -> dict[str, Any]:
        """Return the values of the camera by name; principal points count pixel centres at integers."""
        cameras = {"given": self.given, "refined": self.refined}
        values = {key: {name: getattr(camera, name) for name in _VALUES} for key, camera in cameras.items()}
        return {"name": self.name, "views": self.views, **values}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> RefinedCamera:
        """Read the values of :meth:`to_json`.

        Raises:
            KeyError, TypeError, CameraError: a value is missing, or no intrinsic of a camera.
        """
        given, refined = (Camera(**values[key]) for key in ("given", "refined"))
        return cls(str(values["name"]), given, refined, int(values["views"]))


class CameraIntrinsics:
    """Intrinsics of the K cameras of the training views; views of one camera share them.

    Views have one camera if the dataset gives them one name of a camera and the same intrinsics. The changes θ of a
    camera are relative, so that one rate and one prior fit all. With fx₀, fy₀, cx₀, cy₀ as given,
    fx = fx₀ exp θ₁, fy = fy₀ exp θ₂, cx = cx₀ + fx₀ θ₃, cy = cy₀ + fy₀ θ₄.

    Args:
        views: the training views.
    """

    def __init__(self, views: Sequence[TrainingView]) -> None:
        counts = Counter(_key(view) for view in views)
        numbers = {key: number for number, key in enumerate(counts)}
        self._counts = counts
        self._of_view = torch.tensor([numbers[_key(view)] for view in views])
        self.changes = torch.zeros(len(counts), 4, dtype=torch.float64)
        """(K, 4) float64, θ of each camera."""
        self.first = torch.zeros(len(counts), 4)
        self.second = torch.zeros(len(counts), 4)
        self.steps = torch.zeros(len(counts))

    def of_views(self, views: list[int]) -> Tensor:
        """Return a copy (B, 4) of the changes of the cameras of B views."""
        return self.changes[self._of_view[views]]

    def step(self, views: list[int], gradients: Tensor, rate: float) -> None:
        """Perform one step of Adam on the cameras of a step's views; the others stay.

        Args:
            views: indices of the B views of the step.
            gradients: (B, 4) of the loss to the changes of their cameras.
            rate: of the relative changes.
        """
        cameras = self._of_view[views]
        increments = torch.zeros_like(self.first)
        seen = torch.zeros(len(self.steps), dtype=torch.bool)
        seen[cameras] = True
        adam_step(
            {"intrinsics": increments},
            {"intrinsics": torch.zeros_like(self.first).index_add_(0, cameras, gradients.float())},
            {"intrinsics": self.first},
            {"intrinsics": self.second},
            self.steps,
            seen,
            {"intrinsics": rate},
            betas=(0.9, 0.99),
            eps=1e-15,
        )
        self.changes = self.changes + increments.double()

    def cameras(self) -> list[RefinedCamera]:
        """Return the cameras before and after the steps so far."""
        found = []
        for ((name, given), count), change in zip(self._counts.items(), self.changes, strict=True):
            fx, fy, cx, cy = (float(value) for value in _changed(given, change))
            found.append(RefinedCamera(name, given, replace(given, fx=fx, fy=fy, cx=cx - 0.5, cy=cy - 0.5), count))
        return found


def matrix(camera: Camera, change: Tensor, reduced: Camera) -> Tensor:
    """Return the intrinsic matrix (3, 3) of a changed camera, pixel centres at +0.5, differentiable by the change.

    Args:
        camera: as given, at full size.
        change: (4,) float64, θ of :class:`CameraIntrinsics`.
        reduced: the same camera at the size of the image that is rendered.
    """
    scale = change.new_tensor([reduced.width / camera.width, reduced.height / camera.height])
    fx, fy, cx, cy = (_changed(camera, change) * scale.repeat(2)).unbind()
    zero, one = change.new_zeros(()), change.new_ones(())
    return torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, one]).reshape(3, 3)


def prior(change: Tensor) -> Tensor:
    """Return w/2 Σ (θ / σ)² of changes θ with σ = 0.05 and w = 0.001, which the loss of each view contains."""
    return 0.5 * _PRIOR_WEIGHT * (change / SIGMA).square().sum()


def with_refined(views: Sequence[TrainingView], cameras: Sequence[RefinedCamera]) -> tuple[TrainingView, ...]:
    """Return views with the refined intrinsics of their cameras; a view of another camera keeps its own."""
    refined = {(camera.name, camera.given): camera.refined for camera in cameras}
    return tuple(replace(view, camera=refined.get(_key(view), view.camera)) for view in views)


def _key(view: TrainingView) -> tuple[str, Camera]:
    return view.camera_name, view.camera


def _changed(camera: Camera, change: Tensor) -> Tensor:
    """Return fx, fy, cx, cy (4,) of a changed camera at full size, pixel centres at +0.5."""
    focal = change.new_tensor([camera.fx, camera.fy])
    center = change.new_tensor([camera.cx + 0.5, camera.cy + 0.5])
    return torch.cat([focal * change[:2].exp(), center + focal * change[2:]])
