"""`splatbot train` as a user runs it: to its end, with Ctrl-C, killed and resumed."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatbot.cli import main
from splatbot.gaussians import GaussianModel
from splatbot.results.folder import RunFolder
from splatbot.training.folder import TrainingFolder
from splatbot.trajectory import Trajectory
from tests.unit.training.rendered import write_blender_scene
from tests.waiting import until


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Blender scene of 10 photographs with alpha."""
    return write_blender_scene(tmp_path_factory.mktemp("blender"), 10)


SLOW = """
import sys, time
from splatbot.cli import main
from splatbot.training.trainer import Trainer

step = Trainer.step

def slow_step(self, progress):
    time.sleep(0.03)
    return step(self, progress)

Trainer.step = slow_step
sys.exit(main(sys.argv[1:]))
"""


def start(*words: str, program: tuple[str, ...] = ("-m", "splatbot")) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, *program, "train", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def start_slow(*words: str) -> subprocess.Popen[str]:
    """Start a training that takes its steps at no more than 33 a second, on any machine."""
    return start(*words, program=("-c", SLOW))


def finish(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=240)
    return process.returncode, out, err


@pytest.mark.long
def test_a_scene_becomes_a_map_with_scores_pictures_and_poses(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    code, printed, err = finish(start(str(scene), "--iterations", "250", "--out", str(out)))
    assert code == 0, err
    assert "PSNR" in printed
    scores = json.loads((out / "scores.json").read_text())
    assert scores["complete"] is True
    assert scores["iterations"] == 250
    assert [view["name"] for view in scores["views"]] == ["000.png", "008.png"]
    assert scores["psnr_db"] > 15  # eight photographs around a ball
    model = GaussianModel.load(out / "map.ply")
    assert len(model) == scores["gaussians"]
    assert len(Trajectory.load(out / "trajectory.tum").stamps) == 8
    for name in ("course.png", "held_out.jpg"):
        image = cv2.imread(str(out / name))
        assert image is not None
        assert image.std() > 5
    refused, _, err = finish(start(str(scene), "--iterations", "5", "--out", str(out)))
    assert refused == 2
    assert "holds a training already" in err
    assert "--resume" in err


@pytest.mark.long
def test_ctrl_c_keeps_the_trained_map_and_the_run_can_be_resumed(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    process = start(str(scene), "--iterations", "1000000", "--checkpoint-every", "0.2", "--out", str(out))
    until(lambda: (out / "checkpoint.pt").is_file())
    process.send_signal(signal.SIGINT)
    code, _, err = finish(process)
    assert code == 130, err
    assert f"--resume {out}" in err
    scores = json.loads((out / "scores.json").read_text())
    assert scores["complete"] is False
    assert scores["iterations"] > 0
    assert len(GaussianModel.load(out / "map.ply")) == scores["gaussians"]
    process = start("--resume", str(out), "--checkpoint-every", "0.2")
    before = (out / "checkpoint.pt").stat().st_mtime_ns
    until(lambda: (out / "checkpoint.pt").stat().st_mtime_ns != before)
    process.send_signal(signal.SIGINT)
    assert finish(process)[0] == 130
    assert json.loads((out / "scores.json").read_text())["iterations"] > scores["iterations"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "DATASET"),
        (("nowhere",), "nowhere"),
        (("{scene}", "--minutes", "-1"), "minutes"),
        (("{scene}", "--scale", "0"), "scale"),
        (("--resume", "{scene}"), "holds no training"),
        (("{scene}", "--held-out-every", "1"), "holds out all"),
    ],
)
def test_wrong_input_is_named_with_a_fix(
    words: tuple[str, ...], message: str, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [word.replace("{scene}", str(scene)) for word in words]
    assert main(["train", *given, *(() if "--resume" in given else ("--out", str(tmp_path / "out")))]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert "Fix:" in err
    assert not (tmp_path / "out").exists()  # else a corrected command would be refused


@pytest.mark.long
def test_a_run_killed_at_ten_random_moments_ends_with_the_bits_of_one_that_was_not(scene: Path, tmp_path: Path) -> None:
    often = ("--checkpoint-every", "0.1")
    words = (str(scene), "--iterations", "1500", "--strategy", "mcmc", "--max-gaussians", "2000", *often)
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert finish(start(*words, "--out", str(whole)))[0] == 0
    rng, reached = np.random.default_rng(4), [0]
    begin = [*words, "--out", str(cut)]
    for _ in range(10):
        process = start_slow(*begin)
        until(lambda: (cut / "checkpoint.pt").is_file() and checkpoint(cut) > reached[-1])
        time.sleep(float(rng.uniform(0.0, 0.3)))
        assert process.poll() is None  # it still trains
        process.kill()
        process.communicate()
        reached.append(checkpoint(cut))
        begin = ["--resume", str(cut), *often]
    code, _, err = finish(start(*begin))
    assert code == 0, err
    assert reached == sorted(set(reached))
    assert (cut / "map.ply").read_bytes() == (whole / "map.ply").read_bytes()


def checkpoint(folder: Path) -> int:
    """Return the iterations of the last checkpoint of a training."""
    return int(TrainingFolder(folder).load_checkpoint()["iteration"])


@pytest.mark.long
def test_the_map_of_a_run_is_improved_in_place_and_the_earlier_one_kept(tmp_path: Path) -> None:
    run = tmp_path / "run"
    words = ("synthetic:tabletop?frames=10&width=160&height=120", "--out", str(run), "--quiet")
    subprocess.run([sys.executable, "-m", "splatbot", "map", *words], check=True, timeout=200)
    mapped = (run / "map.ply").read_bytes()
    folder = RunFolder(run)
    before, metrics = GaussianModel.load(run / "map.ply"), folder.load_metrics()
    code, printed, err = finish(start(str(run), "--iterations", "150"))
    assert code == 0, err
    scores = folder.load_metrics()
    psnr, depth = ([each[key] for each in (metrics, scores)] for key in ("psnr_holdout_db", "depth_median_m"))
    assert f"{psnr[0]:.1f} dB before, {psnr[1]:.1f} dB after" in printed
    assert f"{1e3 * depth[0]:.2f} mm before, {1e3 * depth[1]:.2f} mm after" in printed
    assert str(run / "map.ply") in printed
    assert (run / "map.mapped.ply").read_bytes() == mapped
    after = GaussianModel.load(run / "map.ply")
    assert len(after) == len(before)
    assert after.sh_degree == 3
    assert bool((after.observations == before.observations).all())
    assert folder.check() is True  # the checksums are those of the new map
    assert not folder.report.exists()
    moved = (after.means - before.means).norm(dim=1)
    assert 0 < float(moved.median()) < 0.005
