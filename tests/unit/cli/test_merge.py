"""`splatbot merge` and `splatbot diff`: wrong words are refused before any work; Ctrl-C leaves no half run."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from plyfile import PlyData

from splatbot.cli.merge import pose_rows
from splatbot.config import Config
from splatbot.logs import open_log, record
from splatbot.mapping.alignment import MapAlignment
from splatbot.run import map_log
from tests.terminal import at_a_terminal
from tests.unit.cli.conftest import RunCommand, assert_fix_named, assert_refused

HEAVY = ("torch", "open3d", "cv2", "matplotlib", "numpy")
QUICK = Config.model_validate({"mapping": {"refine_iterations": 2, "final_iterations": 3}})


@pytest.fixture
def two_states(work_folder: Path) -> Path:
    """The current folder with the names of two runs."""
    for name in ("a", "b"):
        (work_folder / name / "state").mkdir(parents=True)
        for file in ("map.ply", "state/run.state"):
            (work_folder / name / file).touch()
    return work_folder


@pytest.mark.parametrize(
    ("words", "mistake"),
    [
        (["merge", "a", "a", "--out", "c"], "A and B are one run"),
        (["merge", "a", "b", "--out", "b", "--overwrite"], "one of the merged runs"),
        (["merge", "a", "b", "--out", "held"], "holds a run already (recordings.yaml)"),
        (["merge", "a", "b/map.ply", "--out", "c"], "is a map file. Fix: give its run folder"),
        (["diff", "a", "b/map.ply"], "is a map file. Fix: give its run folder"),
        (["diff", "a", "b", "--out", "d.xyz"], "is no PNG picture"),
    ],
)
def test_wrong_words_are_refused_before_libraries_load(two_states: Path, words: list[str], mistake: str) -> None:
    (two_states / "held").mkdir()
    (two_states / "held" / "recordings.yaml").touch()
    before = sorted(two_states.rglob("*"))
    program = (
        f"import sys\nfrom splatbot.cli import main\nprint(main({words!r}), [m for m in {HEAVY!r} if m in sys.modules])"
    )
    answer = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120)
    assert answer.stdout == "2 []\n"
    assert mistake in answer.stderr
    assert sorted(two_states.rglob("*")) == before


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc, which takes no files, not even of root")
@pytest.mark.parametrize("words", [["merge", "a", "b", "--out", "/proc/c"], ["diff", "a", "b", "--out", "/proc/c.png"]])
def test_a_folder_that_takes_no_files_is_refused_before_the_states_are_read(
    run: RunCommand, two_states: Path, words: list[str]
) -> None:
    assert_refused(run(*words), words[-1])  # the states are empty files, which would be refused first


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """Two runs of a simulated table top, on one path."""
    folder = tmp_path_factory.mktemp("runs")
    log = open_log("synthetic:tabletop?frames=12&rate=6&width=160&height=120")
    for name in ("a", "b"):
        map_log(log, out=folder / name, config=QUICK, save_every=1e9, report=False)
    return str(folder / "a"), str(folder / "b")


def test_an_interrupted_merge_leaves_no_folder_and_the_same_command_then_succeeds(
    run: RunCommand, runs: tuple[str, str], work_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[str] = []

    def interrupted(*_: object, out: Path, **__: object) -> None:
        written.extend(path.name for path in out.iterdir())
        raise KeyboardInterrupt

    words = ("merge", *runs, "--out", "c", "--no-report", "--quiet")
    with monkeypatch.context() as patched:
        patched.setattr("splatbot.run.merging.map_log", interrupted)
        answer = run(*words)
    assert answer.code == 130
    assert sorted(written) == ["recordings.yaml", "state"]
    assert not Path("c").exists()
    assert run(*words).code == 0
    assert_fix_named(run(*words), "--overwrite")
    assert run(*words, "--overwrite").code == 0


def test_the_printed_gaussians_of_a_merge_add_up(run: RunCommand, runs: tuple[str, str], work_folder: Path) -> None:
    answer = run("merge", *runs, "--out", "c", "--no-report")
    assert answer.code == 0, answer.err
    found = re.search(r"([\d,]+): ([\d,]+) kept, ([\d,]+) added, ([\d,]+) (more|fewer) by the refinement", answer.out)
    assert found is not None, answer.out
    total, kept, added, change = (int(number.replace(",", "")) for number in found.groups()[:4])
    assert total == kept + added + (change if found[5] == "more" else -change)
    assert total == PlyData.read("c/map.ply")["vertex"].count


@pytest.mark.parametrize("failure", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_a_merge_that_ends_early_leaves_the_earlier_run_whole_and_a_later_one_replaces_it(
    run: RunCommand,
    runs: tuple[str, str],
    work_folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    failure: type[BaseException] | Exception,
) -> None:
    shutil.copytree(runs[0], "c")
    for name in ("scene.yaml", "audit.json", "trajectory-left.tum"):
        Path("c", name).write_text("earlier")
    before = _files("c")
    words = ("merge", *runs, "--out", "c", "--no-report", "--quiet", "--overwrite")
    with monkeypatch.context() as patched:
        patched.setattr("splatbot.run.merging.map_log", Mock(side_effect=failure))
        assert run(*words).code in (1, 130)
    assert _files("c") == before
    assert [path.name for path in Path().iterdir()] == ["c"]
    Path(".c.draft").mkdir()
    Path(".c.draft", "map.ply").write_text("of a merge that was killed")
    assert run(*words).code == 0
    assert [path.name for path in Path().iterdir()] == ["c"]
    after = {path.name for path in Path("c").iterdir()}
    assert "scene.yaml" in after
    assert {"recordings.yaml", "merge.json", "map.ply", "state"} <= after
    assert not {"audit.json", "trajectory-left.tum"} & after
    assert all("draft" not in file.read_text() for file in Path("c").glob("*.json"))
    assert json.loads(Path("c/metrics.json").read_text())["log"]["uri"] == str(Path("c/recordings.yaml").resolve())
    assert run("info", "c").code == run("diff", runs[0], "c", "--out", "d.png").code == 0


def test_runs_of_logs_with_relative_paths_merge_in_another_folder(
    run: RunCommand, work_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = open_log("synthetic:tabletop?frames=12&rate=6&width=160&height=120")
    record(log, work_folder / "log")
    for name, address in (("a", "log"), ("b", "log?pair_within=0.05")):
        map_log(open_log(address), out=name, config=QUICK, save_every=1e9, report=False)
    (work_folder / "elsewhere").mkdir()
    monkeypatch.chdir(work_folder / "elsewhere")
    answer = run("merge", "../a", "../b", "--out", "c", "--no-report", "--quiet")
    assert answer.code == 0, answer.err
    recordings = Path("c/recordings.yaml").read_text().splitlines()
    assert f"- log: {work_folder / 'log'}" in recordings
    assert f"- log: {work_folder / 'log'}?pair_within=0.05" in recordings


def _files(folder: str | Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()}


def test_ctrl_c_at_a_terminal_before_the_merge_writes_keeps_the_run_that_it_would_replace(
    runs: tuple[str, str], work_folder: Path
) -> None:
    shutil.copytree(runs[0], "c")
    before = [_files(run) for run in (*runs, "c")]
    words = ("merge", *runs, "--out", "c", "--no-report", "--overwrite")
    shown = at_a_terminal(*words, columns=80, interrupt_at="locating B in A", cwd=work_folder)
    assert shown.code == 130, shown.text
    assert "Traceback" not in shown.text
    assert [_files(run) for run in (*runs, "c")] == before
    assert [path.name for path in Path().iterdir()] == ["c"]


def test_ctrl_c_at_a_terminal_while_the_merged_map_is_refined_keeps_both_runs_and_saves_a_whole_one(
    run: RunCommand, runs: tuple[str, str], work_folder: Path
) -> None:
    before = [_files(each) for each in runs]
    shown = at_a_terminal("merge", *runs, "--out", "c", "--no-report", columns=80, interrupt_at="refining")
    assert shown.code == 130, shown.text
    assert "Traceback" not in shown.text
    assert [_files(each) for each in runs] == before
    assert json.loads(Path("c/metrics.json").read_text())["interrupted"]
    assert len(Path("c/trajectory.tum").read_text().splitlines()) >= 24  # of both runs
    assert run("info", "c").code == 0


def test_ctrl_c_at_a_terminal_while_the_merged_map_is_refined_keeps_the_run_that_it_would_replace(
    runs: tuple[str, str], work_folder: Path
) -> None:
    shutil.copytree(runs[0], "c")
    before = _files("c")
    words = ("merge", *runs, "--out", "c", "--no-report", "--overwrite")
    shown = at_a_terminal(*words, columns=80, interrupt_at="refining", cwd=work_folder)
    assert shown.code == 130, shown.text
    assert "c keeps its earlier run" in shown.text
    assert _files("c") == before
    assert [path.name for path in Path().iterdir()] == ["c"]


def test_the_json_of_aligned_runs_has_the_identity_and_the_picture(
    run: RunCommand, runs: tuple[str, str], work_folder: Path
) -> None:
    answer = run("diff", *runs, "--aligned", "--json", "--out", "d.png")
    found = json.loads(answer.out)
    assert found["T_a_b"]["translation_m"] == [0, 0, 0]
    assert found["T_a_b"]["quaternion_wxyz"] == [1, 0, 0, 0]
    assert Path(found["picture"]).read_bytes().startswith(b"\x89PNG")


def test_a_pose_has_no_negative_zeros() -> None:
    T = np.eye(4)
    T[:3, 3] = -1e-7
    rows = dict(pose_rows(MapAlignment(T, np.eye(6), {}, tried=3, found=3)))
    assert rows["translation of B [m]"] == "0.0000 0.0000 0.0000"
