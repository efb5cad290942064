"""Several processes that train one map."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from datetime import timedelta
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest
import torch

from splatbot.cli import main
from splatbot.cli.train import _resumable
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.optimize.adam import PARAMETERS
from splatbot.training.distributed import ALONE, TrainingGroup, connected, planned_group
from splatbot.training.folder import TrainingFolder, TrainingSettings
from splatbot.training.helpers import LostProcessError, check_helpers, started_helpers
from splatbot.training.images import ImageCache
from splatbot.training.initialize import initial_model
from splatbot.training.options import TrainingOptions
from splatbot.training.session import TrainingSession
from splatbot.training.trainer import Trainer
from tests.unit.training.rendered import rendered_data, write_blender_scene
from tests.waiting import until

OPTIONS: tuple[dict[str, Any], ...] = (
    {"strategy": "default", "refine_poses": True, "refine_intrinsics": True, "exposure": True},
    {"strategy": "absgrad", "background": "random"},
    {"strategy": "mcmc", "background": "random"},
    {"strategy": "fixed", "keep_surfaces": True},
    {"strategy": "default", "surfels": True},
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


def second_process(report: str) -> None:
    """Take part in the test below as process 1, and write digests of its results to a file."""
    group = planned_group(1)
    with connected(group, SETTINGS):
        digests = [digest(trained(group, batch=2, **options)) for options in OPTIONS]
        session = session_of(Path(), group)
        session.run()
        Path(report).write_text(json.dumps([*digests, digest(session.trainer)]))
        with pytest.raises(LostProcessError, match="100 to 101 Gaussians"):
            group.check_count(100 + group.rank)
        with pytest.raises(InputError, match=r"seed: is 1 in this process, 0 in process 0\..*equal CPUs"):
            session_of(Path(), group, seed=1)


def digest(trainer: Trainer) -> str:
    """Return a digest of all parameters, poses, intrinsics and exposures."""
    tensors = [getattr(trainer.model, name) for name in PARAMETERS] + of_views(trainer)
    return sha256(b"".join(tensor.numpy().tobytes() for tensor in tensors)).hexdigest()


def of_views(trainer: Trainer) -> list[torch.Tensor]:
    """Return the estimated values of the views: poses, intrinsics and exposures, as far as there are any."""
    tensors = [trainer.poses.viewmats]
    tensors += [] if trainer.intrinsics is None else [trainer.intrinsics.changes]
    tensors += [] if trainer.exposures is None else [trainer.exposures.transforms]
    return tensors


def session_of(folder: Path, group: TrainingGroup = ALONE, seed: int = 0) -> TrainingSession:
    """Return a session with random points, which process 0 alone draws."""
    data = rendered_data(4)
    options = TrainingOptions(iterations=4, max_gaussians=50, batch=2, seed=seed)
    settings = TrainingSettings(data.folder, 1, 0, options)
    return TrainingSession(data, TrainingFolder(folder), settings, group=group)


@pytest.fixture
def second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[subprocess.Popen[bytes]]:
    """Make this process number 0 of two; the other runs :func:`second_process`."""
    variables = {"WORLD_SIZE": "2", "MASTER_ADDR": f"file://{tmp_path}/store", "MASTER_PORT": "0"}
    for name, value in {**variables, "RANK": "0", "GLOO_SOCKET_IFNAME": "lo"}.items():
        monkeypatch.setenv(name, value)
    code = "import sys; from tests.unit.training.test_distributed import second_process; second_process(sys.argv[1])"
    process = subprocess.Popen([sys.executable, "-c", code, f"{tmp_path}/digests"], env={**os.environ, "RANK": "1"})
    yield process
    process.kill()
    process.wait()


def test_two_processes_take_the_steps_of_one_that_sees_both_views(
    second: subprocess.Popen[bytes], tmp_path: Path
) -> None:
    group = planned_group(1)
    assert (group.rank, group.size, group.local) == (0, 2, 0)
    with connected(group, SETTINGS):
        found = [trained(group, batch=2, **options) for options in OPTIONS]
        session = session_of(tmp_path, group)
        session.run()
        with pytest.raises(LostProcessError, match="100 to 101 Gaussians"):
            group.check_count(100 + group.rank)
        session_of(tmp_path, group)  # the other refuses its own
        assert second.wait(timeout=120) == 0
    digests = json.loads((tmp_path / "digests").read_text())
    assert digests == [digest(trainer) for trainer in (*found, session.trainer)]
    for options, two in zip(OPTIONS, found, strict=True):
        one = trained(batch=2, **options)
        assert len(one.model) == len(two.model)
        for name in PARAMETERS:
            torch.testing.assert_close(getattr(two.model, name), getattr(one.model, name), rtol=0, atol=1e-6)
        for in_two, in_one in zip(of_views(two), of_views(one), strict=True):
            torch.testing.assert_close(in_two, in_one, rtol=0, atol=1e-6)
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
    return write_blender_scene(tmp_path_factory.mktemp("blender"), 6)


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


@pytest.fixture
def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


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
        with pytest.raises(InputError, match=r"process 1 of 2: DATASET: .* Fix: name a folder") as caught:
            check_helpers([wrong, killed])
        assert str(caught.value).count("Fix:") == 1
        with pytest.raises(LostProcessError, match=r"SIGKILL\. Fix: again"):
            check_helpers([killed], "again")
        unfinished = start_helper("process 3", ["help"], tmp_path / "3.log", {})
        assert unfinished.failure() == ""
    assert unfinished.process.poll() is not None


def test_the_wrong_input_of_a_helper_is_that_of_the_command() -> None:
    settings = replace(SETTINGS, dataset=Path("/nowhere"))
    with (
        pytest.raises(InputError, match=r"process 1 of 2: /nowhere: ") as caught,
        connected(planned_group(2), settings),
    ):
        pass
    assert "--resume" not in str(caught.value)


def test_resume_is_the_fix_of_a_lost_process_only_with_a_checkpoint_of_this_training(tmp_path: Path) -> None:
    folder, hints = TrainingFolder(tmp_path), []
    folder.save_checkpoint({})  # of an earlier training, which --overwrite replaces
    for begun in (False, True):
        with pytest.raises(LostProcessError) as caught, _resumable(folder, [begun].pop):
            raise LostProcessError("process 1 of 2 was ended by SIGKILL.")
        hints.append(caught.value.hint)
    assert hints == [None, f"`splatbot train --resume {tmp_path}` continues from the last checkpoint"]


def test_a_process_that_nobody_meets_ends_with_the_time_that_it_waited(
    free_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splatbot.training.distributed._CONNECTION", timedelta(seconds=1))
    for name, value in {"RANK": "1", "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": free_port}.items():
        monkeypatch.setenv(name, str(value))
    group, message = planned_group(1), "another process does not answer"
    with pytest.raises(LostProcessError, match=message) as caught, connected(group, SETTINGS):
        pass
    assert caught.value.hint is None  # there is nothing to resume


def test_a_process_that_ends_between_meeting_and_connection_is_noticed(tmp_path: Path) -> None:
    code = f"""
