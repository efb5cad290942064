"""Runs of a batch equal single runs bit for bit: on local workers, and on a Ray cluster that loses a worker."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from splatbot.cli import main
from tests.unit.batch.processes import item_processes, parent_of, wait_until

pytestmark = [pytest.mark.long, pytest.mark.timeout(1500)]

LOGS = {f"log{k}": f"synthetic:tabletop?frames=10&width=160&height=120&arc={20 + 5 * k}" for k in range(8)}
CLOCKS = ("ms", "stage_ms")


@pytest.fixture(scope="module")
def single_runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of the runs that `splatbot map` writes, one log after the other."""
    folder = tmp_path_factory.mktemp("single")
    for name, log in LOGS.items():
        assert main(["map", log, "--out", str(folder / name), "--no-report", "--quiet"]) == 0
    return folder


@pytest.fixture
def cluster() -> Iterator[Any]:
    """A Ray cluster with two workers of one core."""
    utilities = pytest.importorskip("ray.cluster_utils")
    running = utilities.Cluster(
        initialize_head=True,
        head_node_args={"num_cpus": 2, "include_dashboard": False, "object_store_memory": 80 * 2**20},
    )
    yield running
    running.shutdown()


def start(names: list[str], out: Path, *words: str) -> subprocess.Popen[str]:
    """Start a batch that maps logs."""
    inputs = [f"{name}={LOGS[name]}" for name in names]
    command = [sys.executable, "-m", "splatbot", "batch", "map", *inputs, "--out", str(out), "--with", "no-report"]
    return subprocess.Popen([*command, *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def results(run: Path) -> tuple[Any, ...]:
    """Return the results of a run without its clock times."""
    files = [(run / name).read_bytes() for name in ("map.ply", "trajectory.tum", "config.yaml")]
    frames = [json.loads(line) for line in (run / "frames.jsonl").read_text().splitlines()]
    metrics = json.loads((run / "metrics.json").read_text())
    scores = [metrics[name] for name in ("tracked", "ate_rmse_m", "psnr_holdout_db", "ssim_holdout", "gaussians")]
    return files, [{key: value for key, value in row.items() if key not in CLOCKS} for row in frames], scores


def test_local_workers_with_one_thread_each(single_runs: Path, tmp_path: Path) -> None:
    names = list(LOGS)[:3]
    with start(names, tmp_path, "--workers", "2", "--threads", "1") as batch:
        output, _ = batch.communicate()
    assert batch.returncode == 0, output
    for name in names:
        assert results(tmp_path / name) == results(single_runs / name)
    assert len({(tmp_path / name / "map.ply").read_bytes() for name in names}) == 3


def test_eight_logs_on_two_ray_workers_of_which_one_is_killed_midway(
    single_runs: Path, tmp_path: Path, cluster: Any
) -> None:
    with start(list(LOGS), tmp_path, "--ray", cluster.address) as batch:
        wait_until(lambda: len(list(tmp_path.glob("*/item.json"))) >= 3 and len(item_processes(tmp_path)) == 2, 600.0)
        cut_off = item_processes(tmp_path)[0]
        worker = parent_of(cut_off)
        assert "ray::" in Path(f"/proc/{worker}/cmdline").read_text()
        os.kill(worker, signal.SIGKILL)
        wait_until(lambda: cut_off not in item_processes(tmp_path))
        output, _ = batch.communicate()
    assert batch.returncode == 0, output
    for name in LOGS:
        assert results(tmp_path / name) == results(single_runs / name)
    rows = json.loads((tmp_path / "batch.json").read_text())["items"]
    assert [(row["name"], row["state"]) for row in rows] == [(name, "finished") for name in LOGS]


def test_ctrl_c_ends_the_items_on_a_ray_cluster(tmp_path: Path, cluster: Any) -> None:
    with start(list(LOGS), tmp_path, "--ray", cluster.address) as batch:
        wait_until(lambda: len(item_processes(tmp_path)) == 2)
        batch.send_signal(signal.SIGINT)
        output, _ = batch.communicate(timeout=120)
    assert batch.returncode == 130, output
    assert "Traceback" not in output
    wait_until(lambda: item_processes(tmp_path) == [])


def test_an_item_that_no_node_can_run_is_refused(tmp_path: Path, cluster: Any) -> None:
    with start(list(LOGS), tmp_path, "--ray", cluster.address, "--threads", "3") as batch:
        output, _ = batch.communicate(timeout=120)
    assert batch.returncode == 2, output
    assert "--threads: is 3" in output
