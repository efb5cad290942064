"""Calibration of an RGB-D sensor from one of its logs: times, registration and bias."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot import _native
from splatbot.calibration.estimate import Estimate
from splatbot.calibration.motion import View, match_pairs
from splatbot.calibration.readout import estimate_rows
from splatbot.calibration.registration import DepthTiming, estimate_depth_timing, image_velocity
from splatbot.camera import Camera
from splatbot.config import TrackingConfig
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.logs import Log
from splatbot.tracking.features import Features, detect
from splatbot.tracking.prepare import usable_depth

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SensorConstants:
    """Constants of the calibration of a sensor."""

    max_frames: int = 150
    """Frames of the log that are used [1], the first ones. More reduce the standard deviation and cost 3 MB each."""
    min_frames: int = 20
    """Least number of frames [1]."""
    features: int = 1000
    """Keypoints of a frame [1]."""


CONSTANTS = SensorConstants()


@dataclass(frozen=True)
class SensorCalibration:
    """Estimated quantities of a sensor.

    Args:
        readout: time from the first row of an image to the last.
        depth_delay: time by which depth is later than colour.
        right: shift that moves depth onto its colour, to the right.
        down: the same shift, downwards.
        depth_bias: to be added to the measured depth.
        camera: camera of the frames.
    """

    readout: Estimate
    depth_delay: Estimate
    right: Estimate
    down: Estimate
    depth_bias: Estimate
    camera: Camera

    @property
    def known(self) -> dict[str, Estimate]:
        """Quantities that the log determines."""
        return {name: estimate for name, estimate in self.estimates.items() if not estimate.refusal}

    @property
    def estimates(self) -> dict[str, Estimate]:
        """All quantities by name."""
        names = ("readout", "depth_delay", "right", "down", "depth_bias")
        return {name: getattr(self, name) for name in names}

    def section(self) -> dict[str, Any]:
        """Return the section `sensor` of the configuration with the quantities that the log determines.

        The shift of depth becomes a rotation of the depth camera, which displaces all pixels near the image centre
        alike.
        """
        known, values = self.known, dict[str, Any]()
        for name in ("readout", "depth_delay", "depth_bias"):
            if name in known:
                value = known[name].value
                values[name] = max(value, 0.0) if name == "readout" else value
        if "right" in known and "down" in known:
            down, right = known["down"].value / self.camera.fy, known["right"].value / self.camera.fx
            values["depth_to_color"] = [0.0, 0.0, 0.0, -down, right, 0.0]
        return values


def calibrate_sensor(log: Log, *, report_progress: Callable[[str], None] = lambda _: None) -> SensorCalibration:
    """Estimate the times, the registration and the bias of a sensor from the frames of a log.

    Readout time and bias follow from matched features (:mod:`splatbot.calibration.readout`), delay and shift from
    edges (:mod:`splatbot.calibration.registration`). The features then take their depth from the registered pixels,
    and readout time and bias are estimated again. The scale of depth is not estimated: images and depth of one camera
    agree at any scale.

    Raises:
        InputError: the log has fewer than ``CONSTANTS.min_frames`` frames.
        LogError: a frame is damaged.
    """
    p = CONSTANTS
    if len(log) < p.min_frames:
        raise InputError(
            f"has {len(log)} frames, {p.min_frames} are needed.", file=log.uri, field="log", hint="record a longer log"
        )
    frames = []
    for index in range(min(len(log), p.max_frames)):
        frames.append(log[index])
        report_progress(f"frame {index + 1}")
    return calibrate_frames(frames, report_progress=report_progress)


def calibrate_frames(
    frames: Sequence[Frame], *, report_progress: Callable[[str], None] = lambda _: None
) -> SensorCalibration:
    """Estimate the times, the registration and the bias of a sensor from consecutive frames of one camera."""
    frames = [replace(frame, depth=usable_depth(frame, TrackingConfig())) for frame in frames]
    views = []
    for number, frame in enumerate(frames, 1):
        views.append(view_of(frame))
        report_progress(f"features {number}")
    camera = frames[0].camera
    report_progress("matching")
    rows = estimate_rows(views, match_pairs(views, camera), camera)
    report_progress("aligning edges")
    timing = estimate_depth_timing(frames, rows.twists)
    if not timing.delay.refusal or not timing.right.refusal:
        views = [_registered(view, frames[k], rows.twists.get(k), timing) for k, view in enumerate(views)]
        report_progress("matching again")
        rows = estimate_rows(views, match_pairs(views, camera), camera)
    return SensorCalibration(rows.readout, timing.delay, timing.right, timing.down, rows.bias, camera)


def view_of(frame: Frame) -> View:
    """Return the keypoints of a frame with their depth."""
    return View(frame.stamp, detect(frame.rgb, frame.depth, frame.camera, CONSTANTS.features, frame.mask))


def _registered(view: View, frame: Frame, twist: Array | None, timing: DepthTiming) -> View:
    """Return a view whose features have the depth of the pixels that show the same points."""
    shift = np.zeros(2)
    if not timing.right.refusal and not timing.down.refusal:
        shift += [timing.right.value, timing.down.value]
    if twist is not None:
        delay = frame.depth_delay + (0.0 if timing.delay.refusal else timing.delay.value)
        shift -= delay * image_velocity(frame, twist)
    found, c = view.features, frame.camera
    z = np.asarray(_native.depth_around(frame.depth, (found.pixels - shift).astype(np.float32)))
    x, y = (found.pixels[:, 0] - c.cx) / c.fx, (found.pixels[:, 1] - c.cy) / c.fy
    points = np.stack([x * z, y * z, z], axis=1)
    return replace(view, features=Features(found.pixels, found.descriptors, points, found.scales))
