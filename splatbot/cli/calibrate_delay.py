"""`splatbot calibrate joint-delay`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from splatbot.cli.paths import check_camera, check_file, check_output
from splatbot.cli.placing import named_robot
from splatbot.layouts import log_kind


def calibrate_joint_delay_command(
    log: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")],
    /,
    robot: Annotated[str, tyro.conf.arg(metavar="NAME")],
    scene: Annotated[Path | None, tyro.conf.arg(metavar="YAML")] = None,
    camera: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE")] = None,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    quiet: bool = False,
) -> int:
    """Estimate the delay of joint states from the silhouette of the arm in the images of a static camera.

    The arm moves to and fro in view for 10 s or more, and no other object moves. The delay is the time by which the
    stamps of joint states are later than the motion. `splatbot map --robot` and `splatbot serve --robot` read it from
    scene.yaml, and mask the arm where it was at the time of each image. `splatbot calibrate hand-eye` estimates the
    delay of a camera on the arm.

    Examples:
        splatbot calibrate joint-delay recordings/sweep --robot panda
        splatbot calibrate joint-delay recordings/sweep --robot panda --out recordings/sweep/scene.yaml

    Args:
        log: recording of the static camera, with the joints of the arm.
        robot: the arm; see `splatbot robot list`.
        scene: scene.yaml with T_link_camera and camera_link 0; by default that of the log's folder.
        camera: intrinsics instead of the log's own: tum_fr1, tum_fr2, tum_fr3 or an intrinsics.json.
        out: scene.yaml to write, with the estimate; by default only the table is printed.
        quiet: no progress and no table, only errors.
    """
    log_kind(log)
    check_camera(camera)
    check_file(scene, "--scene")
    check_output(out, folder=False)
    arm = named_robot(robot)

    from dataclasses import replace

    from splatbot.cli.calibrate import describe
    from splatbot.cli.progress import shares
    from splatbot.cli.tables import print_table
    from splatbot.errors import InputError
    from splatbot.logs import open_log
    from splatbot.robots.joint_delay import estimate_joint_delay
    from splatbot.workspace import Workspace, find_workspace

    workspace = Workspace.load(scene) if scene is not None else find_workspace(log) or Workspace()
    recording = open_log(log, camera=camera)
    with shares(quiet) as show:
        found = estimate_joint_delay(recording, arm, workspace, on_share=lambda share: show("delay", share))
    if not quiet:
        rows = [
            ("joint_delay", describe(found.estimate)),
            ("overlap", f"{found.overlap:.0%} of robot and silhouette, in {found.frames} images"),
        ]
        print_table(rows, title=f"{recording.name}: joint states of {robot}")
    if found.estimate.refusal:
        raise InputError(
            f"does not determine the delay: {found.estimate.refusal}.", file=log, field="joints", hint="see --help"
        )
    if out is not None:
        replace(workspace, joint_delay=found.estimate.significant).save(out)
        if not quiet:
            print(f"written: {out}" + ("" if found.estimate.significant else ", without a delay: 0 is within 2 sigma"))
    return 0
