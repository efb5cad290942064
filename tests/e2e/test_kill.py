"""A run that is killed while it maps leaves its last saved state."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from splatbot.cli import main
from splatbot.results.folder import RunFolder
from splatbot.run.state import SavedRun
from splatbot.trajectory import Trajectory

LOG = "synthetic:tabletop?width=160&height=120&frames=40"
SMALL = [
    "--set",
    "mapping.refine_iterations=2",
    "--set",
    "expert.tracking.n_features=600",
    "--set",
    "mapping.final_iterations=3",
]


def command(*words: str) -> list[str]:
    return [sys.executable, "-m", "splatbot", "map", *words, "--quiet", "--save-every", "0.01"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Trajectory:
    """Return the trajectory of an undisturbed run."""
    out = tmp_path_factory.mktemp("whole")
    subprocess.run(command(LOG, "--out", str(out), *SMALL), check=True, timeout=200)
    return Trajectory.load(out / "trajectory.tum")


def kill_while_mapping(words: list[str], state: Path, seconds: float) -> None:
    """Start a run and kill it after a delay [s] from its first save."""
    run = subprocess.Popen(words, start_new_session=True)
    end = time.monotonic() + 100
    while not state.exists() and run.poll() is None and time.monotonic() < end:
        time.sleep(0.005)
    time.sleep(seconds)
    os.kill(run.pid, signal.SIGKILL)
    run.wait(timeout=30)


@pytest.mark.long
def test_killed_at_any_time_a_run_opens_and_ends_as_if_nothing_had_happened(whole: Trajectory, tmp_path: Path) -> None:
    draw = random.Random(7)
    out, state = tmp_path / "run", tmp_path / "run" / "state" / "run.state"
    kill_while_mapping(command(LOG, "--out", str(out), *SMALL), state, draw.uniform(0.0, 0.5))
    reached = []
    for _ in range(3):
        saved = SavedRun.load(out)
        reached.append(saved.place.next_index)
        poses = [r.T_world_camera for r in saved.slam.results]
        assert np.allclose(np.array(poses), whole.T_world_camera[: len(poses)], atol=1e-9)
        assert len(poses) == saved.place.next_index > 0
        if (out / "metrics.json").exists():
            folder = RunFolder(out)
            assert set(folder.load_poses()) <= set(range(60))
        kill_while_mapping(command("--resume", str(out)), state, draw.uniform(1.5, 3.5))
    assert reached == sorted(reached)
    subprocess.run(command("--resume", str(out)), check=True, timeout=200)
    assert json.loads((out / "metrics.json").read_text())["finished"] is True
    after = Trajectory.load(out / "trajectory.tum")
    assert np.array_equal(after.T_world_camera, whole.T_world_camera)


def test_resuming_with_another_configuration_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", "--resume", str(tmp_path), "--set", "seed=3", "--quiet"]) == 2
    assert "keeps its configuration" in capsys.readouterr().err
