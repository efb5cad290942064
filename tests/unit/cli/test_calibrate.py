"""`splatbot calibrate`: files that later commands take, and the refusal of values that views do not determine."""

from __future__ import annotations

import json
import re
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatbot.calibration.board import CharucoBoard
from splatbot.calibration.views import ViewSource
from splatbot.config import Config, load_config, with_sensor
from splatbot.errors import ConfigError, FormatError
from splatbot.geometry import se3_exp
from splatbot.logs import open_log, record
from splatbot.logs.calibration import read_calibration
from splatbot.logs.images import read_color
from splatbot.trajectory import Trajectory
from splatbot.workspace import Workspace
from tests.conftest import MakeLog
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


BOARD = "charuco:10x14:0.07:0.04"


@pytest.mark.long
def test_images_of_a_board_give_a_camera_file_and_a_scene(run: RunCommand, tmp_path: Path, data_root: Path) -> None:
    images = data_root / "panda_charuco_32"
    answer = run("calibrate", "intrinsics", images, "--board", BOARD, "--out", tmp_path / "camera.json")
    assert answer.code == 0
    assert re.search(r"fx +614\.7\d ± 0\.\d\d px", answer.out)
    assert read_calibration(tmp_path / "camera.json").camera.width == 640
    scene = tmp_path / "scene.yaml"
    Workspace(gravity=np.array([0.0, 0.0, -1.0])).save(scene)
    words = ("--board", BOARD, "--camera", tmp_path / "camera.json", "--robot", "panda", "--out", scene)
    answer = run("calibrate", "hand-eye", images, *words)
    assert answer.code == 0
    assert re.search(r"panda_joint5 +1[01]\.\d\d ± 0\.\d\d mrad", answer.out)
    assert "not known: it turns the base" in answer.out
    written = Workspace.load(scene)
    assert written.gravity is not None  # kept
    assert written.joint_offsets is not None
    assert written.offsets_of == "panda"
    assert written.T_link_camera is not None
    assert written.joint_offsets[4] == pytest.approx(0.011, abs=0.002)
    assert np.linalg.norm(written.T_link_camera[:3, 3]) == pytest.approx(0.14, abs=0.02)


def test_recorded_poses_of_the_hand_do_without_a_robot(run: RunCommand, data_root: Path) -> None:
    answer = run("calibrate", "hand-eye", data_root / "panda_charuco_32", "--board", BOARD)
    assert answer.code == 0
    assert "joint" not in answer.out.replace("without joint offsets", "")


@pytest.mark.long
def test_a_board_that_is_described_too_small_keeps_the_camera_at_its_place(
    run: RunCommand, tmp_path: Path, data_root: Path
) -> None:
    """Squares of 70 mm are given as 68 mm: 70 / 68 = 1.0294."""
    words = ("--board", "charuco:10x14:0.068:0.039", "--robot", "panda")
    answer = run("calibrate", "hand-eye", data_root / "panda_charuco_32", *words, "--out", tmp_path / "scene.yaml")
    assert answer.code == 0
    found = re.search(r"scale of the board +(\S+) ± (\S+)", answer.out)
    assert found is not None
    assert float(found[1]) == pytest.approx(70 / 68, abs=3 * float(found[2]))
    written = Workspace.load(tmp_path / "scene.yaml")
    assert written.T_link_camera is not None
    assert np.linalg.norm(written.T_link_camera[:3, 3]) == pytest.approx(0.139, abs=0.003)


