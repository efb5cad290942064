"""`splatbot map` and `splatbot record` with a camera, at a pseudo-terminal."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import yaml

from splatbot.cli import main, record
from splatbot.logs import open_log
from tests.terminal import at_a_terminal
from tests.waiting import until

CAMERA = "replay:synthetic:tabletop?frames=400&width=160&height=120&speed=1"


def test_ctrl_c_is_the_normal_end_of_a_mapped_camera(tmp_path: Path) -> None:
    out = tmp_path / "run"
    shown = at_a_terminal("map", CAMERA, "--out", str(out), "--no-report", columns=80, interrupt_at="mapping")
    assert shown.code == 0, shown.text[-2000:]
    assert "mapped" in shown.text
    assert shown.longest_line() <= 80
    metrics = json.loads((out / "metrics.json").read_text())
    recording = open_log(out / "recording.mcap")
    assert metrics["finished"]
    assert not metrics["interrupted"]
    assert metrics["log"]["uri"] == str(out / "recording.mcap")
    assert metrics["frames"] == metrics["tracked"] >= 1
    assert metrics["tracked"] + metrics["dropped"] <= len(recording) == metrics["log"]["frames"]


@pytest.mark.long
def test_a_mapped_camera_is_its_recording_for_other_commands(tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert main(["map", CAMERA, "--out", str(out), "--max-frames", "24", "--quiet"]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["log"]["frames"] == 24
    assert metrics["paced"] == "by the camera"
    assert metrics["psnr_holdout_db"] > 25.0  # scored against frames of the recording
    assert (out / "report.html").exists()
    again = tmp_path / "again"
    assert main(["map", str(out / "recording.mcap"), "--out", str(again), "--quiet", "--no-report"]) == 0
    assert main(["eval", str(out)]) == 0
    assert main(["map", CAMERA, "--out", str(out), "--max-frames", "3", "--quiet", "--no-report"]) == 2
    assert main(["map", CAMERA, "--out", str(out), "--max-frames", "3", "--quiet", "--no-report", "--overwrite"]) == 0
    assert len(open_log(out / "recording.mcap")) == 3


@pytest.mark.long
def test_a_camera_that_drops_frames_is_scored_and_resumed_by_the_numbers_of_its_recording(tmp_path: Path) -> None:
    out = tmp_path / "run"
    words = ["--out", str(out), "--max-frames", "24", "--quiet", "--no-report"]
    assert main(["map", f"{CAMERA}&drop=0.3", *words]) == 0
    recording = open_log(out / "recording.mcap")
    rows = [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]
    assert sorted(row["index"] for row in rows) == list(range(24))
    assert all(row["stamp"] in (None, recording[row["index"]].stamp) for row in rows)
    assert main(["eval", str(out)]) == 0
    assert main(["map", "--resume", str(out), "--quiet", "--no-report"]) == 0


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_one_signal_ends_a_silent_camera(tmp_path: Path, number: signal.Signals) -> None:
    words = ["record", f"{CAMERA}&stall=5&stall_s=300", "--out", str(tmp_path / "a.mcap")]
    process = subprocess.Popen([sys.executable, "-m", "splatbot", *words], stderr=subprocess.DEVNULL)
    until(lambda: any(tmp_path.rglob("*.mcap")), 60)
    time.sleep(2)
    process.send_signal(number)
    assert process.wait(30) == 0
    assert len(open_log(tmp_path / "a.mcap")) == 5


def test_ctrl_c_before_the_display_of_a_recording_is_there_ends_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    show = record.steps

    @contextmanager
    def signalled(quiet: bool) -> Iterator[Callable[[str], None]]:
        os.kill(os.getpid(), signal.SIGINT)
        with show(quiet) as step:
            yield step

    monkeypatch.setattr(record, "steps", signalled)
    assert main(["record", CAMERA, "--out", str(tmp_path / "a.mcap")]) == 0
    assert 1 <= len(open_log(tmp_path / "a.mcap")) < 400


@pytest.mark.long
def test_a_killed_run_of_a_camera_is_resumed_with_its_recording(tmp_path: Path) -> None:
    out = tmp_path / "run"
    words = ["map", CAMERA, "--out", str(out), "--save-every", "1", "--no-report", "--quiet"]
    process = subprocess.Popen([sys.executable, "-m", "splatbot", *words])
    until((out / "state" / "run.state").exists, 90)
    time.sleep(2)
    process.kill()
    process.wait()
    assert not (out / "recording.mcap").exists()
    assert main(["map", "--resume", str(out), "--quiet", "--no-report"]) == 0
    assert len(open_log(out / "recording.mcap")) >= 1


@pytest.mark.long
def test_several_cameras_are_mapped_live_and_a_killed_run_is_resumed_with_their_recordings(tmp_path: Path) -> None:
    out, rig = tmp_path / "run", tmp_path / "rig.yaml"
    carried = {"T_first_camera": {"translation": [0, 0, 0], "quaternion_wxyz": [1, 0, 0, 0]}, "time_offset": 0.001}
    cameras = {"wrist": {"log": CAMERA}, "side": {"log": f"{CAMERA}.0", **carried}}
    rig.write_text(yaml.safe_dump({"cameras": cameras}, sort_keys=False))
    words = ["map", str(rig), "--out", str(out), "--save-every", "1", "--no-report", "--quiet"]
    process = subprocess.Popen([sys.executable, "-m", "splatbot", *words])
    until((out / "state" / "run.state").exists, 90)
    time.sleep(2)
    process.kill()
    process.wait()
    assert not list(out.glob("*.mcap"))
    assert main(["map", "--resume", str(out), "--quiet", "--no-report"]) == 0
    recording = open_log(out / "recording.yaml")
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["log"]["uri"] == str(out / "recording.yaml")
    assert metrics["cameras"]["side"]["frames"] > 0
    assert {frame.camera_name for frame in recording} == {"", "side"}
    assert main(["map", str(rig), "--out", str(tmp_path / "few"), "--max-frames", "1", "--quiet"]) == 2


def test_a_camera_that_is_lost_keeps_map_and_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splatbot.robots.cameras.replay._QUEUE", 12)  # a busy machine records late, and loses none
    out = tmp_path / "run"
    assert main(["map", f"{CAMERA}&unplug=12", "--out", str(out), "--quiet", "--no-report"]) != 0
    assert "is gone" in capsys.readouterr().err
    assert (out / "map.ply").stat().st_size > 10_000
    assert len(open_log(out / "recording.mcap")) == 12


@pytest.mark.long
def test_a_recorded_camera_has_the_frames_of_the_camera(tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    shown = at_a_terminal("record", CAMERA, "--out", str(out), columns=80, interrupt_at="frame 20,")
    assert shown.code == 0, shown.text[-2000:]
    recorded, source = open_log(out), open_log(CAMERA.removeprefix("replay:").partition("&speed")[0])
    assert len(recorded) >= 20
    frame = recorded[7]
    same = source[round(frame.stamp * 30)]  # a busy computer drops frames before the recording, too
    assert frame.stamp == pytest.approx(same.stamp, abs=1e-6)
    np.testing.assert_array_equal(frame.rgb, same.rgb)
    np.testing.assert_array_equal(frame.depth, same.depth)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["map", "oak://", "--robot", "panda"], "--robot"),
        (["map", "oak://", "--camera", "tum_fr1"], "--camera"),
        (["map", "oak://?size=3x3"], "width"),
        (["map", "synthetic:tabletop", "--seconds", "3"], "--seconds"),
        (["record", "synthetic:tabletop", "--out", "a.mcap", "--max-frames", "3"], "--max-frames"),
        (["record", CAMERA, "--out", "a.mcap", "--seconds", "nan"], "--seconds"),
        (["record", "oak://", "--out", "a.mcap"], "USB 3"),
    ],
)
def test_a_wrong_use_is_one_sentence_and_writes_nothing(
    words: list[str], named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words) != 0
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert named in error
    assert not list(tmp_path.iterdir())
