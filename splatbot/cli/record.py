"""`splatbot record`: a log as one MCAP file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from splatbot.cli.paths import check_camera, check_output
from splatbot.errors import InputError
from splatbot.layouts import log_kind


def record(
    log: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")],
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")],
    camera: Annotated[str | None, tyro.conf.arg(metavar="PRESET|FILE")] = None,
) -> None:
    """Write a log as one MCAP file of ROS 2 messages, which Foxglove, ROS tools and splatbot itself read.

    Nothing is rounded: mapping the file gives the trajectory that mapping the log gives. `splatbot convert-log` also
    writes TUM folders.

    Examples:
        splatbot record recordings/desk --out desk.mcap
        splatbot map desk.mcap

    Args:
        log: a log, as for `splatbot map`.
        out: the file to write; must not exist.
        camera: intrinsics instead of the log's own, as for `splatbot map`.
    """
    log_kind(log)
    check_camera(camera)
    check_output(out, folder=False)
    if out.exists():
        raise InputError("exists already.", file=out, field="--out", hint="choose another name")

    from splatbot.logs import open_log
    from splatbot.logs.mcap import record_mcap

    source = open_log(log, camera=camera)
    record_mcap(source, out)
    print(f"{out}: {len(source)} frames, {out.stat().st_size / 1e6:.1f} MB")
