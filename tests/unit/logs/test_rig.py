"""A rig file gives the frames of several cameras in the order of their stamps, and names each mistake in it."""

from __future__ import annotations

from pathlib import Path

import pytest

from splatbot.config import Config, with_cameras
from splatbot.errors import ConfigError, InputError, LogError
from splatbot.logs import open_log
from splatbot.logs.base import LogPart
from splatbot.logs.rig import MAX_CAMERAS
from splatbot.run import map_log
from tests.conftest import MakeLog

WRIST = "synthetic:tabletop?frames=4&width=160&height=120"
TABLE = "synthetic:tabletop?frames=3&width=64&height=48"


def write(folder: Path, text: str) -> str:
    (folder / "rig.yaml").write_text(text)
    return str(folder / "rig.yaml")


def test_frames_come_in_the_order_of_their_stamps_with_the_name_and_the_size_of_their_camera(tmp_path: Path) -> None:
    rig = f'cameras: {{wrist: {{log: "{WRIST}"}}, table: {{log: "{TABLE}", time_offset: 0.01}}}}'
    log = open_log(write(tmp_path, rig))
    frames = list(log)
    assert [frame.camera_name for frame in frames] == ["", "table", "", "table", "", "table", ""]
    assert [frame.index for frame in frames] == list(range(7))
    assert [frame.camera.width for frame in frames] == [160, 64, 160, 64, 160, 64, 160]
    stamps = [frame.stamp for frame in frames]
    assert stamps == sorted(stamps)
    assert stamps[1] == pytest.approx(0.01)
    assert log.camera == frames[0].camera
    assert log.ground_truth is not None
    assert len(log.ground_truth) == 4
    assert [*log.cameras] == ["table"]
    assert [*LogPart(log, 0, 2).cameras] == ["table"]


def test_paths_are_relative_to_the_file_and_each_camera_has_its_own_intrinsics(make_log: MakeLog) -> None:
    wrist, table = make_log(name="wrist"), make_log(name="table")
    (wrist.parent / "table.json").write_text((table / "intrinsics.json").read_text().replace("60.0", "70.0"))
    log = open_log(write(wrist.parent, "cameras: {wrist: {log: wrist}, table: {log: table, camera: table.json}}"))
    assert [log[0].camera.fx, log[1].camera.fx] == [60.0, 70.0]


def test_a_further_camera_has_its_own_sensor_with_the_calibrated_values_of_its_recording(make_log: MakeLog) -> None:
    wrist, table = make_log(name="wrist"), make_log(name="table")
    text = (table / "intrinsics.json").read_text().replace("{", '{"sensor": {"max_depth": 3.5, "readout": 0.02}, ', 1)
    (table / "intrinsics.json").write_text(text)
    log = open_log(write(wrist.parent, "cameras: {w: {log: wrist}, t: {log: table, sensor: {readout: 0.03}}}"))
    config = with_cameras(Config(), log.cameras)
    assert (config.cameras["t"].sensor.max_depth, config.cameras["t"].sensor.readout) == (3.5, 0.03)
    own = config.of_camera("t")
    assert own.sensor is own.tracking.sensor is config.cameras["t"].sensor
    assert config.of_camera("") is config
    assert config.sensor.max_depth == Config().sensor.max_depth


def test_cameras_are_described_in_one_place(tmp_path: Path) -> None:
    log = open_log(write(tmp_path, f'cameras: {{a: {{log: "{WRIST}"}}, b: {{log: "{TABLE}"}}}}'))
    config = Config.model_validate({"cameras": {"b": {}}})
    with pytest.raises(InputError, match="describes its cameras itself"):
        map_log(log, out=tmp_path / "run", config=config)
    assert not (tmp_path / "run").exists()


def test_a_camera_without_a_frame_during_the_recording_of_the_first_one_is_refused(tmp_path: Path) -> None:
    rig = f'cameras: {{a: {{log: "{WRIST}"}}, b: {{log: "{TABLE}", time_offset: 5}}}}'
    with pytest.raises(LogError, match=r"from 5\.000 to 5\.067 s") as caught:
        open_log(write(tmp_path, rig))
    assert caught.value.field == "cameras.b"


POSE = "{translation: [0, 0, 0], quaternion_wxyz: [1, 0, 0, 0]}"


@pytest.mark.parametrize(
    ("table", "field"),
    [
        (f"T_world_camera: {POSE}, T_first_camera: {POSE}", "cameras.table"),
        ("T_world_camera: {translation: [0, 0, 0], quaternion_wxyz: [0, 0, 0, 0]}", "T_world_camera"),
        ("T_world_camera: {translation: [0, 0, .nan], quaternion_wxyz: [1, 0, 0, 0]}", "T_world_camera"),
        ("translation_sigma: 0.02, rotation_sigma: 0.03", "cameras.table"),
        (f"T_world_camera: {POSE}, translation_sigma: 0.02", "cameras.table"),
        (f"T_world_camera: {POSE}, translation_sigma: -1, rotation_sigma: 0.1", "translation_sigma"),
        ("mount: fixed", "mount"),
        ("sensor: {max_depht: 2}", "max_depht"),
        ("sensor: 3", "sensor"),
    ],
)
def test_wrong_settings_of_a_camera_name_the_key(tmp_path: Path, table: str, field: str) -> None:
    log = open_log(write(tmp_path, f'cameras: {{wrist: {{log: "{WRIST}"}}, table: {{log: "{TABLE}", {table}}}}}'))
    with pytest.raises(ConfigError) as caught:
        with_cameras(Config(), log.cameras, file=log.uri)
    assert field in str(caught.value.field)
    assert caught.value.file == log.uri


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("cameras: [wrist]", "cameras"),
        ("cameras: {}", "cameras"),
        ("cameras: {wrist: folder}", "cameras.wrist"),
        ("cameras: {wrist: {}}", "cameras.wrist.log"),
        ("cameras: {wrist: {log: 3}}", "cameras.wrist.log"),
        ("cameras: {../wrist: {log: here}}", "cameras"),
        ("cameras: {1: {log: here}}", "cameras"),
        (f'cameras: {{wrist: {{log: "{WRIST}", T_world_camera: {POSE}}}}}', "cameras.wrist.T_world_camera"),
        (f'cameras: {{wrist: {{log: "{WRIST}", time_offset: soon}}}}', "cameras.wrist.time_offset"),
        (f'cameras: {{wrist: {{log: "{WRIST}", time_offset: .nan}}}}', "cameras.wrist.time_offset"),
        ("cameras: {wrist: {log: rig.yaml}}", "cameras.wrist.log"),
        (f'cameras: {{a: {{log: "{WRIST}"}}, b: {{log: "{TABLE}"}}, b: {{log: "{TABLE}"}}}}', None),
        ("cameras: {wrist: {log: nowhere}}", "log"),
        ("cameras: " + "{" + ", ".join(f'c{k}: {{log: "{TABLE}"}}' for k in range(MAX_CAMERAS + 1)) + "}", "cameras"),
    ],
)
def test_a_wrong_file_names_the_key(tmp_path: Path, text: str, field: str | None) -> None:
    with pytest.raises(LogError) as caught:
        open_log(write(tmp_path, text))
    assert caught.value.field == field


def test_a_file_that_is_no_yaml_is_named(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="is no YAML file"):
        open_log(write(tmp_path, "cameras: {wrist: ["))


def test_intrinsics_for_all_cameras_at_once_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path, f'cameras: {{wrist: {{log: "{WRIST}"}}}}')
    with pytest.raises(LogError, match="each recording has its own"):
        open_log(path, camera="tum_fr1")
