"""`splatbot sim2real`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import tyro


def sim2real(
    log: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")] = None,
    map: Annotated[Path | None, tyro.conf.arg(metavar="RUN")] = None,
    robot: str = "panda",
    frames: Annotated[int, tyro.conf.arg(metavar="N")] = 0,
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    quiet: bool = False,
) -> int:
    """Say how far the twin is from a recorded log.

    Sim-to-real: colour, depth and silhouettes of the twin at the log's recorded camera poses, and the arm's motion done
    again by the twin's arm. The arm's poses are those of the log's ee_poses.txt and ee_T_camera, or of its joints.txt
    and the mount in scene.yaml. Writes sim2real.json and sim2real.html.

    Examples:
        splatbot sim2real /data/arm --map runs/arm
        splatbot sim2real /data/arm --map runs/arm --frames 12 --out runs/arm-twin

    Args:
        log: a recording that was mapped.
        map: the folder of the run that mapped it.
        robot: the twin's arm; one with other joints than the log's stands in by its tool's poses.
        frames: how many to compare, evenly spaced; 0: all.
        out: folder to write to; by default runs/sim2real.
        json: another place for the JSON file.
        quiet: print only errors.
    """
    from splatbot.errors import InputError

    if log is None or map is None:
        raise InputError("are needed, both.", field="LOG, --map", hint="splatbot sim2real LOG --map RUN")
    from splatbot.cli.tables import print_table
    from splatbot.results.folder import RunFolder
    from splatbot.robots.in_view import reopen_log
    from splatbot.robots.store import load_robot
    from splatbot.sim.compare.log_twin import KIND, compare_log
    from splatbot.sim.compare.page import log_html, log_rows

    run = RunFolder(map)
    with _progress(quiet) as tell:
        found = compare_log(reopen_log(run, uri=log), run, load_robot(robot), frames=frames, tell=tell)
    folder = out if out is not None else Path("runs") / "sim2real"
    _write(folder, json, found.to_dict(), log_html(found))
    if not quiet:
        print_table(log_rows(found), title=f"{KIND}: {found.log} against the twin of {found.map}")
        print(f"written to {folder}")
    return 130 if found.interrupted else 0


def _write(folder: Path, json: Path | None, values: dict[str, Any], page: str) -> None:
    import json as text

    from splatbot.atomic import atomic_write

    for path, content in (
        (json if json is not None else folder / "sim2real.json", text.dumps(values, indent=1, allow_nan=False) + "\n"),
        (folder / "sim2real.html", page),
    ):
        with atomic_write(path) as file:
            file.write(content.encode())


@contextmanager
def _progress(quiet: bool) -> Iterator[Callable[[str, float], None]]:
    if quiet or not sys.stderr.isatty():
        yield lambda what, share: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task("", total=1.0)
        yield lambda what, share: bars.update(task, description=what, completed=share)
