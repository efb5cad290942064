"""The `splatbot` command. Each subcommand is one module here, imported only to run it."""

from __future__ import annotations

import importlib
import os
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any, NamedTuple, TextIO

from splatbot.cli.loading import ERASE, imports_shown
from splatbot.cli.messages import interruption, print_message, set_interruption


class _Command(NamedTuple):
    module: str
    function: str
    summary: str


# The summaries are here, not in the modules, because `splatbot --help` must not wait for torch or open3d.
COMMANDS = {
    "map": _Command("splatbot.cli.map", "map_log_command", "Turn an RGB-D log into a Gaussian map and a run folder."),
    "batch": _Command(
        "splatbot.cli.batch", "batch", "Run a command for many logs or options, in parallel or on a Ray cluster."
    ),
    "prepare": _Command(
        "splatbot.cli.prepare", "prepare", "Estimate the poses of photographs or of a video by COLMAP, for `train`."
    ),
    "train": _Command(
        "splatbot.cli.train", "train", "Train a map from posed photographs, or improve the map of a run."
    ),
    "eval": _Command(
        "splatbot.cli.eval", "eval_run", "Score a run or a training again: trajectory error and held-out views."
    ),
    "audit": _Command("splatbot.cli.audit", "audit", "Check a map against measured depth: missed surface, false hits."),
    "merge": _Command("splatbot.cli.merge", "merge", "Merge two runs of one place into one run."),
    "diff": _Command("splatbot.cli.diff", "diff", "List the objects that changed between two runs of one place."),
    "render": _Command("splatbot.cli.render", "render", "Render a view of a map to a PNG."),
    "info": _Command("splatbot.cli.info", "info", "Describe a map, a log or a run."),
    "download": _Command(
        "splatbot.cli.download", "download", "Fetch a public RGB-D recording from its official address."
    ),
    "simulate": _Command("splatbot.cli.simulate", "simulate", "Record a synthetic log with exact depth and poses."),
    "record": _Command("splatbot.cli.record", "record", "Write a log as one MCAP file of ROS 2 messages."),
    "convert-log": _Command(
        "splatbot.cli.convert_log", "convert_log", "Write a log of any format as a TUM folder or an MCAP file."
    ),
    "serve": _Command("splatbot.cli.serve", "serve", "Serve a map over HTTP."),
    "view": _Command("splatbot.cli.view", "view", "Show a map in a web browser, or write it as one HTML page."),
    "plan": _Command(
        "splatbot.cli.plan", "plan", "Plan a path of an arm among the Gaussians of a map, with pictures of it."
    ),
    "grasp": _Command("splatbot.cli.grasp", "grasp", "Find grasps of a named or marked object in a map."),
    "objects": _Command("splatbot.cli.objects", "objects", "List the supports and objects of a map with their sizes."),
    "export": _Command("splatbot.cli.export", "export", "Write a map as mesh, points, distance grid or occupancy."),
    "convert": _Command("splatbot.cli.convert", "convert", "Write a map in another format of Gaussian splats."),
    "compact": _Command("splatbot.cli.compact", "compact", "Write a map of fewer Gaussians that hits all it hit."),
    "tile": _Command(
        "splatbot.cli.tile", "tile", "Write a map as tiles on disk, which are loaded only where a query needs them."
    ),
    "compare": _Command("splatbot.cli.compare", "compare", "Compare two maps as one HTML page with sliders."),
    "demo": _Command("splatbot.cli.demo", "demo", "Record, map, serve and query a synthetic tabletop."),
    "robot": _Command("splatbot.cli.robot", "robot", "Add a robot arm from a URDF, or describe a stored one."),
    "plan-pick": _Command(
        "splatbot.cli.plan_pick", "plan_pick", "Plan a complete pick in a map, and simulate it before the robot moves."
    ),
    "pick": _Command("splatbot.cli.pick", "pick", "Pick a named object in the twin: scan, grasp, plan, lift, check."),
    "trials": _Command("splatbot.cli.trials", "trials", "Pick in many seeded scenes; report success and failures."),
    "gripper": _Command("splatbot.cli.gripper", "gripper", "Query or move a gripper, or a simulated one."),
    "twin": _Command("splatbot.cli.twin", "twin", "Simulate a motion in a scene before the robot moves."),
    "sim2real": _Command(
        "splatbot.cli.sim2real", "sim2real", "Measure the difference of the twin from a log, and from a held-out twin."
    ),
    "doctor": _Command("splatbot.cli.doctor", "doctor", "Check this installation and print how to fix it."),
}

