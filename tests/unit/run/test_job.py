"""Estimated times of the sensor in runs: kept when a run goes on, estimated again for another recording."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from splatbot.calibration.timing import SensorTiming
from splatbot.config import Config, load_config, with_sensor
from splatbot.logs import Log, open_log
from splatbot.run import job
from splatbot.run.job import map_log
from splatbot.run.state import SavedRun

LOG = "synthetic:tabletop?frames=6&width=160&height=120"
QUICK = {"mapping.refine_iterations": 1, "mapping.final_iterations": 1}


@pytest.fixture
def estimate(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], list[str]]:
    """Return a function that sets the readout time which recordings reveal, and returns the list of those read."""

    def of(readout: float) -> list[str]:
        read: list[str] = []

        def found(config: Config, log: Log, total: int, **_: object) -> tuple[Config, SensorTiming]:
            read.append(log.uri)
            return with_sensor(config, {"readout": readout}), SensorTiming(readout, 1e-3, 0.0, float("inf"), total)

        monkeypatch.setattr(job, "with_estimated_timing", found)
        return read

    return of


def readout_of(folder: Path) -> float:
    return load_config(folder / "config.yaml").sensor.readout


def test_a_run_keeps_the_times_that_it_estimated_when_it_goes_on(
    tmp_path: Path, estimate: Callable[[float], list[str]]
) -> None:
    log, read = open_log(LOG), estimate(0.012)
    first = map_log(
        log, out=tmp_path / "run", config=load_config(overrides=QUICK), max_frames=3, save_every=0.0, report=False
    )
    assert first.metrics["sensor_timing"]["readout_s"] == readout_of(tmp_path / "run") == 0.012
    resumed = map_log(log, out=tmp_path / "run", resume=SavedRun.load(tmp_path / "run"), report=False)
    assert resumed.metrics["frames"] == 6
    assert resumed.metrics["sensor_timing"] == first.metrics["sensor_timing"]
    assert readout_of(tmp_path / "run") == 0.012
    assert len(read) == 1


def test_a_recording_localized_in_a_map_has_times_of_its_own(
    tmp_path: Path, estimate: Callable[[float], list[str]]
) -> None:
    estimate(0.012)
    config = load_config(overrides=QUICK)
    map_log(open_log(LOG), out=tmp_path / "run", config=config, max_frames=3, save_every=0.0, report=False)
    read, saved = estimate(0.02), SavedRun.load(tmp_path / "run")
    found = map_log(open_log(LOG), out=tmp_path / "other", localise=saved, max_frames=3, report=False)
    assert len(read) == 1
    assert found.metrics["sensor_timing"]["readout_s"] == readout_of(tmp_path / "other") == 0.02
    assert saved.slam._tracker.config.sensor.readout == 0.02


def test_stated_times_of_a_map_hold_for_recordings_localized_in_it(
    tmp_path: Path, estimate: Callable[[float], list[str]]
) -> None:
    config = load_config(overrides=QUICK | {"sensor.readout": 0.01})
    map_log(open_log(LOG), out=tmp_path / "run", config=config, max_frames=3, save_every=0.0, report=False)
    read = estimate(0.02)
    map_log(open_log(LOG), out=tmp_path / "other", localise=SavedRun.load(tmp_path / "run"), max_frames=3, report=False)
    assert read == []
    assert readout_of(tmp_path / "other") == 0.01
