"""Several processes that train one map."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from splatbot.cli import main
from splatbot.gaussians import GaussianModel
from splatbot.optimize.adam import PARAMETERS
from splatbot.training.distributed import ALONE, TrainingGroup, connected, planned_group
from splatbot.training.folder import TrainingFolder, TrainingSettings
from splatbot.training.helpers import started_helpers
from splatbot.training.images import ImageCache
from splatbot.training.initialize import initial_model
from splatbot.training.options import TrainingOptions
from splatbot.training.session import TrainingSession
from splatbot.training.trainer import Trainer
from tests.unit.training.rendered import CAMERA, rendered_data
from tests.waiting import until

OPTIONS: tuple[dict[str, Any], ...] = (
    {"strategy": "default", "refine_poses": True},
    {"strategy": "absgrad", "background": "random"},
    {"strategy": "mcmc", "background": "random"},
    {"strategy": "fixed", "keep_surfaces": True},
)

SETTINGS = TrainingSettings(Path(), 1, 8, TrainingOptions(batch=2))


def trained(group: TrainingGroup = ALONE, **options: Any) -> Trainer:
    """Train for some steps around one that changes the number of Gaussians."""
    data = rendered_data(6, points=200, depth=bool(options.get("keep_surfaces")))
    images = ImageCache(data.views)
    settings = TrainingOptions(iterations=1000, max_gaussians=400, **options)
    trainer = Trainer(initial_model(data, images, most=200, seed=0), images, settings, 2.0, group)
    trainer.iteration = 596
    for _ in range(8):
        trainer.step(0.3)
    return trainer


def second_process() -> None:
    """Take part in the test below as process 1."""
    group = planned_group(1)
    with connected(group, SETTINGS):
        for options in OPTIONS:
            trained(group, batch=2, **options)
        session_of(Path(), group).run()


def session_of(folder: Path, group: TrainingGroup = ALONE) -> TrainingSession:
    """Return a session of which each process has other random points, unless those of process 0 count."""
    data = rendered_data(4)
    options = TrainingOptions(iterations=4, max_gaussians=50, batch=2, seed=group.rank)
    settings = TrainingSettings(data.folder, 1, 0, options)
    return TrainingSession(data, TrainingFolder(folder), settings, group=group)


@pytest.fixture
def two_processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> TrainingGroup:
    """Process 0 of two; the other runs :func:`second_process`."""
    variables = {"WORLD_SIZE": "2", "MASTER_ADDR": f"file://{tmp_path}/store", "MASTER_PORT": "0"}
    for name, value in {**variables, "RANK": "0", "GLOO_SOCKET_IFNAME": "lo"}.items():
        monkeypatch.setenv(name, value)
    code = "from tests.unit.training.test_distributed import second_process; second_process()"
    subprocess.Popen([sys.executable, "-c", code], env={**os.environ, "RANK": "1"})
    return planned_group(1)


def test_two_processes_take_the_steps_of_one_that_sees_both_views(two_processes: TrainingGroup, tmp_path: Path) -> None:
    assert (two_processes.rank, two_processes.size) == (0, 2)
    with connected(two_processes, SETTINGS):
        found = [trained(two_processes, batch=2, **options) for options in OPTIONS]
        session = session_of(tmp_path, two_processes)
        session.run()
    for options, two in zip(OPTIONS, found, strict=True):
        one = trained(batch=2, **options)
        assert len(one.model) == len(two.model)
        for name in PARAMETERS:
            torch.testing.assert_close(getattr(two.model, name), getattr(one.model, name), rtol=0, atol=1e-6)
        torch.testing.assert_close(two.poses.viewmats, one.poses.viewmats, rtol=0, atol=1e-6)
    assert len(found[0].model) > 200  # it grew
    alone = session_of(tmp_path / "alone")
    alone.run()
    torch.testing.assert_close(session.trainer.model.means, alone.trainer.model.means, rtol=0, atol=1e-6)


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_a_batch_of_one_view_twice_is_that_view_once(strategy: str) -> None:
    data = rendered_data(6, points=100)
    images = ImageCache(data.views[:1])
    models = []
    for batch in (1, 2):
        options = TrainingOptions(iterations=1000, max_gaussians=400, strategy=strategy, batch=batch)  # type: ignore[arg-type]
        trainer = Trainer(initial_model(data, images, most=200, seed=0), images, options, 2.0)
        trainer.iteration = 598
        trainer._random.manual_seed(1)
        losses = [trainer.step(0.3) for _ in range(4)]
        models.append((trainer.model, losses))
    (once, loss), (twice, same_loss) = models
    assert loss == same_loss
    for name in PARAMETERS:
        assert torch.equal(getattr(once, name), getattr(twice, name))


def test_the_shares_of_the_processes_hold_each_view_once() -> None:
    for count in (2, 3, 7):
        shares = [index for rank in range(2) for index in TrainingGroup(rank, 2).share(count)]
        assert shares == list(range(count))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Blender scene of 6 photographs with alpha."""
    folder = tmp_path_factory.mktemp("blender")
    frames = []
    for view in rendered_data(6).views:
        cv2.imwrite(str(folder / f"{view.name}.png"), cv2.cvtColor(view.read(), cv2.COLOR_RGBA2BGRA))
        T = view.T_world_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"./{view.name}", "transform_matrix": T.tolist()})
    angle = 2 * np.arctan(0.5 * CAMERA.width / CAMERA.fx)
    (folder / "transforms_train.json").write_text(json.dumps({"camera_angle_x": float(angle), "frames": frames}))
    return folder


