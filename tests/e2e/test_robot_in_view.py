"""`splatbot map --robot`: the arm that carries the camera stays out of the map."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from splatbot.cli import main
from splatbot.logs.record import record
from splatbot.logs.scenes.tabletop import tabletop
from splatbot.robots.panda import panda
from splatbot.sim.wrist import T_PANDA_CAMERA, WristLog
from splatbot.workspace import Workspace

T_SCENE_BASE = np.array([[0.0, -1, 0, 0.0], [1, 0, 0, -0.55], [0, 0, 1, 0.0], [0, 0, 0, 1]])
START = np.array([0.0, -0.35, 0.0, -2.1, 0.0, 1.9, np.pi / 4])


@pytest.fixture
def wrist(tmp_path: Path) -> Path:
    joints = START + np.linspace(0, 0.1, 8)[:, None] * np.array([1.0, 0.4, 0, 0.4, 0, 0.4, 0.8])
    log = WristLog(panda(), joints, tabletop().surfaces, T_scene_base=T_SCENE_BASE, width=160)
    return record(log, tmp_path / "wrist", ground_truth=log.ground_truth)


def test_the_arm_stays_out_of_the_map_when_the_log_tells_joints_and_mount(wrist: Path, tmp_path: Path) -> None:
    Workspace(T_link_camera=T_PANDA_CAMERA).save(wrist / "scene.yaml")
    quick = ["--set", "mapping.refine_iterations=1", "--set", "mapping.final_iterations=1", "--quiet"]
    counts = {}
    for name, extra in (("with", ["--robot", "panda"]), ("without", [])):
        assert main(["map", str(wrist), "--out", str(tmp_path / name), *extra, *quick]) == 0
        metrics = json.loads((tmp_path / name / "metrics.json").read_text())
        assert metrics["log"]["robot"] == (None if name == "without" else "panda")
        counts[name] = metrics["gaussians"]
    assert counts["with"] < 0.97 * counts["without"]
    assert main(["eval", str(tmp_path / "with")]) == 0
    assert main(["map", "--resume", str(tmp_path / "with"), "--quiet"]) == 0


def test_without_a_mount_the_error_names_file_and_field(wrist: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", str(wrist), "--robot", "panda", "--quiet"]) == 2
    told = capsys.readouterr().err
    assert "scene.yaml" in told
    assert "T_link_camera" in told
