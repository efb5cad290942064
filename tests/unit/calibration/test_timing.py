"""Times of a sensor that no file states: found where the log reveals them, and never assumed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import pytest

from splatbot.calibration import timing
from splatbot.calibration.estimate import Estimate
from splatbot.calibration.sensor import SensorCalibration
from splatbot.calibration.timing import SensorTiming, estimate_timing, with_estimated_timing, without_timing
from splatbot.config import Config, load_config
from splatbot.errors import LogError
from splatbot.frame import Frame
from splatbot.logs import open_log
from splatbot.logs.base import DerivedLog

TURNING = "synthetic:room?trajectory=turns&frames=45&width=320&height=240"
SLOW = "synthetic:tabletop?trajectory=arm&frames=30&width=160&height=120"


class Recording(DerivedLog):
    """Frames of a simulated camera, as a recording without any value of its sensor; counts the reads."""

    effects: ClassVar[list[dict[str, Any]]] = []

    def __init__(self, address: str, damaged: int | None = None) -> None:
        super().__init__(open_log(address))
        self.name = self.uri = "recording"
        self.damaged, self.reads = damaged, 0

    def _decode(self, index: int) -> Frame:
        self.reads += 1
        if index == self.damaged:
            raise LogError("is damaged.", file="recording")
        return self._log[index]


@pytest.mark.long
def test_the_readout_of_a_turning_camera_is_found_within_three_sigma_though_a_frame_is_damaged() -> None:
    address = TURNING.replace("frames=45", "frames=80")
    log = Recording(f"{address}&effects=rolling_shutter:readout=0.025", damaged=70)
    config, found = with_estimated_timing(Config(), log, len(log))
    assert found is not None
    assert found.frames == 79
    assert abs(found.readout - 0.025) < 3 * found.readout_sigma + 1e-3
    assert (config.sensor.readout, config.tracking.sensor.readout) == (found.readout, found.readout)


def test_a_slow_camera_is_recognized_by_few_frames_and_left_as_it_is() -> None:
    log = Recording(SLOW)
    assert with_estimated_timing(Config(), log, len(log)) == (Config(), None)
    assert log.reads <= 20


@pytest.mark.parametrize(
    "stated", [{"sensor.readout": 0.0}, {"sensor.readout": 0.02}, {"expert.sensor.depth_delay": 0.0}]
)
def test_a_stated_time_is_taken_without_a_look_at_the_frames(stated: dict[str, float]) -> None:
    log, config = Recording(TURNING), load_config(overrides=stated)
    assert with_estimated_timing(config, log, len(log)) == (config, None)
    assert log.reads == 0


def test_a_simulated_camera_is_left_as_it_is() -> None:
    simulated = Recording(f"{TURNING}&effects=rolling_shutter:readout=0.02")
    simulated.effects = [{"name": "rolling_shutter"}]  # type: ignore[misc]
    for log in (simulated, open_log(TURNING)):
        assert with_estimated_timing(Config(), log, len(log)) == (Config(), None)
    assert simulated.reads == 0


def test_frames_of_another_camera_end_the_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    class Mixed(Recording):
        def _decode(self, index: int) -> Frame:
            return super()._decode(index) if index < 25 else open_log(SLOW)[0]

    monkeypatch.setattr(timing, "_turns", lambda *_: True)
    log, numbers = Mixed(TURNING), list[int]()

    def found(frames: list[Frame], **_: object) -> SensorCalibration:
        numbers.append(len(frames))
        none = Estimate(0.0, np.inf, "s", "not known")
        return SensorCalibration(none, none, none, none, none, frames[0].camera)

    monkeypatch.setattr(timing, "calibrate_frames", found)
    assert estimate_timing(log, 1000, lambda _: None) is None  # more frames than the log has
    assert numbers == [25]


def estimated(monkeypatch: pytest.MonkeyPatch, readout: Estimate, delay: Estimate) -> SensorTiming | None:
    """Return the times that follow from estimates of 45 frames with 1/30 s between them."""
    none = Estimate(0.0, np.inf, "px", "not known")

    def found(frames: list[Frame], **_: object) -> SensorCalibration:
        return SensorCalibration(readout, delay, none, none, none, frames[0].camera)

    monkeypatch.setattr(timing, "calibrate_frames", found)
    monkeypatch.setattr(timing, "_turns", lambda *_: True)
    log = Recording("synthetic:wall?frames=45&width=32&height=24&rate=30")
    return estimate_timing(log, len(log), lambda _: None)


def known(value: float, sigma: float = 0.001) -> Estimate:
    return Estimate(value, sigma, "s")


def test_a_readout_longer_than_the_time_between_frames_shows_wrong_stamps(monkeypatch: pytest.MonkeyPatch) -> None:
    assert estimated(monkeypatch, known(0.039), known(-0.01)) is None
    just = estimated(monkeypatch, known(0.0345), known(-0.01))
    assert just is not None
    assert just.readout == pytest.approx(1 / 30)


def test_times_within_their_error_of_zero_or_refused_are_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    refused = replace(known(0.01), refusal="too slow")
    assert estimated(monkeypatch, known(-0.02), known(-0.01)) is None
    for readout in (known(0.002), refused):
        assert estimated(monkeypatch, readout, refused) is None
        found = estimated(monkeypatch, readout, known(-0.01))
        assert found is not None
        assert (found.readout, found.depth_delay) == (0.0, -0.01)
    for delay in (known(0.002), refused, known(0.04)):
        found = estimated(monkeypatch, known(0.02), delay)
        assert found is not None
        assert (found.readout, found.depth_delay) == (0.02, 0.0)
    found = estimated(monkeypatch, known(0.02), known(-0.018))
    assert found is not None
    assert found.depth_delay == -0.018


def test_the_memory_of_the_frames_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timing, "CONSTANTS", replace(timing.CONSTANTS, bytes=30 * 32 * 24 * 11))
    found = estimated(monkeypatch, known(0.02), known(-0.018))
    assert found is not None
    assert found.frames == 30


def test_the_times_in_metrics_are_read_again_and_a_configuration_forgets_them() -> None:
    times = SensorTiming(0.02, 0.001, -0.01, float("inf"), 50)
    assert SensorTiming.of_metrics(times.metrics() | {"depth_delay_sigma_s": None}) == times
    assert SensorTiming.of_metrics(None) is None
    stated = load_config(overrides={"sensor.readout": 0.02, "sensor.max_depth": 3.0})
    forgot = without_timing(stated)
    assert (forgot.sensor.readout, forgot.tracking.sensor.readout, forgot.sensor.max_depth) == (0.0, 0.0, 3.0)
    assert "readout" not in forgot.sensor.model_fields_set