@pytest.mark.parametrize(
    ("words", "variables", "message"),
    [
        (("--processes", "0"), {}, "--processes"),
        (("--processes", "65"), {}, "--processes"),
        (("--batch", "0"), {}, "batch"),
        (("--processes", "3", "--batch", "2"), {}, "--batch"),
        (("--processes", "2"), {"RANK": "0", "WORLD_SIZE": "2"}, "torchrun"),
        ((), {"RANK": "2", "WORLD_SIZE": "2"}, "RANK"),
        ((), {"RANK": "x", "WORLD_SIZE": "2"}, "RANK"),
    ],
)
def test_wrong_numbers_of_processes_are_named_with_a_fix(
    words: tuple[str, ...],
    variables: dict[str, str],
    message: str,
    scene: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if variables:
        for name, value in {**variables, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "1"}.items():
            monkeypatch.setenv(name, value)
    assert main(["train", str(scene), "--out", str(tmp_path / "out"), *words]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert "Fix:" in err
    assert not (tmp_path / "out").exists()


def start(*words: str, **variables: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "splatbot", "train", *words, "--quiet"]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env={**os.environ, **variables})


def finish(process: subprocess.Popen[str]) -> tuple[int, str]:
    _, err = process.communicate(timeout=240)
    return process.returncode, err


def helper_of(process: subprocess.Popen[str]) -> int:
    """Return the process id of the only helper."""
    (child,) = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return int(child)


@pytest.mark.long
def test_the_command_with_two_processes_writes_the_map_of_one(scene: Path, tmp_path: Path) -> None:
    words = (str(scene), "--iterations", "100", "--max-gaussians", "1000", "--strategy", "mcmc")
    for name, more in (("one", ("--batch", "2")), ("two", ("--processes", "2"))):
        assert finish(start(*words, *more, "--out", str(tmp_path / name))) == (0, "")
    one, two = (GaussianModel.load(tmp_path / name / "map.ply") for name in ("one", "two"))
    for name in PARAMETERS:
        torch.testing.assert_close(getattr(two, name), getattr(one, name), rtol=0, atol=1e-6)
    files = {path.name for path in (tmp_path / "one").iterdir()}
    assert {path.name for path in (tmp_path / "two").iterdir()} == files


@pytest.mark.long
def test_ctrl_c_and_a_killed_process_end_all_and_the_training_can_be_resumed(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    more = ("--checkpoint-every", "0.2", "--processes", "2")
    process = start(str(scene), "--iterations", "1000000", "--max-gaussians", "1000", "--out", str(out), *more)
    until((out / "checkpoint.pt").is_file)
    helper = helper_of(process)
    os.kill(helper, signal.SIGKILL)
    code, err = finish(process)
    assert code == 1
    assert err.startswith("error: process 1 of 2 was ended by SIGKILL.")
    assert len(err.splitlines()) == 1
    assert "--resume" in err
    reached = TrainingFolder(out).load_checkpoint()["iteration"]
    process = start("--resume", str(out), *more)
    until(lambda: TrainingFolder(out).load_checkpoint()["iteration"] > reached)
    helper = helper_of(process)
    process.send_signal(signal.SIGINT)
    code, err = finish(process)
    assert code == 130
    assert f"--resume {out}" in err
    assert not Path(f"/proc/{helper}").exists()
    assert json.loads((out / "scores.json").read_text())["iterations"] > reached


def test_the_failure_of_a_helper_is_its_error_or_its_signal(tmp_path: Path) -> None:
    with started_helpers(2) as start_helper:
        wrong = start_helper("process 1 of 2", ["train"], tmp_path / "1.log", {})
        killed = start_helper("process 2 of 2", ["train"], tmp_path / "2.log", {})
        killed.process.kill()
        killed.process.wait()
        assert killed.failure() == "process 2 of 2 was ended by SIGKILL."
        assert wrong.process.wait() == 2
        assert re.match(r"process 1 of 2: DATASET: .* Fix: ", wrong.failure())
        unfinished = start_helper("process 3", ["help"], tmp_path / "3.log", {})
        assert unfinished.failure() == ""
    assert unfinished.process.poll() is not None


@pytest.mark.long
def test_processes_that_torchrun_starts_train_together(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ("-m", "splatbot", "train", str(scene), "--iterations", "20", "--max-gaussians", "500", "--out", str(out))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", *words]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    assert json.loads((out / "scores.json").read_text())["complete"] is True
    assert TrainingFolder(out).load_settings().options.batch == 2