CALIBRATIONS = {
    "sensor": _Command(
        "splatbot.cli.calibrate",
        "calibrate_sensor_command",
        "Estimate readout, delays, registration and bias of an RGB-D sensor from a log.",
    ),
    "intrinsics": _Command(
        "splatbot.cli.calibrate_arm",
        "calibrate_intrinsics_command",
        "Estimate the intrinsics of a camera from views of a ChArUco board.",
    ),
    "hand-eye": _Command(
        "splatbot.cli.calibrate_arm",
        "calibrate_hand_eye_command",
        "Estimate the camera's pose on an arm, joint offsets and the time offset, with a board or without.",
    ),
    "joint-delay": _Command(
        "splatbot.cli.calibrate_delay",
        "calibrate_joint_delay_command",
        "Estimate the delay of joint states from an arm that moves in view of a static camera.",
    ),
}

_GROUPS = {
    "bench": "Measure speed, and accuracy over time; `splatbot bench --help` lists the benchmarks.",
    "calibrate": "Calibrate cameras, sensors and arms; `splatbot calibrate --help` lists the calibrations.",
}

_DESCRIPTION = """RGB-D streams become a map of 3D Gaussians on CPUs, and the map answers queries of a robot.

`splatbot COMMAND --help` explains a command with examples. Every command takes --debug (or SPLATBOT_DEBUG=1),
which adds the traceback to an error. Exit codes: 0 done, 1 failed, 2 wrong input, 130 interrupted."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code. Errors of :mod:`splatbot.errors` become one line on stderr."""
    from splatbot.errors import SplatbotError

    warnings.showwarning = _print_warning
    words = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in words or os.environ.get("SPLATBOT_DEBUG", "") not in ("", "0")
    words = [word for word in words if word != "--debug"]
    set_interruption()
    if words == ["--version"]:
        from splatbot import __version__

        print(__version__)
        return 0
    try:
        with _interrupts_while_libraries_load(), imports_shown():
            return int(_dispatch(words) or 0)
    except SplatbotError as error:
        if debug:
            traceback.print_exc()
        print_message("error", error)
        return error.exit_code
    except KeyboardInterrupt:
        print(interruption(), file=sys.stderr)
        return 130
    except BrokenPipeError:  # `splatbot info ... | head` is no error; Python must not flush to the dead pipe again
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        from splatbot.cli.paths import system_error

        sentence = system_error(error)
        if sentence is None:
            raise
        if debug:
            traceback.print_exc()
        print_message("error", sentence)
        return 1


@contextmanager
def _interrupts_while_libraries_load() -> Iterator[None]:
    """Make Ctrl-C end the process while a module is imported.

    Native modules turn a KeyboardInterrupt of their initialization into an ImportError, or lose it. A command that
    handles SIGINT itself, to keep its work, is not concerned.
    """
    main_thread = threading.current_thread() is threading.main_thread()
    if not main_thread or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, _on_interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _on_interrupt(number: int, frame: FrameType | None) -> None:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            os.write(2, f"{ERASE if os.isatty(2) else ''}{interruption()}\n".encode())
            os._exit(130)
        frame = frame.f_back
    raise KeyboardInterrupt


def _print_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Print warnings about the user's input as one line; those for developers keep their place in the code."""
    place = "" if category.__module__.startswith("splatbot") else f"{filename}:{lineno}: "
    print_message("warning", f"{place}{message}", file)


def _dispatch(words: list[str]) -> Any:
    import tyro

    from splatbot.cli.help import fitted_help, wrapped

    if words and words[0] in COMMANDS:
        return _run(words[0], COMMANDS[words[0]], words[1:])
    group = words[0] if words and words[0] in _GROUPS else ""
    if group == "calibrate" and len(words) > 1 and words[1] in CALIBRATIONS:
        return _run(f"calibrate {words[1]}", CALIBRATIONS[words[1]], words[2:])
    if group and len(words) > 1 and words[1] in _summaries(group):
        from splatbot.cli.bench import run_benchmark

        return run_benchmark(words[1], words[2:])
    # Without a known command, tyro prints the help or names the closest command, and exits.
    args = words[bool(group) :] or ["--help"]
    with fitted_help(args):
        return tyro.extras.subcommand_cli_from_dict(
            {name: _outline(summary) for name, summary in _summaries(group).items()},
            prog=f"splatbot {group}".strip(),
            description=wrapped(_GROUPS.get(group, _DESCRIPTION)),
            args=args,
        )


def _run(name: str, command: _Command, words: list[str]) -> Any:
    from splatbot.cli.help import parsed

    function = getattr(importlib.import_module(command.module), command.function)
    return parsed(function, f"splatbot {name}", words)


def _summaries(group: str) -> dict[str, str]:
    """Return the summary of each command of a group; the group "" is the program."""
    if group == "bench":
        from splatbot.bench.benchmark import BENCHMARKS

        return {name: entry.summary for name, entry in BENCHMARKS.items()}
    if group == "calibrate":
        return {name: command.summary for name, command in CALIBRATIONS.items()}
    return {name: command.summary for name, command in COMMANDS.items()} | _GROUPS


def _outline(summary: str) -> Callable[[], None]:
    def outline() -> None:
        raise AssertionError("only its docstring is used")

    outline.__doc__ = summary
    return outline
