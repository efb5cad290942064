"""`splatbot calibrate sensor`: a camera file that maps a log, and the refusal of a log at rest."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from splatbot.errors import CameraError
from splatbot.logs import open_log, record
from splatbot.logs.calibration import read_calibration
from tests.unit.cli.conftest import RunCommand

MOVING = "synthetic:room?trajectory=turns&frames=45&width=320&height=240"


def test_a_moving_log_gives_a_camera_file_that_later_commands_take(run: RunCommand, tmp_path: Path) -> None:
    record(open_log(f"{MOVING}&effects=rolling_shutter:readout=0.04"), tmp_path / "log")
    answer = run("calibrate", "sensor", tmp_path / "log", "--out", tmp_path / "camera.json")
    assert answer.code == 0
    assert "readout" in answer.out
    assert "±" in answer.out
    values = json.loads((tmp_path / "camera.json").read_text())
    assert values["fx"] == pytest.approx(262.5)
    assert values["sensor"]["readout"] == pytest.approx(0.04, abs=0.006)
    assert open_log(tmp_path / "log", camera=tmp_path / "camera.json").calibration.sensor == values["sensor"]


def test_a_log_at_rest_is_refused_and_no_file_is_written(run: RunCommand, tmp_path: Path) -> None:
    log = open_log("synthetic:room?frames=1&width=160&height=120")
    frames = [log[0]] * 24
    moments = [f.__class__(k / 30, f.rgb, f.depth, f.camera, k) for k, f in enumerate(frames)]
    record(moments, tmp_path / "log")
    answer = run("calibrate", "sensor", tmp_path / "log", "--out", tmp_path / "camera.json")
    assert answer.code == 2
    assert "tells nothing about the sensor" in answer.err
    assert not (tmp_path / "camera.json").exists()


def test_a_wrong_value_of_a_sensor_is_named(tmp_path: Path) -> None:
    values = {"fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0, "width": 2, "height": 2, "depth_scale": 1000}
    (tmp_path / "c.json").write_text(json.dumps({**values, "sensor": {"readout": -1}}))
    with pytest.raises(CameraError) as caught:
        read_calibration(tmp_path / "c.json")
    assert caught.value.field == "sensor.readout"
