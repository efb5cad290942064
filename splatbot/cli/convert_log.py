"""`splatbot convert-log`."""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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


def convert_log(
    log: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    /,
    *,
    frames: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    camera: Annotated[str | None, tyro.conf.arg(metavar="PRESET|FILE")] = None,
    depth_scale: Annotated[float | None, tyro.conf.arg(metavar="UNITS")] = None,
    quiet: bool = False,
) -> None:
    """Write a log of any format as a folder in TUM layout, or as one MCAP file of ROS 2 messages (a name in .mcap).

    Images are those that splatbot maps: undistorted, with colour at the depth pixels, and reference poses. MCAP rounds
    nothing. A folder holds 16-bit depth and no masks. After Ctrl-C a folder is removed. An MCAP file keeps the frames
    before.

    Examples:
        splatbot convert-log scene0000_00.sens recordings/scene0000_00
        splatbot convert-log desk.r3d desk.mcap --frames 100

    Args:
        log: a log, as for `splatbot map`.
        out: the folder or the .mcap file to write; must not exist.
        frames: write only the first N frames.
        camera: intrinsics instead of the log's own, as for `splatbot map`.
        depth_scale: units per metre of depth in a folder; by default those of the log, or 5000 if these are below
            1000.
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
    if depth_scale is not None and as_mcap:
        raise InputError("is for folders.", field="--depth-scale", hint="leave it out: MCAP holds depth in metres")

    from splatbot.logs import open_log
    from splatbot.logs.base import FirstFrames

    whole = open_log(log, camera=camera)
    source = FirstFrames(whole, len(whole) if frames is None else frames)
    with shares(quiet) as show:
        _write(source, out, depth_scale, lambda done: show("writing", done / len(source)))
    if not quiet:
        print(f"{out}: {len(source)} frames")


def _write(source: Log, out: Path, depth_scale: float | None, progress: Callable[[int], None]) -> None:
    from splatbot.logs.base import MILLIMETRES

    if out.suffix.lower() == _MCAP:
        from splatbot.logs.mcap import record_mcap

        record_mcap(source, out, progress=progress)
    else:
        own = source.calibration.depth_scale
        _write_folder(source, out, depth_scale or (own if own >= MILLIMETRES else _FINE), progress)


def _write_folder(source: Log, out: Path, depth_scale: float, progress: Callable[[int], None]) -> None:
    """Write a TUM folder, which appears under its name when it is whole."""
    from splatbot.atomic import replace
    from splatbot.logs.record import record

    masked = 0

    def images() -> Iterator[Frame]:
        nonlocal masked
        for frame in source:
            masked += frame.mask is not None
            yield frame

    draft = out.with_name(f".{out.name}.{secrets.token_hex(4)}.draft")
    try:
        record(images(), draft, ground_truth=source.ground_truth, depth_scale=depth_scale, progress=progress)
        replace(draft, out)
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    if masked:
        print_message("warning", f"the masks of {masked} frames are not written; an .mcap file holds them")
    if source.calibration.sensor:
        print_message("warning", "the calibration of the sensor is not written; give it by --camera FILE")
    if source.effects:
        print_message("warning", "the account of simulated effects is not written")
