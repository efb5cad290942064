"""`splatbot record`: a camera or a log as one MCAP file."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import tyro

from splatbot.cli.cameras import is_live, open_recorded, refuse_with_camera
from splatbot.cli.paths import check_camera, check_output
from splatbot.cli.progress import steps
from splatbot.errors import InputError
from splatbot.layouts import log_kind


def record(
    log: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="CAMERA|LOG")],
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")],
    camera: Annotated[str | None, tyro.conf.arg(metavar="PRESET|FILE")] = None,
    seconds: Annotated[float | None, tyro.conf.arg(metavar="S")] = None,
    max_frames: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    quiet: bool = False,
) -> None:
    """Write the frames of a camera, or a log, as one MCAP file of ROS 2 messages.

    Foxglove, ROS tools and splatbot itself read it. Nothing is rounded: mapping the file gives the trajectory that
    mapping the log gives. A camera is recorded until Ctrl-C, --seconds or --max-frames. `splatbot convert-log` also
    writes TUM folders.

    Examples:
        splatbot record oak:// --out desk.mcap
        splatbot record "realsense://?size=848x480&fps=30" --out desk.mcap --seconds 60
        splatbot record cameras.yaml --out cell.mcap
        splatbot record recordings/desk --out desk.mcap
        splatbot map desk.mcap

    Args:
        log: a camera (oak://, realsense:// or replay:LOG, docs/guide/cameras.md), a .yaml file of several cameras
            (docs/guide/several-cameras.md), or a log, as for `splatbot map`.
        out: the file to write; must not exist. Several cameras have a file each, and FILE.yaml lists them.
        camera: intrinsics instead of the log's own, as for `splatbot map`.
        seconds: with a camera, end after this time.
        max_frames: with a camera, end after this number of frames.
        quiet: no progress and no summary, only errors.
    """
    device = is_live(log)
    if device:
        refuse_with_camera({"--camera": camera})
    else:
        log_kind(log)
        check_camera(camera)
        if seconds is not None or max_frames is not None:
            raise InputError("is for cameras.", field="--seconds, --max-frames", hint="leave it out")
    check_output(out, folder=False)
    if out.exists():
        raise InputError("exists already.", file=out, field="--out", hint="choose another name")

    if device:
        place, text = _record_camera(log, out, seconds, max_frames, quiet)
    else:
        from splatbot.logs import open_log
        from splatbot.logs.mcap import record_mcap

        source = open_log(log, camera=camera)
        record_mcap(source, out)
        place, text = str(out), f"{len(source)} frames, {out.stat().st_size / 1e6:.1f} MB"
    if not quiet:
        print(f"{place}: {text}")


def _record_camera(uri: str, out: Path, seconds: float | None, max_frames: int | None, quiet: bool) -> tuple[str, str]:
    """Record a camera until it ends or Ctrl-C; return place and description of the recording."""
    from splatbot.logs.live import further_file
    from splatbot.run.interrupts import Interrupts

    recorded = open_recorded(uri, out, max_frames=max_frames, seconds=seconds)
    begun = time.monotonic()
    with Interrupts() as interrupts, steps(quiet) as show:
        interrupts.when_requested = recorded.end  # Ctrl-C is the normal end
        for number, _ in recorded.arrivals():
            elapsed = time.monotonic() - begun
            show(f"recording: frame {number + 1}, {number / max(elapsed, 0.1):.1f} frames/s; Ctrl-C ends it")
    lost = f", {recorded.missed} lost by the camera" if recorded.missed else ""
    size = sum(further_file(out, name).stat().st_size for name in ("", *recorded.cameras))
    return recorded.uri, f"{len(recorded)} frames in {time.monotonic() - begun:.1f} s{lost}, {size / 1e6:.1f} MB"
