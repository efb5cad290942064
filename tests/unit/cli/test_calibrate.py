"""`splatbot calibrate sensor`: a camera file that maps a log, and the refusal of a log at rest."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from splatbot.config import Config, load_config, with_sensor
from splatbot.errors import ConfigError
from splatbot.logs import open_log, record
from splatbot.logs.calibration import read_calibration
from tests.unit.cli.conftest import RunCommand

MOVING = "synthetic:room?trajectory=turns&frames=45&width=320&height=240"


@pytest.mark.long
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
    assert "does not determine any quantity" in answer.err
    assert not (tmp_path / "camera.json").exists()


def test_a_camera_file_gives_the_values_that_the_configuration_leaves_open(tmp_path: Path) -> None:
    values = {"fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0, "width": 2, "height": 2, "depth_scale": 1000}
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({**values, "sensor": {"readout": 0.03, "exposure": 0.01}}))
    found, given = read_calibration(path), load_config(overrides={"sensor.readout": 0.02})
    config = with_sensor(given, found.sensor, file=found.file)
    assert (config.sensor.readout, config.sensor.exposure) == (0.02, 0.01)
    assert config.tracking.sensor is config.sensor
    assert given.sensor.exposure == 0
    assert with_sensor(given, {}).sensor == given.sensor


def test_a_wrong_value_of_a_sensor_is_named() -> None:
    for values in ({"readout": -1}, {"readouts": 0.03}):
        with pytest.raises(ConfigError) as caught:
            with_sensor(Config(), values, file="camera.json")
        assert caught.value.field == f"sensor.{next(iter(values))}"
        assert "camera.json" in str(caught.value)
