"""`splatbot calibrate WHAT`: calibrations from logs. Each is one function here."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from splatbot.cli.paths import check_camera, check_output
from splatbot.layouts import log_kind

if TYPE_CHECKING:
    from splatbot.calibration.estimate import Estimate


def calibrate_sensor_command(
    log: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")],
    /,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    camera: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE")] = None,
    quiet: bool = False,
) -> int:
    """Estimate the times, the registration and the bias of an RGB-D sensor from a log, with standard deviations.

    - readout: time in which a rolling shutter reads an image, from the first row to the last
    - depth_delay: time by which depth is later than colour
    - right, down: shift that moves depth onto its colour
    - depth_bias: constant error of the distance

    The log shows texture and objects before a background, while the camera turns to and fro and moves sideways. A
    quantity that the log does not determine is refused with its reason. The scale of depth is not estimated, because it
    needs a known length.

    Examples:
        splatbot calibrate sensor recordings/shake --out camera.json
        splatbot map recordings/desk --camera camera.json

    Args:
        log: recording with camera motion.
        out: camera file to write, with the log's intrinsics and the estimates; by default only the table is printed.
        camera: intrinsics instead of the log's own: tum_fr1, tum_fr2, tum_fr3 or an intrinsics.json.
        quiet: no progress and no table, only errors.
    """
    log_kind(log)
    check_camera(camera)
    check_output(out, folder=False)

    from splatbot.calibration.sensor import calibrate_sensor
    from splatbot.cli.tables import print_table
    from splatbot.errors import InputError
    from splatbot.logs import open_log
    from splatbot.logs.calibration import save_calibration

    recording = open_log(log, camera=camera)
    found = calibrate_sensor(recording)
    if not quiet:
        print_table([(name, describe(e)) for name, e in found.estimates.items()], title=f"{recording.name}: sensor")
    if not found.known:
        refusals = "; ".join(f"{name}: {e.refusal}" for name, e in found.estimates.items())
        raise InputError(
            f"does not determine any quantity of the sensor ({refusals}).",
            file=log,
            field="motion",
            hint="record a moving camera",
        )
    if out is not None:
        calibration = recording.calibration
        save_calibration(replace(calibration, sensor={**calibration.sensor, **found.section()}), out)
    return 0


def describe(estimate: Estimate) -> str:
    """Return an estimate with its standard deviation, in thousandths of s, m and rad, or its refusal."""
    if estimate.refusal:
        return f"not known: {estimate.refusal}"
    scale, unit = (1e3, f"m{estimate.unit}") if estimate.unit in ("s", "m", "rad") else (1.0, estimate.unit)
    digits = 2 if unit else 4
    return f"{scale * estimate.value:.{digits}f} ± {scale * estimate.sigma:.{digits}f} {unit}".rstrip()
