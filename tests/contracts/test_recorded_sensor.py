"""The service maps a recording with the calibrated sensor of its camera file, as `splatbot map` does."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from splatbot.cli.serve import _follow_camera
from splatbot.config import Config, SensorConfig
from splatbot.logs import open_log
from splatbot.logs.record import record
from splatbot.services.mapping import config_of
from splatbot.services.runtime import Runtime
from splatbot.services.settings import ServiceSettings
from tests.contracts.conftest import running


def log_with_sensor(folder: Path, sensor: dict[str, Any]) -> Path:
    record(open_log("synthetic:tabletop?frames=2&width=64&height=48"), folder)
    file = folder / "intrinsics.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"sensor": sensor}))
    return folder


def test_the_camera_file_of_a_log_sets_the_sensor_unless_the_configuration_does(tmp_path: Path) -> None:
    log = open_log(str(log_with_sensor(tmp_path / "desk", {"readout": 0.03, "min_depth": 0.1})))
    sensor = config_of(log, Config(sensor=SensorConfig(min_depth=0.3))).tracking.sensor
    assert (sensor.readout, sensor.min_depth) == (0.03, 0.3)


def test_a_replayed_log_is_mapped_with_the_sensor_of_its_camera_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = log_with_sensor(tmp_path / "desk", {"readout": 0.03})
    runtime, sensors = Runtime(ServiceSettings(port=0)), []
    monkeypatch.setattr(runtime, "follow", lambda served, source, mapper: sensors.append(mapper.config.tracking.sensor))
    try:
        _follow_camera(runtime, f"replay:{log}?speed=2")
    finally:
        runtime.close()
    assert [sensor.readout for sensor in sensors] == [0.03]


def test_a_camera_file_with_a_wrong_setting_makes_no_map(tmp_path: Path) -> None:
    log_with_sensor(tmp_path / "desk", {"readout": 3.0})
    with running(ServiceSettings(port=0, log_roots=(str(tmp_path),))) as service:
        answer = service.client.post("/v1/maps", json={"id": "desk", "log": "desk"})
        assert answer.status_code == 422
        assert "readout" in answer.text
        assert service.client.get("/v1/maps").json()["maps"] == []


def test_a_recording_is_mapped_with_the_range_that_its_camera_file_states(tmp_path: Path) -> None:
    """No pixel of the table is nearer than 0.3 m, so that no frame is tracked."""
    log_with_sensor(tmp_path / "near", {"max_depth": 0.3})
    log_with_sensor(tmp_path / "far", {})
    with running(ServiceSettings(port=0, log_roots=(str(tmp_path),))) as service:
        tracked = {}
        for name in ("near", "far"):
            job = service.client.post("/v1/maps", json={"id": name, "log": name}).json()["id"]
            with service.client.stream("GET", f"/v1/jobs/{job}/events") as events:
                events.read()  # they end with the job
            tracked[name] = service.client.get(f"/v1/jobs/{job}").json()["result"]["tracked"]
    assert tracked == {"near": 0, "far": 2}
