"""Requests of the page: the view that a browser wants to see."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.geometry import nearest_rotation

MAX_BYTES = 4096  # of a request
MAX_WIDTH = 1024  # [px] of an image

_FARTHEST = 1e6  # [m] from the origin
_ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class LiveRequest:
    """A view of the map.

    Args:
        view: number of a photograph, training views first; its camera and its size count.
        width: largest width of the images [px].
        pose: (4, 4) T_world_camera; None for the pose of the photograph.
    """

    view: int
    width: int
    pose: NDArray[np.float64] | None


def parse_request(text: str | bytes, views: int) -> LiveRequest:
    """Parse ``{"view": 0, "width": 640, "pose": null}``; a pose is 16 numbers, row by row.

    Args:
        text: of the request.
        views: number of photographs.

    Raises:
        InputError: a value is missing, of another type, or out of range.
    """
    hint = 'send {"view": number, "width": pixels, "pose": null or 16 numbers}'
    try:
        values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError("is no JSON.", field="request", hint=hint) from error
    if not isinstance(values, dict) or set(values) != {"view", "width", "pose"}:
        raise InputError("has other fields.", field="request", hint=hint)
    for name, least, most in (("view", 0, views - 1), ("width", 1, MAX_WIDTH)):
        if type(values[name]) is not int or not least <= values[name] <= most:
            raise InputError(f"is no integer from {least} to {most}.", field=name, hint=hint)
    return LiveRequest(values["view"], values["width"], None if values["pose"] is None else _pose(values["pose"]))


def _pose(values: object) -> NDArray[np.float64]:
    hint = "give T_world_camera row by row: a rotation, a position within 1,000 km, and 0, 0, 0, 1"
    if not isinstance(values, list) or len(values) != 16 or not all(map(_is_near, values)):
        raise InputError("is no list of 16 numbers within bounds.", field="pose", hint=hint)
    pose = np.array(values, dtype=np.float64).reshape(4, 4)
    rotation = nearest_rotation(pose[:3, :3])
    off = max(np.abs(rotation - pose[:3, :3]).max(), np.abs(pose[3] - (0, 0, 0, 1)).max())
    if off > _ROTATION_TOLERANCE:
        raise InputError("is no rigid transform.", field="pose", hint=hint)
    pose[:3, :3], pose[3] = rotation, (0, 0, 0, 1)
    return pose


def _is_near(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _FARTHEST
