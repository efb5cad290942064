"""`splatbot simulate`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from splatbot.cli.loading import without_line
from splatbot.cli.paths import check_output
from splatbot.errors import InputError

if TYPE_CHECKING:
    from splatbot.logs.synthetic import SyntheticLog, SyntheticOptions

_PLAIN_EVERY_S = 2.0


def simulate(
    scene: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")] = "",
    /,
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    trajectory: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None,
    frames: Annotated[int, tyro.conf.arg(metavar="N")] = 120,
    size: Annotated[str, tyro.conf.arg(metavar="WxH")] = "640x480",
    fps: Annotated[float, tyro.conf.arg(metavar="HZ")] = 30.0,
    arc: Annotated[float, tyro.conf.arg(metavar="DEG")] = 40.0,
    event: Annotated[float, tyro.conf.arg(metavar="S")] = 2.0,
    effects: Annotated[
        tuple[str, ...], tyro.conf.arg(name="effect", metavar="NAME[:KEY=VALUE,...]"), tyro.conf.UseAppendAction
    ] = (),
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0,
    list_: Annotated[bool, tyro.conf.arg(name="list")] = False,
    quiet: bool = False,
) -> int:
    """Record a synthetic log whose depth and poses are known exactly.

    Writes a TUM-layout folder: rgb/, depth/, rgb.txt, depth.txt, groundtruth.txt, intrinsics.json, effects.json (the
    effects on the frames, with reasons) and objects/NAME.tum (trajectories of objects). `splatbot map` takes the
    folder, or, without any file, the URI that is printed at the end.

    Examples:
        splatbot simulate --list
        splatbot simulate tabletop --out recordings/tabletop
        splatbot simulate room --trajectory handheld --frames 300 --effect motion_blur --effect depth_noise --out r
        splatbot simulate tabletop --effect exposure:step=2,at=40 --effect depth_holes:share=0.4 --out hard
        splatbot simulate tabletop_crossing --event 1.5 --frames 150 --size 320x240 --out crossing

    Args:
        scene: the scene; --list names all scenes.
        out: folder to write; must hold no recording.
        trajectory: trajectory of the camera; by default that of the scene.
        frames: number of frames of the sensor (frame_drops removes some of them).
        size: size of the images [px].
        fps: frames per second.
        arc: angle over which the trajectory `orbit` swings [degrees].
        event: time at which an object moves or is removed, in scenes with such an event [s].
        effects: effect on the frames; repeat it for several, in this order. By default no effects.
        seed: seed of all random numbers; the same seed gives the same bits.
        list_: print the scenes, trajectories and effects and leave.
        quiet: no progress, no summary, only errors.
    """
    if list_:
        _print_lists()
        return 0
    if not scene:
        raise InputError("is missing.", field="SCENE", hint="name one, as in: splatbot simulate tabletop --out DIR")
    if out is None:
        raise InputError("is missing.", field="--out", hint="name the folder to write: --out DIR")
    width, height = _parse_size(size)
    check_output(out)
    if (out / "rgb.txt").exists():
        raise InputError("holds a recording already.", file=out, field="--out", hint="choose another folder")

    from splatbot.logs.synthetic import SyntheticLog, SyntheticOptions, synthetic_uri

    wanted = SyntheticOptions(trajectory or "", frames, width, height, fps, arc, event, seed, ";".join(effects))
    log = SyntheticLog(synthetic_uri(scene, wanted))
    _record(log, out, quiet=quiet)
    if not quiet:
        _print_summary(log, out, wanted)
    return 0


def _parse_size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise InputError(f"is {text!r}.", field="--size", hint="write WIDTHxHEIGHT, as in 640x480")
    return int(width), int(height)


def _record(log: SyntheticLog, out: Path, *, quiet: bool) -> None:
    from splatbot.formats.trajectory import save_trajectory
    from splatbot.logs.effects import write_account
    from splatbot.logs.record import record

    def account() -> None:
        write_account(out, uri=log.uri, effects=log.effects, blanks_depth=log.blanks_depth)

    account()  # before the first frame, so that an interrupted recording is also marked as synthetic
    try:
        with _progress(len(log), quiet=quiet) as show:
            record(log, out, ground_truth=log.ground_truth, progress=show)
    finally:
        account()
    for name, path in log.objects().items():
        save_trajectory(path, out / "objects" / f"{name}.tum", pose_name="T_world_object")


@contextmanager
def _progress(total: int, *, quiet: bool) -> Iterator[Callable[[int], None]]:
    """Yield a callback for the number of finished frames: a bar on a terminal, else a line every two seconds."""
    if quiet:
        yield lambda done: None
    elif sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import BarColumn as Bar
        from rich.progress import MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("[bold]recording"), Bar(bar_width=24), MofNCompleteColumn(), TimeRemainingColumn())
        with without_line(), Progress(*columns, console=Console(stderr=True), transient=True) as bars:
            task = bars.add_task("", total=total)
            yield lambda done: bars.update(task, completed=done)
    else:
        yield _plain_lines(total)


def _plain_lines(total: int) -> Callable[[int], None]:
    start = due = time.monotonic()

    def show(done: int) -> None:
        nonlocal due
        now = time.monotonic()
        if now >= due or done == total:
            due = now + _PLAIN_EVERY_S
            rate = done / (now - start) if now > start else 0.0
            print(f"frame {done}/{total}  {rate:.1f} fps", file=sys.stderr, flush=True)

    return show


def _print_summary(log: SyntheticLog, out: Path, wanted: SyntheticOptions) -> None:
    from splatbot.cli.tables import print_table
    from splatbot.results.units import milliseconds

    rows = [
        ("frames", f"{len(log)} of {wanted.frames}" if len(log) < wanted.frames else str(len(log))),
        *((f"effect {e['name']}", f"{e['why']}, {milliseconds(e['ms_per_frame'])} per frame") for e in log.effects),
        ("log", str(out)),
        ("without a file", f'splatbot map "{log.uri}"'),
    ]
    print_table(rows, title=f"{log.name}: recorded")


def _print_lists() -> None:
    from splatbot.cli.tables import print_table
    from splatbot.logs.scenes import SCENES
    from splatbot.logs.trajectories import TRAJECTORIES
    from splatbot.sim.effects.base import settings
    from splatbot.sim.effects.registry import EFFECTS, effect_class

    print_table(
        [(name, f"{kind.about}; by default {kind.trajectory}") for name, kind in SCENES.items()], title="scenes"
    )
    print_table([(name, _first_line(path)) for name, path in TRAJECTORIES.items()], title="trajectories")
    kinds = [effect_class(name) for name in EFFECTS]
    print_table(
        [
            (name, f"{_first_line(kind)} " + " ".join(f"{key}={value}" for key, value in settings(kind).items()))
            for name, kind in zip(EFFECTS, kinds, strict=True)
        ],
        title="effects and their options",
    )


def _first_line(documented: object) -> str:
    return (documented.__doc__ or "").strip().splitlines()[0]
