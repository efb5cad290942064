"""compare_runs: the objects that differ between two runs of one place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from splatbot.collision.changes import ChangedObject, find_changes
from splatbot.collision.visibility import DepthView
from splatbot.mapping.alignment import MapAlignment
from splatbot.protocols import Array
from splatbot.run.merging import load_run, locate_run, pose_of
from splatbot.run.state import SavedRun

_SHARED_WORLD = {
    "translation_m": [0.0, 0.0, 0.0],
    "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0],
    "translation_sigma_m": None,
    "rotation_sigma_rad": None,
}
"""Pose of B in A of runs that share a world; it is given, not estimated."""


@dataclass(frozen=True, eq=False)
class RunComparison:
    """Result of a comparison.

    Args:
        objects: the objects that differ, largest first, in the world of A.
        alignment: pose of B in A; None if the runs share a world.
        views: depth images of the keyframes of A, then of B, in the world of A.
    """

    objects: list[ChangedObject]
    alignment: MapAlignment | None
    views: list[DepthView]

    @property
    def T_a_b(self) -> Array:
        """Pose (4, 4) of the world of B in that of A."""
        return np.eye(4) if self.alignment is None else self.alignment.T_a_b

    def summary(self) -> dict[str, Any]:
        """Return the objects and the pose of B under stable keys, for JSON."""
        kinds = [change.kind for change in self.objects]
        return {
            **{kind: kinds.count(kind) for kind in ("appeared", "removed", "moved")},
            "objects": [_row(number, change) for number, change in enumerate(self.objects, 1)],
            "T_a_b": _SHARED_WORLD if self.alignment is None else pose_of(self.alignment),
            "keyframes_agreeing": None if self.alignment is None else len(self.alignment.located),
        }


def compare_runs(
    run_a: str | Path,
    run_b: str | Path,
    *,
    aligned: bool = False,
    on_share: Callable[[str, float], None] = lambda _what, _share: None,
) -> RunComparison:
    """Find the objects that differ between run A and the later run B, by the measured depth of their keyframes.

    Args:
        run_a, run_b: folders of runs with a saved state.
        aligned: whether both have the same world. If not, B is located in A.
        on_share: called with the current step and its finished share.

    Raises:
        FormatError: the state of a run is missing or damaged.
        InputError: a run has several cameras, or B is not found in A.
    """
    return compare_saved(load_run(run_a), load_run(run_b), aligned=aligned, on_share=on_share)


def compare_saved(a: SavedRun, b: SavedRun, *, aligned: bool, on_share: Callable[[str, float], None]) -> RunComparison:
    """Compare two loaded runs, see :func:`compare_runs`."""
    alignment = None
    if not aligned:
        report, otherwise = partial(on_share, "locating B in A"), "; or give --aligned if both have one world"
        alignment = locate_run(a, b, report, otherwise=otherwise)
    T_a_b = np.eye(4) if alignment is None else alignment.T_a_b
    views_a, views_b = _views(a, np.eye(4)), _views(b, T_a_b)
    sensors = (a.config.sensor, b.config.sensor)
    objects = find_changes(
        views_a,
        [keyframe.rgb.numpy() for keyframe in a.slam.keyframes],
        views_b,
        [keyframe.rgb.numpy() for keyframe in b.slam.keyframes],
        floor=max(sensor.sigma_depth_floor for sensor in sensors),
        quad=max(sensor.sigma_depth_quad for sensor in sensors),
        report=partial(on_share, "comparing depth"),
    )
    return RunComparison(objects, alignment, [*views_a, *views_b])


def _views(saved: SavedRun, T_a_world: Array) -> list[DepthView]:
    return [(k.depth.numpy(), k.camera, T_a_world @ k.T_world_camera) for k in saved.slam.keyframes]


def _row(number: int, change: ChangedObject) -> dict[str, Any]:
    """Return one object for JSON; lengths in metres, in the world of A."""
    return {
        "number": number,
        "kind": change.kind,
        "center_m": change.center.tolist(),
        "previous_center_m": None if change.previous is None else change.previous.center.tolist(),
        "size_m": change.size.tolist(),
        "axes": change.axes.T.tolist(),
        "color": change.shades[len(change.shades) // 2].tolist(),
        "voxels": change.points,
    }
