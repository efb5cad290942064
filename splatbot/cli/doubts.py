"""Questions about results that are plausible to a program and not to a person."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from splatbot.camera import Camera


@dataclass(frozen=True)
class DoubtConstants:
    """Constants of the questions.

    Args:
        field_of_view: [deg] range of the horizontal field of view of an RGB-D camera.
        principal_point: range of its coordinates relative to the size of the image.
        scale: range of the size of the reference path relative to the estimated one.
        max_degraded: largest share of degraded or lost frames without a question.
    """

    field_of_view: tuple[float, float] = (25.0, 130.0)
    principal_point: tuple[float, float] = (0.2, 0.8)
    scale: tuple[float, float] = (0.8, 1.25)
    max_degraded: float = 0.5


CONSTANTS = DoubtConstants()


def camera_doubts(camera: Camera) -> list[str]:
    """Return questions about intrinsics that no RGB-D camera has."""
    doubts = []
    view = math.degrees(2 * math.atan(camera.width / (2 * camera.fx)))
    low, high = CONSTANTS.field_of_view
    if not low <= view <= high:
        doubts.append(f"the camera sees {view:.0f}° horizontally: are fx and width of the same image size?")
    low, high = CONSTANTS.principal_point
    if not (low < camera.cx / camera.width < high and low < camera.cy / camera.height < high):
        doubts.append("the principal point is far from the middle of the image: are cx, cy of the same image size?")
    return doubts


def run_doubts(metrics: Mapping[str, Any]) -> list[str]:
    """Return questions about a finished run from its ``metrics.json``."""
    doubts = []
    reference_scale = metrics.get("reference_scale")
    frames, low, high = max(int(metrics["frames"]), 1), *CONSTANTS.scale
    if reference_scale is not None and not low <= reference_scale <= high:
        doubts.append(
            f"the reference path is {reference_scale:.2f} times as large as the estimated one: is depth_scale right, "
            "and is it the path of the camera?"
        )
    bad = int(metrics["degraded"]) + int(metrics["lost"])
    if bad / frames > CONSTANTS.max_degraded:
        doubts.append(f"{bad} of {frames} frames are degraded or lost: do the intrinsics belong to these images?")
    return doubts
