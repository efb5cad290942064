"""Posed images for training, and their split into training views and held-out views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import FormatError, InputError
from splatbot.layouts import DatasetKind

_EXTENT_FACTOR = 1.1  # of Kerbl et al. 2023
_LEAST_EXTENT = 1e-3  # of a single camera


@dataclass(frozen=True, eq=False)
class TrainingView:
    """A posed image that is decoded when it is read; nothing is cached.

    Args:
        name: relative name of the image, unique in the dataset.
        camera: pinhole camera without distortion, of the size of the image.
        T_world_camera: (4, 4) pose, axes as OpenCV.
        read: returns the image (H, W, 3) RGB or (H, W, 4) RGBA with straight alpha, undistorted and scaled.
        read_depth: returns depth (H, W) [m], 0 without measurement; None if the dataset has no depth.
        read_mask: returns a mask (H, W), True where a pixel must not be trained on; None if all may be.
        camera_name: of the camera in the dataset; empty if cameras have no names there.
    """

    name: str
    camera: Camera
    T_world_camera: NDArray[np.float64]
    read: Callable[[], NDArray[np.uint8]]
    read_depth: Callable[[], NDArray[np.float32]] | None = None
    read_mask: Callable[[], NDArray[np.bool_]] | None = None
    camera_name: str = ""


@dataclass(frozen=True, eq=False)
class TrainingData:
    """The views of a dataset, and its points.

    Args:
        kind: layout of the dataset.
        folder: its folder.
        views: sorted by name; those of a run are sorted by their index in the log.
        points: (M, 3) in the world frame; M is 0 if the dataset has none.
        point_colors: (M, 3) RGB.
        held_out_names: names of the views that the dataset itself marks as test views.
    """

    kind: DatasetKind
    folder: Path
    views: tuple[TrainingView, ...]
    points: NDArray[np.float64]
    point_colors: NDArray[np.uint8]
    held_out_names: tuple[str, ...] = ()

    def split(self, every: int = 8) -> tuple[tuple[TrainingView, ...], tuple[TrainingView, ...]]:
        """Split the views into training views and held-out views.

        Args:
            every: distance of the held-out views, the first of which is view 0. It is used if the dataset marks
                none itself. With 0 all views are training views.

        Raises:
            InputError: the distance is negative, or no training view is left.
        """
        if every < 0:
            raise InputError(f"is {every}.", field="every", hint="give 8 to hold out each eighth view, 0 for none")
        marked = set(self.held_out_names)
        if every == 0:
            held = [False] * len(self.views)
        elif marked:
            held = [view.name in marked for view in self.views]
        else:
            held = [index % every == 0 for index in range(len(self.views))]
        if all(held):
            raise InputError(
                f"holds out all of {len(self.views)} views.",
                file=self.folder,
                field="every",
                hint="give 0 to train on all views, or add views",
            )
        pairs = list(zip(self.views, held, strict=True))
        return tuple(view for view, out in pairs if not out), tuple(view for view, out in pairs if out)

    @property
    def scene_extent(self) -> float:
        """1.1 times the largest distance of a camera from the mean of all cameras, at least 0.001."""
        centers = np.array([view.T_world_camera[:3, 3] for view in self.views]).reshape(-1, 3)
        distances = np.linalg.norm(centers - centers.mean(axis=0), axis=1) if len(centers) else np.zeros(1)
        return max(_EXTENT_FACTOR * float(distances.max()), _LEAST_EXTENT)


def sorted_views(file: Path, views: list[TrainingView]) -> tuple[TrainingView, ...]:
    """Sort views by name.

    Raises:
        FormatError: the dataset has no image, or two have the same name.
    """
    if not views:
        raise FormatError(
            "has no images.", file=file, field="images", hint="restore the file, or pose the images again"
        )
    ordered = sorted(views, key=lambda view: view.name)
    for before, view in pairwise(ordered):
        if before.name == view.name:
            raise FormatError(
                f"has the image {view.name!r} twice.", file=file, field="name", hint="remove one of the two entries"
            )
    return tuple(ordered)
