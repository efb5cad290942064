"""`splatbot convert-log`."""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from splatbot.cli.messages import print_message
from splatbot.cli.paths import check_camera, check_output
from splatbot.cli.progress import shares
from splatbot.errors import InputError
from splatbot.layouts import log_kind

if TYPE_CHECKING:
    from splatbot.frame import Frame
    from splatbot.logs import Log

_FINE = 5000.0  # [units/m] of logs whose own unit is coarser than a millimetre, as metres are
_MCAP = ".mcap"

Layout = Literal["tum", "lerobot"]


def convert_log(
    log: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    /,
    *,
    frames: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    first_frame: Annotated[int, tyro.conf.arg(metavar="N")] = 0,
    camera: Annotated[str | None, tyro.conf.arg(metavar="PRESET|FILE")] = None,
    depth_scale: Annotated[float | None, tyro.conf.arg(metavar="UNITS")] = None,
    layout: Layout = "tum",
    quiet: bool = False,
) -> None:
    """Write a log of any format as a folder, or as one MCAP file of ROS 2 messages (a name in .mcap).

    Images are those that splatbot maps: undistorted, with colour at the depth pixels, and reference poses. MCAP rounds
    nothing. A TUM folder holds 16-bit depth, a LeRobot dataset of version 3 depth that is not rounded; neither holds
    masks. After Ctrl-C a folder is removed. An MCAP file keeps the frames before.

    Examples:
        splatbot convert-log scene0000_00.sens recordings/scene0000_00
        splatbot convert-log desk.r3d desk.mcap --frames 100
        splatbot convert-log desk.mcap desk_lerobot --layout lerobot

    Args:
        log: a log, as for `splatbot map`.
        out: the folder or the .mcap file to write; must not exist.
        frames: write at most N frames.
        first_frame: number of the first frame to write; frames count from 0.
        camera: intrinsics instead of the log's own, as for `splatbot map`.
        depth_scale: units per metre of depth in a TUM folder; by default those of the log, or 5000 if these are below
            1000.
        layout: layout of a folder: tum, or lerobot (needs the extra `lerobot`).
        quiet: no progress, no summary, only errors.
    """
    log_kind(log)
    check_camera(camera)
    as_mcap = out.suffix.lower() == _MCAP
    check_output(out, "OUT", folder=not as_mcap)
    if out.exists():
        raise InputError("exists already.", file=out, field="OUT", hint="choose another name")
    if frames is not None and frames < 1:
        raise InputError(f"is {frames}.", field="--frames", hint="give at least 1")
    if depth_scale is not None and not 0 < depth_scale < 1e9:
        raise InputError(f"is {depth_scale:g}.", field="--depth-scale", hint="give units per metre, such as 1000")
    if depth_scale is not None and (as_mcap or layout == "lerobot"):
        raise InputError("is for TUM folders.", field="--depth-scale", hint="leave it out: depth is written in metres")
    if layout == "lerobot":
        if as_mcap:
            raise InputError("is for folders.", field="--layout", hint="name a folder, not an .mcap file")
        from splatbot.logs.lerobot_packages import require_lerobot

        require_lerobot(out)

    from splatbot.logs import open_log
    from splatbot.logs.base import LogPart

    whole = open_log(log, camera=camera)
    if whole.cameras:
        hint = "convert the recording of each camera, and name the new ones in a file of your own"
        raise InputError("lists several cameras.", file=log, field="LOG", hint=hint)
    source = LogPart(whole, first_frame, frames)
    with shares(quiet) as show:
        _write(source, out, layout, depth_scale, lambda done: show("writing", done / len(source)))
    if not quiet:
        print(f"{out}: {len(source)} frames")


def _write(source: Log, out: Path, layout: Layout, depth_scale: float | None, progress: Callable[[int], None]) -> None:
    if out.suffix.lower() == _MCAP:
        from splatbot.logs.mcap import record_mcap

        record_mcap(source, out, progress=progress)
        return
    if layout == "lerobot":
        from splatbot.logs.lerobot_record import record_lerobot

        with _whole(out) as draft:
            record_lerobot(source, draft, progress=progress)
    else:
        _write_tum(source, out, depth_scale, progress)
    if source.effects:
        print_message("warning", "the account of simulated effects is not written")


@contextmanager
def _whole(out: Path) -> Iterator[Path]:
    """Give the name of a folder, which becomes ``out`` when the block ends; after an error it is removed."""
    from splatbot.atomic import replace

    draft = out.with_name(f".{out.name}.{secrets.token_hex(4)}.draft")
    try:
        yield draft
        replace(draft, out)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _write_tum(source: Log, out: Path, depth_scale: float | None, progress: Callable[[int], None]) -> None:
    from splatbot.logs.base import MILLIMETRES
    from splatbot.logs.record import record

    own = source.calibration.depth_scale
    scale = depth_scale or (own if own >= MILLIMETRES else _FINE)
    masked = 0

    def images() -> Iterator[Frame]:
        nonlocal masked
        for frame in source:
            masked += frame.mask is not None
            yield frame

    with _whole(out) as draft:
        sensor = source.calibration.sensor
        record(images(), draft, ground_truth=source.ground_truth, depth_scale=scale, sensor=sensor, progress=progress)
    if masked:
        print_message("warning", f"the masks of {masked} frames are not written; an .mcap file holds them")
