"""The entry point: light, helpful, and errors as one line with the right exit code."""

from __future__ import annotations

import importlib
import inspect
import re
import shlex
import signal
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

import splatbot
from splatbot.bench.benchmark import BENCHMARKS, Settings, load_benchmark
from splatbot.cli import CALIBRATIONS, COMMANDS
from splatbot.errors import LogError, MapNotFoundError, SplatbotError
from tests.unit.cli.conftest import RunCommand

HEAVY = ("torch", "open3d", "cv2", "matplotlib", "mujoco", "fastapi", "numpy")


@pytest.mark.parametrize(
    "words",
    [
        ["--help"],
        ["--version"],
        ["map", "--help"],
        ["render", "--help"],
        ["simulate", "--help"],
        ["doctor", "-h"],
        ["bench", "raster", "--help"],
    ],
)
def test_help_imports_nothing_heavy(words: list[str]) -> None:
    program = (
        "import sys\nfrom splatbot.cli import main\n"
        f"try:\n    main({words!r})\nexcept SystemExit:\n    pass\n"
        f"print('HEAVY', [m for m in {HEAVY!r} if m in sys.modules])"
    )
    answer = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120)
    assert answer.stdout.splitlines()[-1] == "HEAVY []"


_ROBOT_WORDS = {
    "there is no robot 'pnda'": [
        ["objects", "{map}", "--robot", "pnda"],
        ["grasp", "--map", "{map}", "--target", "cup", "--robot", "pnda"],
        ["plan", "--map", "{map}", "--start", "home", "--goal", "home", "--robot", "pnda"],
        ["twin", "--map", "{map}", "--robot", "pnda"],
        ["view", "{map}", "--robot", "pnda"],
        ["serve", "--map", "{map}", "--robot", "pnda"],
        ["map", "synthetic:tabletop", "--robot", "pnda"],
        ["calibrate", "joint-delay", "synthetic:tabletop", "--robot", "pnda"],
        ["calibrate", "hand-eye", "{map}", "--robot", "pnda"],
        ["robot", "mjcf", "pnda"],
    ],
    "ur5e has 6 joints": [["plan", "--map", "{map}", "--start", "home", "--goal", "1", "2", "3", "--robot", "ur5e"]],
    "--start: is 1 high": [["plan", "--map", "{map}", "--start", "1", "high", "--goal", "home"]],
    "gripper: is '3f'": [["robot", "add", "ur5e", "--gripper", "3f"]],
}


@pytest.mark.parametrize(("problem", "words"), [(p, each) for p, lists in _ROBOT_WORDS.items() for each in lists])
def test_a_wrong_robot_joint_count_or_gripper_is_named_before_libraries_load(
    tmp_path: Path, problem: str, words: list[str]
) -> None:
    (tmp_path / "map.ply").touch()
    program = (
        "import sys\nfrom splatbot.cli import main\n"
        f"code = main({[word.format(map=tmp_path / 'map.ply') for word in words]!r})\n"
        "print('HEAVY', [m for m in ('torch', 'open3d', 'cv2', 'mujoco', 'fastapi', 'scipy') if m in sys.modules])\n"
        "sys.exit(code)"
    )
    answer = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=120)
    assert answer.returncode == 2
    assert problem in answer.stderr
    assert answer.stdout.splitlines()[-1] == "HEAVY []"


def test_the_help_lists_every_command(run: RunCommand) -> None:
    for group, members in (((), COMMANDS), (("bench",), BENCHMARKS)):
        answer = run(*group, "--help")
        assert answer.code == 0
        for name, member in members.items():
            assert name in answer.out
            assert member.summary.split()[0] in answer.out


_EVERY_HELP = [
    *([name] for name in COMMANDS),
    *(["calibrate", name] for name in CALIBRATIONS),
    *(["bench", name] for name in BENCHMARKS),
    [],
    ["calibrate"],
    ["bench"],
]