def test_a_map_of_another_scale_is_no_scene(run: RunCommand, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    links = np.array([se3_exp([*rng.uniform(-0.4, 0.4, 3), *rng.uniform(-0.6, 0.6, 3)]) for _ in range(60)])
    cameras = links @ se3_exp([0.05, 0.02, 0.08, 0.1, -0.2, 1.5])
    cameras[:, :3, 3] *= 1.05
    stamps = np.arange(60.0)
    for name, T in (("arm.txt", links), ("map.txt", cameras)):
        Trajectory(stamps, T).save(tmp_path / name)
    words = ("--poses", tmp_path / "arm.txt", "--link", "-1", "--scale", "auto", "--out", tmp_path / "scene.yaml")
    answer = run("calibrate", "hand-eye", tmp_path / "map.txt", *words)
    assert answer.code == 2
    assert re.search(r"scale of the map +0\.952\d", answer.out)  # 1 / 1.05
    assert "divide the depth_scale of the camera file by 0.952" in answer.err
    assert not (tmp_path / "scene.yaml").exists()


def test_two_pose_files_of_one_motion_give_the_hand_eye_pose_and_the_time_offset(
    run: RunCommand, tmp_path: Path, data_root: Path
) -> None:
    with zipfile.ZipFile(data_root / "hand_eye_time_offset" / "robot_arm_w_color_camera_real.zip") as archive:
        archive.extractall(tmp_path)
    (arm,), (camera,) = (list(tmp_path.rglob(f"*{name}.csv")) for name in ("sr300_hinge", "target_ir"))
    answer = run("calibrate", "hand-eye", camera, "--poses", arm, "--link", "-1", "--out", tmp_path / "scene.yaml")
    assert answer.code == 0
    assert re.search(r"time offset +-1[67]\.\d\d ± \d\.\d\d ms", answer.out)
    written = Workspace.load(tmp_path / "scene.yaml")
    assert written.T_world_base is not None
    assert written.joint_offsets is None


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("{images}",), "--joints, --poses"),
        (("{images}", "--board", "charuco:10x14"), "board"),
        (("{images}", "--board", "charuco:3x3:0.07:0.04:7X7_50"), "board"),
        (("{images}", "--board", BOARD, "--robot", "panda", "--link", "9"), "--link"),
        (("{images}", "--board", BOARD, "--robot", "nobody"), "nobody"),
        (("{images}", "--board", BOARD, "--offsets", "yes"), "--offsets"),
        (("{images}", "--board", BOARD, "--poses", "{poses}"), "--joints, --poses"),
        (("{images}", "--board", BOARD, "--poses", "x.txt"), "x.txt: --poses: does not exist"),
        (("{images}", "--board", BOARD, "--max-views", "0"), "--max-views"),
        (("{images}", "--board", BOARD, "--link", "0"), "--link"),
        (("{images}", "--board", BOARD, "--same-clock"), "--same-clock"),
        (("{images}", "--board", BOARD), "--link"),
        (("{images}", "--board", BOARD, "--robot", "ur5e"), "disagree"),
        (("{images}", "--board", BOARD, "--max-views", "4"), "views"),
        (("{empty}", "--board", BOARD), "empty"),
        (("nowhere", "--board", BOARD), "nowhere"),
        (("nowhere.txt", "--poses", "x.txt"), "nowhere.txt"),
    ],
)
def test_wrong_input_of_hand_eye_is_named_and_no_scene_is_written(
    run: RunCommand, tmp_path: Path, data_root: Path, words: tuple[str, ...], message: str
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "poses.txt").write_text("0 0 0 0 0 0 0 1\n")
    images, poses = data_root / "panda_charuco_32", tmp_path / "poses.txt"
    places = {"{images}": str(images), "{empty}": str(tmp_path / "empty"), "{poses}": str(poses)}
    given = [places.get(word, word) for word in words]
    answer = run("calibrate", "hand-eye", *given, "--out", tmp_path / "scene.yaml")
    assert answer.code == 2
    assert message in answer.err
    assert "Fix:" in answer.err
    assert not (tmp_path / "scene.yaml").exists()


@pytest.mark.parametrize(
    "text",
    [
        "[1, 2",
        "T_base_link: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0.3, 0, 0.5, 1]]",
        "T_base_link: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]",
        "joint_values: [1, nan]",
        "joint_values: far",
        "T_base_link: [[1, 2], [3, 4]]",
        "- 3",
        "r_mtx: [1]\nt_vec: [1, 2, 3]",
    ],
)
def test_a_damaged_file_next_to_an_image_is_named(tmp_path: Path, text: str) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((8, 8, 3), np.uint8))
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(FormatError, match=r"a\.yaml"):
        list(ViewSource(str(tmp_path)).read(3))


def test_images_of_a_board_parallel_to_the_image_give_no_camera_file(run: RunCommand, tmp_path: Path) -> None:
    from tests.unit.calibration.test_board import photograph

    board = CharucoBoard(6, 8, 0.05, 0.035, "4X4_50", False)
    for k in range(8):
        T = np.eye(4)
        T[:3, 3] = [-0.15 + 0.01 * k, -0.2, 0.6 + 0.03 * k]
        cv2.imwrite(str(tmp_path / f"{k}.png"), photograph(board, T))
    words = ("--board", "charuco:6x8:0.05:0.035", "--out", tmp_path / "camera.json")
    answer = run("calibrate", "intrinsics", tmp_path, *words)
    assert answer.code == 2
    assert "is not determined" in answer.err
    assert not (tmp_path / "camera.json").exists()


def test_images_of_a_log_are_those_of_its_files_so_that_distortion_is_estimated(make_log: MakeLog) -> None:
    folder = make_log(6)
    values = json.loads((folder / "intrinsics.json").read_text())
    (folder / "intrinsics.json").write_text(json.dumps({**values, "distortion": [-0.2, 0.05, 0, 0, 0]}))
    source = ViewSource(str(folder))
    assert source.calibration is not None
    assert source.calibration.depth_scale == 5000  # of this log, not the default of image folders
    first = sorted((folder / "rgb").iterdir())[0]
    (_, _, image), *_ = source.read(1)
    assert (image == read_color(first)).all()
    assert not (open_log(folder)[0].rgb == image).all()


def test_damaged_frames_of_a_log_are_counted_and_the_others_read(make_log: MakeLog) -> None:
    folder = make_log(6)
    path = sorted((folder / "rgb").iterdir())[2]
    path.write_bytes(path.read_bytes()[:-20])
    source = ViewSource(str(folder))
    assert len(list(source.read(100))) == 5
    assert source.skipped == 1
