"""`splatbot convert-log`: any log as a TUM folder or an MCAP file."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatbot.frame import Frame
from splatbot.logs import open_log
from splatbot.logs.record import record
from splatbot.logs.tum import TumLog
from tests.unit.cli.conftest import RunCommand, assert_refused
from tests.unit.logs.published import write_sens
from tests.unit.logs.test_same_scene import write_tum

LOG = "synthetic:tabletop?frames=4&width=64&height=48"


@pytest.fixture
def frames() -> list[Frame]:
    return list(open_log(LOG))


@pytest.fixture
def sens(tmp_path: Path, frames: list[Frame]) -> Path:
    return write_sens(tmp_path, frames, [np.eye(4)] * 4)


@pytest.mark.parametrize("name", ["desk", "desk.mcap", "new/folder/desk"])
def test_frames_stamps_and_poses_stay_the_same(run: RunCommand, tmp_path: Path, sens: Path, name: str) -> None:
    out = tmp_path / name
    answer = run("convert-log", sens, out)
    assert (answer.code, answer.err) == (0, "")
    assert f"{out}: 4 frames" in answer.out
    source, copy = open_log(sens), open_log(out)
    assert len(copy) == 4
    assert copy.camera == source.camera
    for a, b in zip(source, copy, strict=True):
        assert a.stamp == b.stamp
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_array_equal(a.depth, b.depth)
    assert copy.ground_truth is not None
    np.testing.assert_allclose(copy.ground_truth.T_world_camera, [np.eye(4)] * 4, atol=1e-12)
    assert sorted(path.name for path in out.parent.iterdir() if path.name.startswith(".")) == []


@pytest.mark.parametrize("name", ["desk", "desk.mcap"])
def test_only_the_first_frames_are_written(run: RunCommand, tmp_path: Path, sens: Path, name: str) -> None:
    assert run("convert-log", sens, tmp_path / name, "--frames", 2, "--quiet").out == ""
    assert len(open_log(tmp_path / name)) == 2
    assert run("convert-log", sens, tmp_path / f"all-{name}", "--frames", 99).code == 0
    assert len(open_log(tmp_path / f"all-{name}")) == 4


def test_a_later_part_is_written_and_described(run: RunCommand, tmp_path: Path, sens: Path) -> None:
    assert run("convert-log", sens, tmp_path / "part", "--first-frame", 1, "--frames", 2).code == 0
    part, whole = open_log(tmp_path / "part"), open_log(sens)
    assert [frame.stamp for frame in part] == [whole[1].stamp, whole[2].stamp]
    assert re.search(r"frames +3\n", run("info", sens, "--first-frame", 1).out)
    answer = run("convert-log", sens, tmp_path / "none", "--first-frame", 4)
    assert answer.code == 2
    assert "--first-frame: is 4. Fix: the frames of the log have the numbers 0 to 3" in answer.err
    assert not (tmp_path / "none").exists()


def test_the_depth_scale_may_be_chosen(run: RunCommand, tmp_path: Path, frames: list[Frame]) -> None:
    assert run("convert-log", LOG, tmp_path / "fine", "--depth-scale", 10_000).code == 0
    np.testing.assert_allclose(open_log(tmp_path / "fine")[1].depth, frames[1].depth, atol=5.1e-5)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{sens}", "{sens}"], "is a file"),
        (["{sens}", "{folder}"], "exists already"),
        (["{sens}", "{folder}.mcap", "--depth-scale", "1000"], "--depth-scale"),
        (["{sens}", "{folder}/new", "--depth-scale", "0"], "--depth-scale"),
        (["{sens}", "{folder}/new", "--frames", "0"], "--frames"),
        (["{folder}/none", "{folder}/new"], "does not exist"),
        (["{sens}", "{folder}/new", "--camera", "tum_fr1"], "its own camera"),
    ],
)
def test_wrong_words_are_refused_before_anything_is_written(
    run: RunCommand, tmp_path: Path, sens: Path, words: list[str], message: str
) -> None:
    folder = tmp_path / "there"
    folder.mkdir()
    answer = run("convert-log", *(word.format(sens=sens, folder=folder) for word in words))
    assert_refused(answer, message)
    assert list(folder.iterdir()) == []


def test_ctrl_c_removes_a_folder_and_keeps_the_frames_of_an_mcap_file(
    run: RunCommand, tmp_path: Path, frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    log = write_tum(tmp_path / "log", frames, [])
    read = TumLog._decode

    def interrupted(self: TumLog, index: int) -> Frame:
        if index == 2:
            raise KeyboardInterrupt
        return read(self, index)

    with monkeypatch.context() as patch:
        patch.setattr(TumLog, "_decode", interrupted)
        assert run("convert-log", log, tmp_path / "copy").code == 130
        assert run("convert-log", log, tmp_path / "copy.mcap").code == 130
    assert sorted(path.name for path in tmp_path.iterdir()) == ["copy.mcap", "log"]
    assert len(open_log(tmp_path / "copy.mcap")) == 2


def test_a_damaged_frame_ends_the_command_without_a_folder(
    run: RunCommand, tmp_path: Path, frames: list[Frame]
) -> None:
    log = write_tum(tmp_path / "log", frames, [])
    (log / "rgb/2.png").write_bytes(b"")
    assert_refused(run("convert-log", log, tmp_path / "copy"), "rgb/2.png: colour: is empty")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["log"]


def test_masks_that_a_folder_does_not_hold_are_named(run: RunCommand, tmp_path: Path, frames: list[Frame]) -> None:
    record(frames, tmp_path / "log")
    cv2.imwrite(str(tmp_path / "log/mask.png"), np.full((48, 64), 255, np.uint8))
    answer = run("convert-log", tmp_path / "log", tmp_path / "copy")
    assert answer.code == 0
    assert "warning: the masks of 4 frames are not written" in answer.err


def test_depth_in_metres_is_written_in_a_finer_unit(run: RunCommand, tmp_path: Path, frames: list[Frame]) -> None:
    folder = write_tum(tmp_path / "metres", frames, [])
    values = json.loads((folder / "intrinsics.json").read_text())
    (folder / "intrinsics.json").write_text(json.dumps(values | {"depth_scale": 1.0}))
    for k, path in enumerate(sorted((folder / "depth").iterdir())):
        cv2.imwrite(str(path.with_suffix(".tiff")), frames[k].depth)
    listed = (folder / "depth.txt").read_text()
    (folder / "depth.txt").write_text(listed.replace(".png", ".tiff"))
    assert run("convert-log", folder, tmp_path / "fine").code == 0
    for a, b in zip(frames, open_log(tmp_path / "fine"), strict=True):
        np.testing.assert_allclose(b.depth, a.depth, atol=1.1e-4)


def test_several_cameras_are_not_written_as_one(run: RunCommand, tmp_path: Path, frames: list[Frame]) -> None:
    record(frames, tmp_path / "log")
    (tmp_path / "rig.yaml").write_text("cameras: {wrist: {log: log}, table: {log: log}}")
    assert_refused(run("convert-log", tmp_path / "rig.yaml", tmp_path / "copy"), "lists several cameras")
    assert not (tmp_path / "copy").exists()
    answer = run("info", tmp_path / "rig.yaml")
    assert answer.code == 0
    assert "free, 4 frames, 64x48" in answer.out