@pytest.mark.parametrize("words", _EVERY_HELP, ids=" ".join)
def test_no_help_exceeds_80_columns_or_prints_a_default_of_python(
    run: RunCommand, monkeypatch: pytest.MonkeyPatch, words: list[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    answer = run(*words, "--help")
    assert answer.code == 0
    assert "000000.0" not in answer.out  # as 1e9
    lines = answer.out.splitlines()
    assert [line for line in lines if len(line) > 80 and " " in line.strip()] == []
    assert not re.search(r"default: (True|False|None)", " ".join(line.strip("│ ") for line in lines))
    assert not any(re.fullmatch(r"│\s+│", line) for line in lines)


def test_an_example_that_is_wider_than_the_terminal_can_still_be_copied(
    run: RunCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    example = "splatbot plan --map runs/latest --robot ur5e-2f85 --start home --grasp runs/grasp/grasp.json"
    assert example in (inspect.getdoc(importlib.import_module("splatbot.cli.plan").plan) or "")
    monkeypatch.setenv("COLUMNS", "80")
    joined = run("plan", "--help").out.replace("\\\n", "")  # as a shell joins them
    assert shlex.split(example) in [shlex.split(line) for line in joined.splitlines() if "splatbot plan --map" in line]


def test_the_help_names_flags_that_turn_a_default_off(run: RunCommand, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    line = next(line for line in run("plan", "--help").out.splitlines() if "--no-support" in line)
    assert "--support " not in line
    assert "this option turns it off" in run("plan", "--help").out


def test_no_words_at_all_show_the_help(run: RunCommand) -> None:
    answer = run()
    assert answer.code == 0
    assert "subcommands" in answer.out


@pytest.mark.parametrize("name", [name for name in COMMANDS if name not in ("serve", "demo")])
def test_every_command_shows_examples_and_explains_every_option(run: RunCommand, name: str) -> None:
    answer = run(*name.split(), "--help")
    assert answer.code == 0
    assert f"splatbot {name}" in answer.out.split("Examples:")[1]
    command = COMMANDS[name]
    function = getattr(importlib.import_module(command.module), command.function)
    documented = (inspect.getdoc(function) or "").partition("Args:")[2]
    for parameter in inspect.signature(function).parameters:
        assert f"{parameter}:" in documented


@pytest.mark.parametrize("name", BENCHMARKS)
def test_every_benchmark_shows_examples_and_explains_every_option(run: RunCommand, name: str) -> None:
    answer = run("bench", name, "--help")
    assert answer.code == 0
    assert f"splatbot bench {name}" in answer.out.split("Examples:")[1]
    settings = load_benchmark(name).settings
    assert settings.name == name
    documented = "".join((inspect.getdoc(part) or "").partition("Args:")[2] for part in (settings, Settings))
    for field in fields(settings):
        assert f"{field.name}:" in documented


def test_an_unknown_command_is_wrong_input_and_the_known_ones_are_named(run: RunCommand) -> None:
    answer = run("mpa")
    assert answer.code == 2
    assert "map" in answer.err


def test_the_version_is_that_of_the_package(run: RunCommand) -> None:
    assert run("--version").out.strip() == splatbot.__version__


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (LogError("is cut off.", file="a.png", field="image", hint="copy it again"), 2),
        (MapNotFoundError("is unknown.", field="map"), 2),
        (SplatbotError("went wrong."), 1),
    ],
)
def test_an_error_is_one_line_with_its_exit_code(
    run: RunCommand, monkeypatch: pytest.MonkeyPatch, error: SplatbotError, code: int
) -> None:
    fail_with(monkeypatch, error)
    answer = run("doctor")
    assert (answer.code, answer.err) == (code, f"error: {error}\n")


@pytest.mark.parametrize("how", ["flag", "environment"])
def test_debug_adds_the_traceback(run: RunCommand, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    fail_with(monkeypatch, LogError("is cut off."))
    if how == "environment":
        monkeypatch.setenv("SPLATBOT_DEBUG", "1")
    answer = run("doctor", *(["--debug"] if how == "flag" else []))
    assert answer.code == 2
    assert "Traceback" in answer.err
    assert "error: is cut off." in answer.err


def test_an_unexpected_exception_keeps_its_traceback(run: RunCommand, monkeypatch: pytest.MonkeyPatch) -> None:
    fail_with(monkeypatch, ZeroDivisionError("a bug"))
    with pytest.raises(ZeroDivisionError):  # Python prints it and exits with 1
        run("doctor")


def test_ctrl_c_exits_with_130(run: RunCommand, monkeypatch: pytest.MonkeyPatch) -> None:
    fail_with(monkeypatch, KeyboardInterrupt())
    assert run("doctor").code == 130


def fail_with(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    def broken() -> Any:
        raise error

    monkeypatch.setattr("splatbot.cli.checks.all_checks", broken)


def test_ctrl_c_while_a_library_loads_ends_the_program_whatever_the_library_does_with_it(tmp_path: Path) -> None:
    (tmp_path / "native_like.py").write_text(
        "import time\nprint('loading', flush=True)\n"
        "try:\n    time.sleep(60)\nexcept BaseException:\n    raise ImportError('initialization failed')\n"
    )
    program = (
        "import splatbot.cli as cli\n"
        "cli.COMMANDS['info'] = cli._Command('native_like', 'info', '')\n"
        "raise SystemExit(cli.main(['info']))"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "loading\n"
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=30)
    assert (process.returncode, err) == (130, "interrupted\n")
