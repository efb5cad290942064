"""Recording: frames are read back as written, and an interrupted recording is a shorter log."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatbot.errors import LogError
from splatbot.frame import Frame
from splatbot.logs import open_log, record
from splatbot.logs.bag import BagLog
from splatbot.logs.mcap import record_mcap
from splatbot.logs.record import Progress
from splatbot.trajectory import Trajectory

SMALL = "synthetic:tabletop?width=80&height=60&frames=5"


def test_a_recorded_log_reads_back_as_the_quantised_frames(tmp_path: Path) -> None:
    log = open_log(SMALL)
    seen: list[int] = []
    progress: Progress = seen.append
    back = open_log(record(log, tmp_path / "log", progress=progress))
    assert seen == [1, 2, 3, 4, 5]
    assert len(back) == 5
    assert back.camera == log.camera
    for ours, theirs in zip(back, log, strict=True):
        assert ours.stamp == theirs.stamp
        assert np.array_equal(ours.rgb, theirs.rgb)
        assert np.abs(ours.depth - theirs.depth).max() <= 0.5001 / 5000
        units = np.rint(theirs.depth.astype(np.float64) * 5000.0)
        assert np.array_equal(ours.depth, (units / 5000.0).astype(np.float32))
    truth, expected = back.ground_truth, log.ground_truth
    assert truth is not None
    assert expected is not None
    assert np.array_equal(truth.stamps, expected.stamps)
    np.testing.assert_allclose(truth.T_world_camera, expected.T_world_camera, atol=1e-11)


def test_recording_a_recording_changes_nothing(tmp_path: Path) -> None:
    first = open_log(record(open_log(SMALL), tmp_path / "first"))
    second = open_log(record(first, tmp_path / "second"))
    for a, b in zip(first, second, strict=True):
        assert np.array_equal(a.rgb, b.rgb)
        assert np.array_equal(a.depth, b.depth)


def test_frames_of_any_source_are_recorded(tmp_path: Path) -> None:
    frames = [open_log(SMALL)[i] for i in (1, 3)]
    truth = Trajectory(np.array([f.stamp for f in frames]), np.tile(np.eye(4), (2, 1, 1)))
    back = open_log(record(iter(frames), tmp_path / "log", ground_truth=truth, depth_scale=1000.0))
    assert np.abs(back[1].depth - frames[1].depth).max() <= 0.5001 / 1000
    assert back.ground_truth is not None
    assert len(back.ground_truth) == 2
    assert open_log(record(iter(frames), tmp_path / "no_truth")).ground_truth is None


@pytest.mark.parametrize("after", [1, 3])
def test_an_interrupted_recording_is_a_shorter_log(tmp_path: Path, after: int) -> None:
    def interrupt(done: int) -> None:
        if done == after:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record(open_log(SMALL), tmp_path / "log", progress=interrupt)
    assert len(list(open_log(tmp_path / "log"))) == after


def test_an_interruption_between_depth_and_colour_leaves_a_readable_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, written = Path.write_bytes, []

    def write(path: Path, data: bytes) -> int:
        written.append(path)
        if len(written) == 6:  # depth of the third frame
            raise KeyboardInterrupt
        return real(path, data)

    monkeypatch.setattr(Path, "write_bytes", write)
    with pytest.raises(KeyboardInterrupt):
        record(open_log(SMALL), tmp_path / "log")
    assert len(list(open_log(tmp_path / "log"))) == 2


def test_an_existing_recording_is_not_overwritten(tmp_path: Path) -> None:
    record(open_log(SMALL), tmp_path / "log")
    before = (tmp_path / "log/rgb.txt").read_text()
    with pytest.raises(LogError, match="already"):
        record(open_log(SMALL), tmp_path / "log")
    assert (tmp_path / "log/rgb.txt").read_text() == before


def test_a_camera_that_changes_is_refused(tmp_path: Path) -> None:
    def frames() -> Iterator[Frame]:
        yield open_log(SMALL)[0]
        yield open_log(SMALL.replace("80", "96"))[1]

    with pytest.raises(LogError) as caught:
        record(frames(), tmp_path / "log")
    assert caught.value.field == "camera"
    assert len(list(open_log(tmp_path / "log"))) == 1


def test_depth_beyond_the_range_is_missing_and_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    frame = open_log(SMALL)[0]
    depth = frame.depth.copy()
    depth[:2] = 14.0
    with caplog.at_level(logging.WARNING):
        back = open_log(record([replace(frame, depth=depth)], tmp_path / "log"))
    assert "160 pixels beyond 13.1 m" in caplog.text
    assert not back[0].valid[:2].any()
    assert back[0].valid[2:].all()


def test_the_delay_of_depth_is_kept_by_its_stamps(tmp_path: Path) -> None:
    delays = [0.004 * k for k in range(5)]
    frames = [replace(frame, depth_delay=delay) for frame, delay in zip(open_log(SMALL), delays, strict=True)]
    first = open_log(record(frames, tmp_path / "log"))
    for log in (first, BagLog(record_mcap(first, tmp_path / "log.mcap"))):
        assert [frame.depth_delay for frame in log] == pytest.approx(delays, abs=1e-6)
