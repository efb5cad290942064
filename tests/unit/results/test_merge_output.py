"""The folder of a merge: no file of the user is lost, at any moment at which the process ends."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from splatbot import failpoints
from splatbot.errors import InputError
from splatbot.results.folder import RunFolder
from splatbot.results.merge_output import check_merge, draft_of, earlier_run, replace_run, restore_run

OF_USER = ("scene.yaml", "trajectory_truth.tum", "my-trajectory.tum", "notes/monday.txt")


def written(folder: Path, *names: str, text: str = "earlier") -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def contents(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A folder with a run and files of the user, and a finished draft next to it."""
    folder = written(tmp_path / "c", "map.ply", "audit.json", "trajectory-left.tum", "state/run.state", *OF_USER)
    (folder / "latest").symlink_to("notes")
    (folder / "gone").symlink_to("nowhere")
    written(draft_of(folder), "map.ply", "state/run.state", text="merged")
    return folder


def check(out: Path, *, overwrite: bool = False) -> None:
    check_merge(out.with_name("a"), out.with_name("b"), out, overwrite=overwrite)


@pytest.mark.parametrize(
    "name", ["config.yaml", "report.html", "frames.jsonl", "trajectory.tum", "trajectory-left.tum", "state/run.state"]
)
def test_a_folder_with_any_file_that_a_merge_removes_is_refused(tmp_path: Path, name: str) -> None:
    out = written(tmp_path / "c", name, "notes.txt")
    with pytest.raises(InputError, match=rf"holds a run already \({name.split('/')[0]}\)"):
        check(out)
    check(out, overwrite=True)
    assert earlier_run(out) == [name.split("/")[0]]


def test_a_folder_without_files_of_a_run_is_taken_and_its_files_stay(tmp_path: Path) -> None:
    out = written(tmp_path / "c", *OF_USER)
    check(out)
    replace_run(written(draft_of(out), "map.ply", text="merged"), out)
    assert contents(out) == {**dict.fromkeys(OF_USER, "earlier"), "map.ply": "merged"}


def test_every_file_of_a_run_folder_counts_as_one_of_a_run(tmp_path: Path) -> None:
    files = [path.name for path in vars(RunFolder(tmp_path)).values() if isinstance(path, Path) and path != tmp_path]
    assert earlier_run(written(tmp_path, *files, RunFolder(tmp_path).trajectory_of("left").name)) == sorted(
        [*files, "trajectory-left.tum"]
    )


def test_the_merged_run_replaces_the_earlier_one_and_the_other_files_stay(out: Path) -> None:
    replace_run(draft_of(out), out)
    merged = {"map.ply": "merged", "state/run.state": "merged"}
    assert contents(out) == {**dict.fromkeys(OF_USER, "earlier"), **merged}
    assert [str((out / name).readlink()) for name in ("latest", "gone")] == ["notes", "nowhere"]
    assert [path.name for path in out.parent.iterdir()] == ["c"]


def test_files_are_copied_where_there_are_no_hard_links(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object, **__: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refused)
    replace_run(draft_of(out), out)
    assert contents(out).items() >= dict.fromkeys(OF_USER, "earlier").items()


def test_an_error_of_the_other_files_leaves_the_folder_as_it_was(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = contents(out)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "link", full)
    monkeypatch.setattr(shutil, "copy2", full)
    with pytest.raises(OSError, match="No space left"):
        replace_run(draft_of(out), out)
    assert contents(out) == before


def test_an_error_of_the_rename_leaves_the_folder_as_it_was(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = contents(out)

    def refused(*_: object) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr("splatbot.results.merge_output.replace", refused)
    with pytest.raises(OSError, match="Input/output"):
        replace_run(draft_of(out), out)
    assert contents(out) == before
    assert sorted(path.name for path in out.parent.iterdir()) == [".c.draft", "c"]


def killed(out: Path, point: str) -> None:
    """Replace the run in a process that is killed at a point."""
    program = (
        "from splatbot.results.merge_output import draft_of, replace_run\n"
        f"replace_run(draft_of({str(out)!r}), {str(out)!r})"
    )
    environment = os.environ | {failpoints.VARIABLE: point}
    ended = subprocess.run([sys.executable, "-c", program], env=environment, timeout=60, check=False)
    assert ended.returncode == -signal.SIGKILL


def test_a_merge_that_was_killed_between_the_renames_is_undone_at_the_next_start(out: Path) -> None:
    before = contents(out)
    killed(out, "rename:1")
    assert not out.exists()
    restore_run(out)
    assert contents(out) == before
    check(out, overwrite=True)
    shutil.rmtree(draft_of(out))
    replace_run(written(draft_of(out), "map.ply", text="merged"), out)
    assert contents(out)["map.ply"] == "merged"


def test_a_merge_that_was_killed_after_the_renames_leaves_the_merged_run_and_no_other_is_removed(out: Path) -> None:
    killed(out, "renamed:1")
    restore_run(out)
    assert contents(out).items() >= {**dict.fromkeys(OF_USER, "earlier"), "map.ply": "merged"}.items()
    with pytest.raises(InputError, match="is left of a merge that was killed"):
        check(out, overwrite=True)
    shutil.rmtree(out.with_name(".c.old"))
    check(out, overwrite=True)


def test_a_folder_of_another_program_is_not_taken_for_an_earlier_run(tmp_path: Path) -> None:
    written(tmp_path / ".c.old", "notes.txt")
    restore_run(tmp_path / "c")
    assert not (tmp_path / "c").exists()
    with pytest.raises(InputError, match="is left of a merge"):
        check(tmp_path / "c")
