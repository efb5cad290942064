"""A batch on this machine: each item once, errors in files, one owner of a folder, and no process left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from concurrent.futures import Future
from contextlib import nullcontext, suppress
from pathlib import Path

import pytest

from splatbot.batch.item import OUTPUT, BatchItem, ItemRecord, load_record
from splatbot.batch.report import batch_rows
from splatbot.batch.run import reserved, run_batch, unfinished
from splatbot.batch.workers import local_workers
from splatbot.errors import FormatError, InputError
from tests.unit.batch.processes import LONG, item_processes, wait_until

LISTS = ("simulate", "--list")  # ends at once
FAILS = ("export", "/nowhere/map.ply")


def run(batch: Path, *items: BatchItem, workers: int = 2) -> dict[str, ItemRecord]:
    """Run the unfinished items on local workers, and return their records by name."""
    ended = {}
    pending = unfinished(items, batch)
    pool = local_workers(workers, batch, 1)
    assert not run_batch(pending, batch, pool, on_end=lambda item, record: ended.update({item.name: record}))
    return ended


def test_a_finished_item_is_not_redone_and_a_failed_one_is_retried_with_its_error_in_a_file(tmp_path: Path) -> None:
    items = BatchItem("good", LISTS), BatchItem("bad", FAILS)
    first = run(tmp_path, *items)
    assert {name: record.finished for name, record in first.items()} == {"good": True, "bad": False}
    assert "tabletop" in (tmp_path / "good" / OUTPUT).read_text()
    record = load_record(tmp_path / "bad")
    assert record is not None
    assert record.code == 2
    assert record.error.startswith("/nowhere/map.ply: map: does not exist. Fix:")
    assert (tmp_path / "bad" / OUTPUT).read_text().startswith("error: /nowhere/map.ply")
    assert set(run(tmp_path, *items)) == {"bad"}


def test_a_failed_item_begins_with_an_empty_folder_and_may_get_other_words(tmp_path: Path) -> None:
    run(tmp_path, BatchItem("item", FAILS))
    (tmp_path / "item" / "half.ply").touch()
    (tmp_path / "item" / "state").mkdir()
    assert run(tmp_path, BatchItem("item", LISTS))["item"].finished
    assert {path.name for path in (tmp_path / "item").iterdir()} == {"item.json", "item.log"}


def test_an_item_that_ctrl_c_ends_before_it_has_its_own_process_group_stays_unfinished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "program"
    program.write_text("#!/bin/sh\nkill -INT $$\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    item = BatchItem("item", LISTS)
    assert run(tmp_path / "batch", item)["item"].code == -signal.SIGINT
    assert unfinished([item], tmp_path / "batch") == [item]
    assert [row["state"] for row in batch_rows([item], tmp_path / "batch")] == ["unfinished"]


@pytest.mark.parametrize("other", [BatchItem("item", FAILS), BatchItem("item", LISTS, {"SPLATBOT_SEED": "3"})])
def test_a_result_of_another_command_line_is_refused(tmp_path: Path, other: BatchItem) -> None:
    run(tmp_path, BatchItem("item", LISTS))
    with pytest.raises(InputError, match=r"another command line: splatbot simulate --list\. Fix: delete it"):
        unfinished([other], tmp_path)


def test_files_of_another_origin_and_damaged_records_are_refused(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").touch()
    with pytest.raises(InputError, match="no batch wrote"):
        unfinished([BatchItem("mine", LISTS)], tmp_path)
    assert (tmp_path / "mine" / "letter.txt").exists()
    (tmp_path / "mine" / "item.json").write_text('{"words": [')
    with pytest.raises(FormatError, match=r"item\.json"):
        unfinished([BatchItem("mine", LISTS)], tmp_path)


def test_a_folder_has_one_batch_at_a_time(tmp_path: Path) -> None:
    with reserved(tmp_path), pytest.raises(InputError, match=f"in use by process {os.getpid()}"), reserved(tmp_path):
        pass
    with reserved(tmp_path):
        pass


def test_an_item_that_the_kernel_kills_is_tried_again_and_the_others_are_not_harmed(tmp_path: Path) -> None:
    killed = set[int]()

    def kill_each_attempt() -> bool:
        for process in item_processes(tmp_path):
            with suppress(ProcessLookupError):  # the one before, which has ended since it was listed
                os.kill(process, signal.SIGKILL)
                killed.add(process)
        return len(killed) == 2

    with local_workers(1, tmp_path, 1) as submit:
        large, small = submit(BatchItem("large", LONG)), submit(BatchItem("small", LISTS))
        wait_until(kill_each_attempt)
        record = large.result()
        assert (record.code, record.error.split(".")[0]) == (-signal.SIGKILL, "ended by SIGKILL")
        assert small.result().finished
    assert load_record(tmp_path / "large") == record


def test_items_that_still_run_end_with_the_workers_and_count_as_unfinished(tmp_path: Path) -> None:
    items = [BatchItem("first", LONG), BatchItem("second", LONG)]
    with local_workers(1, tmp_path, 1) as submit:
        futures = [submit(item) for item in items]
        wait_until(lambda: (tmp_path / "first" / "rgb").exists())
    assert futures[1].cancelled()
    assert item_processes(tmp_path) == []
    assert unfinished(items, tmp_path) == items
    assert [row["state"] for row in batch_rows(items, tmp_path)] == ["unfinished", "unfinished"]


_SUPERVISOR = """
import sys
from pathlib import Path
from splatbot.batch.item import BatchItem
from splatbot.batch.workers import local_workers

with local_workers(1, Path(sys.argv[1]), 1) as submit:
    submit(BatchItem("item", tuple(sys.argv[2:]))).result()
"""


def test_items_end_when_their_supervisor_is_killed(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", _SUPERVISOR, str(tmp_path), *LONG]) as supervisor:
        wait_until(lambda: (tmp_path / "item" / "rgb").exists())
        supervisor.kill()
    wait_until(lambda: item_processes(tmp_path) == [])
    assert load_record(tmp_path / "item") is None


def test_the_threads_and_settings_of_an_item_are_those_of_the_batch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "program"
    program.write_text("#!/bin/sh\nenv; pwd\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.chdir(tmp_path)
    with local_workers(1, tmp_path / "batch", 3) as submit:
        assert submit(BatchItem("item", ("map",), {"SPLATBOT_SEED": "5"})).result().finished
    shown = set((tmp_path / "batch" / "item" / OUTPUT).read_text().splitlines())
    expected = {"SPLATBOT_NUM_THREADS=3", "OMP_NUM_THREADS=3", "OPENCV_FOR_THREADS_NUM=3", "SPLATBOT_SEED=5"}
    assert expected | {str(tmp_path)} <= shown


def test_a_module_in_the_current_folder_does_not_run_in_an_item(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "threading.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    monkeypatch.chdir(tmp_path)
    assert run(tmp_path / "batch", BatchItem("item", LISTS))["item"].finished
    assert not (tmp_path / "ran").exists()


def test_a_worker_that_is_lost_is_the_error_of_its_item(tmp_path: Path) -> None:
    lost: Future[ItemRecord] = Future()
    lost.set_exception(RuntimeError("the node died"))
    ended = []
    run_batch(
        [BatchItem("item", LISTS)],
        tmp_path,
        nullcontext(lambda item: lost),
        on_end=lambda item, record: ended.append(record.error),
    )
    assert ended == ["RuntimeError: the node died"]
    record = load_record(tmp_path / "item")
    assert record is not None
    assert record.code is None
    assert run(tmp_path, BatchItem("item", LISTS))["item"].finished
