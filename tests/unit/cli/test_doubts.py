"""Questions about logs and runs that are plausible to a program only."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatbot.cli.doubts import camera_doubts, run_doubts
from splatbot.logs import open_log
from splatbot.results.scoring import score_trajectory
from splatbot.trajectory import Trajectory


def _changed(folder: Path, **values: float) -> Path:
    file = folder / "intrinsics.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | values))
    return folder


@pytest.mark.parametrize(
    ("values", "question"),
    [
        ({}, ""),
        ({"fx": 5000.0}, "fx and width"),
        ({"cx": 3.0}, "principal point"),
    ],
)
def test_intrinsics_that_no_camera_has_are_questioned(
    make_log: Callable[..., Path], values: dict[str, float], question: str
) -> None:
    doubts = camera_doubts(open_log(_changed(make_log(3), **values)).camera)
    assert bool(doubts) == bool(question)
    assert question in " ".join(doubts)


def test_a_reference_of_another_scale_is_questioned() -> None:
    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[:, 0, 3] = np.linspace(0, 1, 30)
    larger = poses.copy()
    larger[:, :3, 3] *= 2.0
    stamps = np.arange(30.0)
    metrics: dict[str, Any] = {"frames": 30, "degraded": 0, "lost": 0}
    for reference, asked in ((poses, False), (larger, True)):
        score = score_trajectory(Trajectory(stamps, poses), Trajectory(stamps, reference))
        assert score is not None
        doubts = run_doubts(metrics | {"reference_scale": score.reference_scale})
        assert bool(doubts) == asked
    assert "2.00 times as large" in doubts[0]


def test_a_run_with_mostly_degraded_frames_is_questioned() -> None:
    assert not run_doubts({"frames": 100, "degraded": 20, "lost": 10})
    (doubt,) = run_doubts({"frames": 100, "degraded": 80, "lost": 10})
    assert "90 of 100 frames" in doubt
