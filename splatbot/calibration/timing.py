"""Times of a sensor that no file states, from the first frames of a recording: rolling shutter and late depth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot.calibration.estimate import Estimate
from splatbot.calibration.registration import image_velocity
from splatbot.calibration.sensor import CONSTANTS as SENSOR
from splatbot.calibration.sensor import calibrate_frames, view_of
from splatbot.config import Config, with_sensor
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.geometry import se3_log
from splatbot.logs import Log
from splatbot.logs.synthetic import PREFIX
from splatbot.spacing import evenly_spaced
from splatbot.tracking.features import match_pose

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SensorTimingConstants:
    """Constants of the estimate."""

    bytes: int = 300_000_000
    """Memory of the decoded frames [bytes], which bounds their number."""
    probes: int = 10
    """Neighbouring frames [1] whose motion decides whether the log is fast enough."""
    min_speed: float = 100.0
    """Motion of the image [px/s] which a third of the probes exceed: 3 px during the readout of a usual sensor."""
    significance: float = 3.0
    """Standard deviations [1] from zero of an estimate that is used."""


CONSTANTS = SensorTimingConstants()


@dataclass(frozen=True)
class SensorTiming:
    """Estimated times of a sensor.

    Args:
        readout: time from the first row of an image to the last [s].
        readout_sigma: its standard deviation [s].
        depth_delay: time by which depth is later than its stamp says [s]; 0 if the log does not determine it.
        depth_delay_sigma: its standard deviation [s].
        frames: number of frames that the estimate uses.
    """

    readout: float
    readout_sigma: float
    depth_delay: float
    depth_delay_sigma: float
    frames: int

    def metrics(self) -> dict[str, Any]:
        """Return the values by name, with their units."""
        return {name if name == "frames" else f"{name}_s": value for name, value in asdict(self).items()}


def with_estimated_timing(
    config: Config, log: Log, total: int, *, report_progress: Callable[[str], None] = lambda _: None
) -> tuple[Config, SensorTiming | None]:
    """Return the configuration with the times of the sensor, and the times, if the log reveals them.

    Nothing is estimated if the configuration or the log states one of the times. Simulated logs, logs of several
    cameras, and a camera that turns slowly keep the configuration, too.

    Args:
        config: configuration, with the sensor of the log's camera file.
        log: recording.
        total: number of its frames that are mapped.
        report_progress: receives the current step.
    """
    simulated = bool(log.effects) or log.uri.startswith(PREFIX)
    if {"readout", "depth_delay"} & config.sensor.model_fields_set or simulated or log.cameras:
        return config, None
    timing = estimate_timing(log, total, report_progress)
    if timing is None:
        return config, None
    values = {"readout": timing.readout, "depth_delay": timing.depth_delay}
    return with_sensor(config, values), timing


def estimate_timing(log: Log, total: int, report_progress: Callable[[str], None]) -> SensorTiming | None:
    """Estimate readout time and delay of depth from the first frames, or return None if they do not determine them.

    A readout time longer than the time between frames is impossible: such stamps are not those of the images, and
    nothing is estimated.
    """
    _p, count = CONSTANTS, min(total, SENSOR.max_frames)
    if count < SENSOR.min_frames or not _turns(log, count):
        return None
    frames = _read(log, range(count), report_progress)
    if len(frames) < SENSOR.min_frames:
        return None
    found = calibrate_frames(frames, report_progress=report_progress)
    readout, delay = found.readout, found.depth_delay
    interval = float(np.median(np.diff([frame.stamp for frame in frames])))
    if not _is_significant(readout) or not 0 < readout.value <= interval + 2 * readout.sigma:
        return None
    late = delay if _is_significant(delay) and abs(delay.value) <= interval else Estimate(0.0, delay.sigma, "s")
    return SensorTiming(min(readout.value, interval), readout.sigma, late.value, late.sigma, len(frames))


def _is_significant(estimate: Estimate) -> bool:
    return not estimate.refusal and abs(estimate.value) > CONSTANTS.significance * estimate.sigma


def _turns(log: Log, count: int) -> bool:
    """Return whether the image moves fast enough for the times to matter, by pairs of neighbouring frames."""
    speeds = []
    for first in evenly_spaced(range(count - 1), CONSTANTS.probes):
        frames = _read(log, range(first, first + 2), lambda _: None)
        if len(frames) == 2:
            speeds.append(_speed(*frames))
    return bool(speeds) and float(np.percentile(speeds, 67)) >= CONSTANTS.min_speed


def _speed(first: Frame, second: Frame) -> float:
    """Return the mean speed of the image between two frames [px/s]; 0 if it is not known."""
    a, b = view_of(first), view_of(second)
    pose, seconds = match_pose(b.features, [(a.features, np.eye(4))], first.camera), b.stamp - a.stamp
    if pose is None or seconds <= 0:
        return 0.0
    return float(np.linalg.norm(image_velocity(first, se3_log(pose.T_world_camera) / seconds)))


def _read(log: Log, indices: Sequence[int], report_progress: Callable[[str], None]) -> list[Frame]:
    """Return the readable frames at consecutive indices, as many as the memory bound permits."""
    frames: list[Frame] = []
    for index in indices:
        try:
            frame = log[index]
        except InputError:
            continue  # the mapping names it
        frames.append(frame)
        report_progress(f"frame {len(frames)}")
        if (len(frames) + 1) * (frame.rgb.nbytes + frame.depth.nbytes) > CONSTANTS.bytes:
            break
    return frames
