"""Every command at a pseudo-terminal: narrow and wide, with and without colour."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from splatbot.cli import COMMANDS
from tests.terminal import Shown, at_a_terminal

pytestmark = pytest.mark.long

LOG = "synthetic:tabletop?frames=10&width=160&height=120"
BASE = ("--base", "0", "0.4", "1", "1", "0", "0", "0")


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with a base."""
    folder = tmp_path_factory.mktemp("terminal") / "run"
    shown = at_a_terminal("map", LOG, "--out", str(folder), columns=80)
    assert shown.code == 0, shown.text
    shown = at_a_terminal("info", str(folder), "--fit-plane", "--up", "0", "-0.7", "-0.7", columns=80)
    assert shown.code == 0, shown.text
    return folder


def _assert_sound(shown: Shown, columns: int, codes: tuple[int, ...] = (0,)) -> None:
    assert shown.code in codes, shown.text[-2000:]
    assert "Traceback" not in shown.text
    assert shown.longest_line() <= columns, shown.text


_WORDS = {
    "eval": ["eval", "{run}"],
    "render": ["render", "{run}", "--out", "{out}/a.png", "--size", "80x60"],
    "info": ["info", "{run}"],
    "info of a log": ["info", LOG],
    "train": ["train", "{run}", "--iterations", "60", "--out", "{out}/trained"],
    "batch": [
        "batch",
        "simulate",
        "tabletop",
        "--with",
        "frames",
        "2",
        "--with",
        "size",
        "80x60",
        "--out",
        "{out}/batch",
    ],
    "simulate": ["simulate", "tabletop", "--frames", "3", "--size", "80x60", "--out", "{out}/log"],
    "simulate --list": ["simulate", "--list"],
    "record": ["record", LOG, "--out", "{out}/a.mcap"],
    "view": ["view", "{run}", "--html", "{out}/a.html"],
    "plan": [
        "plan",
        "--map",
        "{run}",
        "--start",
        "home",
        "--goal",
        "home",
        "--margin",
        "0",
        *BASE,
        "--out",
        "{out}/plan",
    ],
    "grasp": ["grasp", "--map", "{run}", "--target", "largest object", "--hand-only", "--out", "{out}/grasp"],
    "objects": ["objects", "{run}"],
    "merge": ["merge", "{run}", "{again}", "--no-report", "--out", "{out}/merged"],
    "diff": ["diff", "{run}", "{run}", "--out", "{out}/diff.png"],
    "export": ["export", "{run}", "--format", "points", "octomap", "--voxel", "0.05", "--out", "{out}/export"],
    "compact": ["compact", "{run}", "--sweep"],
    "compare": ["compare", "{run}", "{run}/map.ply", "--views", "1", "--out", "{out}/compare.html"],
    "robot list": ["robot", "list"],
    "robot info": ["robot", "info", "panda"],
    "twin --list": ["twin", "--list"],
    "gripper": ["gripper", "status", "--fake"],
    "doctor": ["doctor"],
}


@pytest.mark.parametrize(("name", "columns", "colour"), [(n, c, c == 80) for n in _WORDS for c in (80, 200)])
def test_a_command_fits_the_terminal(run_folder: Path, tmp_path: Path, name: str, columns: int, colour: bool) -> None:
    again = shutil.copytree(run_folder, tmp_path / "again") if name == "merge" else run_folder
    words = [word.format(run=run_folder, again=again, out=tmp_path) for word in _WORDS[name]]
    environment = {} if colour else {"NO_COLOR": "1"}
    shown = at_a_terminal(*words, columns=columns, environment=environment)
    _assert_sound(shown, columns, (0, 1) if name in ("grasp", "plan") else (0,))
    if not colour:
        assert not shown.colours


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_a_command_fits_the_terminal(name: str) -> None:
    shown = at_a_terminal(name, "--help", columns=80)
    assert shown.code == 0
    lines = [line.rstrip() for line in shown.text.splitlines()]
    # examples stay whole, to be copied; tyro does not wrap the usage
    explained = [line for line in lines if not line.startswith(("    ", "usage:"))]
    assert max(map(len, explained)) <= 80, max(explained, key=len)


@pytest.mark.parametrize("name", ["simulate", "record"])
def test_ctrl_c_ends_a_command_that_writes_without_a_traceback(tmp_path: Path, name: str) -> None:
    words = {
        "simulate": ["simulate", "tabletop", "--frames", "20000", "--out", str(tmp_path / "log")],
        "record": ["record", LOG.replace("frames=10", "frames=20000"), "--out", str(tmp_path / "a.mcap")],
    }

    def writes() -> bool:
        return any(path.is_file() and path.stat().st_size > 0 for path in tmp_path.rglob("*"))

    shown = at_a_terminal(*words[name], columns=80, interrupt_when=writes)
    assert shown.code == 130, shown.text
    assert "Traceback" not in shown.text


def test_ctrl_c_ends_an_export_without_a_traceback(run_folder: Path, tmp_path: Path) -> None:
    words = ["export", str(run_folder), "--voxel", "0.004", "--out", str(tmp_path / "export")]
    shown = at_a_terminal(*words, columns=80, interrupt_at="making")
    assert shown.code == 130, shown.text
    assert "Traceback" not in shown.text
