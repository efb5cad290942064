"""Calibration of a log: camera intrinsics and the unit of depth."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from splatbot.atomic import atomic_write
from splatbot.camera import Camera
from splatbot.errors import CameraError


@dataclass(frozen=True)
class Calibration:
    """A camera and the unit of its integer depth images.

    Args:
        camera: recorded camera, possibly with distortion.
        depth_scale: units per metre.
        file: source file, for error messages.
        sensor: values of the section `sensor` of the configuration, such as those that `splatbot calibrate sensor`
            estimates.

    Raises:
        CameraError: the depth scale is not a positive number.
    """

    camera: Camera
    depth_scale: float
    file: str | None = None
    sensor: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.depth_scale) and self.depth_scale > 0):
            raise CameraError(
                f"is {self.depth_scale}, must be positive.",
                file=self.file,
                field="depth_scale",
                hint="units per metre: 1000 for millimetres, 5000 for TUM",
            )


def read_calibration(path: str | Path) -> Calibration:
    """Read `intrinsics.json`: fx, fy, cx, cy [px], width, height [px], depth_scale [units/m], optional distortion.

    With the optional `"fisheye": true`, the distortion is k1 to k4 of the equidistant model. The optional object
    "sensor" holds values of the section `sensor` of the configuration. Other keys are ignored.

    Raises:
        CameraError: the file is missing or not a JSON object, or a value is missing or invalid.
    """
    values = read_object(path)
    distortion = values.get("distortion", [])
    if not isinstance(distortion, list):
        raise CameraError("is no list.", file=path, field="distortion", hint="OpenCV's [k1, k2, p1, p2, k3]")
    fisheye = values.get("fisheye", False)
    if not isinstance(fisheye, bool):
        raise CameraError(f"is {fisheye!r:.40}.", file=path, field="fisheye", hint="write true or false")
    named = {str(i): value for i, value in enumerate(distortion)}
    lens = tuple(number(path, named, key) for key in named)
    calibration = make_calibration(path, values, scale_key="depth_scale", distortion=lens, fisheye=fisheye)
    sensor = values.get("sensor", {})
    if not isinstance(sensor, dict):
        raise CameraError("is no JSON object.", file=path, field="sensor", hint='write {"readout": 0.03, ...}')
    return replace(calibration, sensor=sensor)


def save_calibration(calibration: Calibration, path: str | Path) -> None:
    """Write a calibration that :func:`read_calibration` reads.

    Raises:
        OSError: the file cannot be written.
    """
    c = calibration.camera
    values: dict[str, Any] = {"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "width": c.width, "height": c.height}
    values["depth_scale"] = calibration.depth_scale
    if c.distortion:
        values["distortion"] = list(c.distortion)
    if c.fisheye:
        values["fisheye"] = True
    values["sensor"] = dict(calibration.sensor)
    with atomic_write(Path(path)) as file:
        file.write(json.dumps(values, indent=1, allow_nan=False).encode() + b"\n")


def make_calibration(
    path: str | Path,
    values: dict[str, Any],
    *,
    scale_key: str,
    size_keys: tuple[str, str] = ("width", "height"),
    distortion: tuple[float, ...] = (),
    fisheye: bool = False,
) -> Calibration:
    """Build a calibration from the ``values`` of the file ``path``.

    Raises:
        CameraError: a value is missing or invalid.
    """
    fx, fy, cx, cy, scale = (number(path, values, key) for key in ("fx", "fy", "cx", "cy", scale_key))
    width, height = (round(number(path, values, key)) for key in size_keys)
    try:
        camera = Camera(fx, fy, cx, cy, width, height, distortion, fisheye)
    except CameraError as error:
        raise CameraError(error.message, file=path, field=error.field, hint=error.hint) from error
    return Calibration(camera, scale, str(path))


def read_object(path: str | Path) -> dict[str, Any]:
    """Read the JSON object of a file.

    Raises:
        CameraError: the file is missing or does not contain a JSON object.
    """
    try:
        values = json.loads(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise CameraError(f"cannot be read ({error.strerror}).", file=path, hint="check the path") from error
    except (ValueError, RecursionError) as error:
        raise CameraError(f"is not JSON ({error}).", file=path, hint="fix the JSON at the given position") from error
    if not isinstance(values, dict):
        raise CameraError("is no JSON object.", file=path, hint='write {"fx": ..., "fy": ..., ...}')
    return values


def number(path: str | Path, values: dict[str, Any], key: str) -> float:
    """Return ``values[key]`` as a float.

    Raises:
        CameraError: the value is missing or not a number.
    """
    value = values.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        problem = "is missing" if key not in values else f"is {value!r}, no number"
        raise CameraError(f"{problem}.", file=path, field=key, hint=f'add "{key}": a number')
    try:
        found = float(value)
    except OverflowError:
        found = math.inf
    if not math.isfinite(found):
        raise CameraError("is not finite.", file=path, field=key, hint=f'write "{key}": a number')
    return found