import torch.distributed as dist
from splatbot.training.distributed import TrainingGroup, connected
from splatbot.training.helpers import LostProcessError
from tests.unit.training.test_distributed import SETTINGS

store = dist.FileStore({str(tmp_path / "store")!r}, 2)
store.set("splatbot/1", "")

def watch(waited_s):
    if waited_s > 0.5:
        raise LostProcessError("process 1 of 2 was ended.")

try:
    with connected(TrainingGroup(0, 2, watch=watch), SETTINGS):
        pass
except LostProcessError as error:
    print(error)
"""
    variables = {"WORLD_SIZE": "2", "RANK": "0", "MASTER_ADDR": f"file://{tmp_path}/store", "MASTER_PORT": "0"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env={**os.environ, **variables}, stdout=subprocess.PIPE, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "process 1 of 2 was ended.\n")


@pytest.mark.long
@pytest.mark.parametrize("starter", ["--processes", "torchrun"])
def test_a_second_ctrl_c_ends_the_command_while_another_process_hangs(
    starter: str, scene: Path, tmp_path: Path, free_port: int
) -> None:
    out = tmp_path / "out"
    words = (str(scene), "--iterations", "1000000", "--max-gaussians", "500", "--checkpoint-every", "0.2")
    if starter == "torchrun":
        shared = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port)}
        process = start(*words, "--out", str(out), **shared, RANK="0")
        other = start(*words, "--out", str(tmp_path / "other"), **shared, RANK="1")
    else:
        process = start(*words, "--out", str(out), "--processes", "2")
    until((out / "checkpoint.pt").is_file)
    hung = other.pid if starter == "torchrun" else helper_of(process)
    try:
        os.kill(hung, signal.SIGSTOP)
        process.send_signal(signal.SIGINT)
        with pytest.raises(subprocess.TimeoutExpired):  # the first one waits for the step
            process.wait(timeout=1)
        process.send_signal(signal.SIGINT)
        code, err = finish(process)
        assert (code, err) == (130, "interrupted\n")
    finally:
        with suppress(ProcessLookupError):
            os.kill(hung, signal.SIGKILL)
        process.kill()


@pytest.mark.long
def test_processes_that_torchrun_starts_train_together(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ("-m", "splatbot", "train", str(scene), "--iterations", "20", "--max-gaussians", "500", "--out", str(out))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", *words]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    assert json.loads((out / "scores.json").read_text())["complete"] is True
    assert TrainingFolder(out).load_settings().options.batch == 2
