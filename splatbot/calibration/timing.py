"""Times of a sensor that no file states, from the first frames of a recording: rolling shutter and late depth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot.calibration.estimate import Estimate
from splatbot.calibration.registration import image_velocity
from splatbot.calibration.sensor import CONSTANTS as SENSOR
from splatbot.calibration.sensor import calibrate_frames, view_of
from splatbot.config import Config, SensorConfig, with_sensor
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

    bytes: int = 520_000_000
    """Memory of the decoded frames and of a copy of their depth [bytes], which bounds their number."""
    probes: int = 10
    """Neighbouring frames [1] whose motion decides whether the log is fast enough."""
    min_speed: float = 100.0
    """Motion of the image [px/s] which a third of the probes exceed: 3 px during the readout of a usual sensor."""
    significance: float = 3.0
    """Standard deviations [1] from zero of an estimate that is used."""


CONSTANTS = SensorTimingConstants()

_TIMES = {"readout", "depth_delay"}


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

    @classmethod
    def of_metrics(cls, values: Mapping[str, Any] | None) -> SensorTiming | None:
        """Return the times in ``metrics.json``; None without them."""
        if values is None:
            return None
        numbers: dict[str, Any] = {
            name.removesuffix("_s"): np.inf if value is None else value for name, value in values.items()
        }
        return cls(**numbers)


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
    if _TIMES & config.sensor.model_fields_set or simulated or log.cameras:
        return config, None
    timing = estimate_timing(log, total, report_progress)
    if timing is None:
        return config, None
    values = {"readout": timing.readout, "depth_delay": timing.depth_delay}
    return with_sensor(config, values), timing


def without_timing(config: Config) -> Config:
    """Return the configuration as if it stated no time of the sensor."""
    stated = config.sensor.model_dump(include=config.sensor.model_fields_set - _TIMES)
    return with_sensor(config.model_copy(update={"sensor": SensorConfig(**stated)}), {})


def estimate_timing(log: Log, total: int, report_progress: Callable[[str], None]) -> SensorTiming | None:
    """Estimate readout time and delay of depth from the first frames, or return None if they determine neither.

    A readout time longer than the time between frames is impossible: such stamps are not those of the images, and
    nothing is estimated. The same holds for a negative one.
    """
    count = min(total, len(log), SENSOR.max_frames)
    if count < SENSOR.min_frames or not _turns(log, count):
        return None
    frames = _read(log, range(count), report_progress)
    if len(frames) < SENSOR.min_frames:
        return None
    found = calibrate_frames(frames, report_progress=report_progress)
    interval = float(np.median(np.diff([frame.stamp for frame in frames])))
    readout, delay = _significant(found.readout), _significant(found.depth_delay)
    if not 0 <= readout <= interval + 2 * found.readout.sigma:
        return None
    if abs(delay) > interval:
        delay = 0.0
    if readout == delay == 0:
        return None
    return SensorTiming(min(readout, interval), found.readout.sigma, delay, found.depth_delay.sigma, len(frames))


def _significant(estimate: Estimate) -> float:
    """Return the value, or 0 if it is refused or within the error of 0."""
    certain = not estimate.refusal and abs(estimate.value) > CONSTANTS.significance * estimate.sigma
    return estimate.value if certain else 0.0


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
    if first.camera != second.camera:
        return 0.0
    a, b = view_of(first), view_of(second)
    pose, seconds = match_pose(b.features, [(a.features, np.eye(4))], first.camera), b.stamp - a.stamp
    if pose is None or seconds <= 0:
        return 0.0
    return float(np.linalg.norm(image_velocity(first, se3_log(pose.T_world_camera) / seconds)))


def _read(log: Log, indices: Sequence[int], report_progress: Callable[[str], None]) -> list[Frame]:
    """Return the readable frames of one camera at consecutive indices, as many as the memory bound permits."""
    frames: list[Frame] = []
    for index in indices:
        try:
            frame = log[index]
        except InputError:
            continue  # the mapping names it
        if frames and frame.camera != frames[0].camera:
            break
        frames.append(frame)
        report_progress(f"frame {len(frames)}")
        most = CONSTANTS.bytes // (frame.rgb.nbytes + 2 * frame.depth.nbytes)
        if len(frames) >= most or most < SENSOR.min_frames:
            break
    return frames
