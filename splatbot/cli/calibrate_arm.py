"""`splatbot calibrate intrinsics` and `hand-eye`: cameras and arms from views of a board, or from a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from splatbot.cli.messages import print_message
from splatbot.cli.paths import check_file, check_output, check_source
from splatbot.cli.placing import named_robot

if TYPE_CHECKING:
    from splatbot.calibration.hand_eye import HandEyeCalibration
    from splatbot.calibration.link_motion import LinkMotion
    from splatbot.calibration.measurements import BoardMeasurement, Measurement, PoseMeasurement
    from splatbot.calibration.views import ArmView, BoardRecording, ViewSource
    from splatbot.camera import Camera
    from splatbot.protocols import Array, RobotKinematics
    from splatbot.workspace import Workspace

_MAX_VIEWS = 100


def calibrate_intrinsics_command(
    views: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="IMAGES|LOG")],
    /,
    board: Annotated[str, tyro.conf.arg(metavar="SPEC")],
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    depth_scale: float | None = None,
    max_views: int = _MAX_VIEWS,
    quiet: bool = False,
) -> int:
    """Estimate focal lengths, principal point and distortion of a camera from views of a board.

    Boards have lengths in metres:
    - charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY][:legacy], with numbers of squares
    - apriltag:COLUMNSxROWS:TAG:GAP[:FAMILY], Kalibr's grid, with numbers of tags
    - grid:COLUMNSxROWS:MARKER:GAP[:DICTIONARY], OpenCV's grid, with numbers of markers

    The images show the dictionary if it is not given. Take 20 images or more from different sides, with the board up to
    the corners of the image.

    Examples:
        splatbot calibrate intrinsics images --board charuco:10x14:0.07:0.04 --out camera.json
        splatbot map recordings/desk --camera camera.json

    Args:
        views: folder of images, or a log.
        board: the board, as charuco:10x14:0.07:0.04 or apriltag:6x6:0.088:0.0264.
        out: camera file to write; by default only the table is printed.
        depth_scale: units of the depth images per metre, for the camera file; by default those of the log, or 1000.
        max_views: largest number of images that are used, evenly spread.
        quiet: no progress and no table, only errors.
    """
    check_source(views, "IMAGES|LOG")
    check_output(out, folder=False)

    from splatbot.calibration.intrinsics import calibrate_intrinsics
    from splatbot.calibration.views import ViewSource
    from splatbot.cli.calibrate import describe
    from splatbot.cli.tables import print_table
    from splatbot.logs.base import MILLIMETRES
    from splatbot.logs.calibration import Calibration, save_calibration

    source = ViewSource(views)
    recording = _find_board(source, board, max_views, quiet)
    width, height = recording.size
    found = calibrate_intrinsics(recording.views, recording.size)
    if not quiet:
        rows = [(name, describe(estimate)) for name, estimate in found.estimates.items()]
        rows.append(("reprojection", f"{found.rms:.3f} px RMS, {found.corners:,} corners, {len(found.views)} views"))
        print_table(rows, title=f"{views}: camera {width}x{height}")
    found.check()
    if out is not None:
        recorded = source.calibration or Calibration(found.camera, MILLIMETRES)
        scale = recorded.depth_scale if depth_scale is None else depth_scale
        save_calibration(replace(recorded, camera=found.camera, depth_scale=scale), out)
        _announce(out, quiet)
    return 0


def calibrate_hand_eye_command(
    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="IMAGES|LOG|RUN|POSES")],
    /,
    board: Annotated[str | None, tyro.conf.arg(metavar="SPEC")] = None,
    robot: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None,
    joints: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    poses: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    camera: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE")] = None,
    eye_to_hand: bool = False,
    link: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    offsets: Literal["auto", "yes", "no"] = "auto",
    scale: Literal["auto", "yes", "no"] | None = None,
    same_clock: bool = False,
    max_views: int = _MAX_VIEWS,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    quiet: bool = False,
) -> int:
    """Estimate the pose of a camera on an arm, with joint offsets and a time offset.

    With a board: images or a log show a static board from the camera on the arm. With --eye-to-hand, they show
    a board on the arm from a static camera. Each image has the arm's joints or pose: in a YAML file of its name
    (joint_values, T_base_link), or in the log. The arm is at rest in each image.

    Without a board: the poses that `splatbot map` has tracked, with the joints or the poses of the arm over time. Two
    pose files of one motion do as well.

    Every third view is held out. Offsets of joints are estimated if this lowers the error of the held-out views by a
    tenth. So is the scale of a board, which may be printed too large or too small. A value that the motion does not
    determine is refused with its reason.

    Examples:
        splatbot calibrate hand-eye images --board charuco:10x14:0.07:0.04 --robot panda --out scene.yaml
        splatbot calibrate hand-eye runs/wrist --robot panda --joints wrist/joints.txt --out runs/wrist/scene.yaml
        splatbot calibrate hand-eye runs/wrist --poses wrist/ee_poses.txt --link -1 --out runs/wrist/scene.yaml

    Args:
        source: folder of images or a log with --board; else a run's folder or a pose file (stamp tx ty tz qx qy qz qw).
        board: the board, as charuco:10x14:0.07:0.04; see `splatbot calibrate intrinsics --help`.
        robot: arm of the joints; see `splatbot robot list`.
        joints: joint positions over time, lines `stamp q1 q2 ...` [s, rad]; by default the joints.txt of the run's log.
        poses: poses of the link in the base over time, lines `stamp tx ty tz qx qy qz qw` [s, m].
        camera: intrinsics of the images with --board (a camera file or a preset); by default they are estimated first.
        eye_to_hand: the camera is static and the board is on the arm.
        link: link that carries the camera or the board; by default the last one, -1.
        offsets: whether offsets of joints are estimated.
        scale: whether the true lengths of the board or map, divided by the given ones, are estimated. By default auto
            with a board and no without.
        same_clock: the stamps of both recordings agree; no time offset is estimated.
        max_views: largest number of images that are used, evenly spread.
        out: scene.yaml to write; the fields of an existing one that this command estimates are replaced.
        quiet: no progress and no table, only errors.
    """
    check_source(source, "SOURCE")
    check_file(joints, "--joints")
    check_file(poses, "--poses")
    check_output(out, folder=False)
    arm = None if robot is None else named_robot(robot)

    from splatbot.calibration.hand_eye import calibrate_hand_eye
    from splatbot.cli.progress import steps
    from splatbot.errors import InputError
    from splatbot.workspace import Workspace

    scene = Workspace.load(out) if out is not None and out.exists() else Workspace()
    names = scene.joint_names or (() if arm is None else tuple(arm.chain.names))
    if arm is not None and link is not None and abs(link) > len(arm.chain):
        raise InputError(f"is {link}.", field="--link", hint=f"{robot} has links 1..{len(arm.chain)} that move")
    if link == 0:
        raise InputError("is the base, which does not move.", field="--link", hint="give 1, 2, ..., or -1: the last")
    choices = {"auto": None, "yes": True, "no": False}
    wanted = choices[offsets]
    if wanted and arm is None:
        raise InputError("needs the arm's joints.", field="--offsets", hint="give --robot NAME with its joints")
    motion: LinkMotion
    measured: Measurement
    delay: float | None = None
    carrier = -1 if link is None else link
    if board is not None:
        if joints is not None or poses is not None or same_clock:
            hint = "leave them out: joints come with the images"
            raise InputError("goes without --board.", field="--joints, --poses, --same-clock", hint=hint)
        motion, measured = _board_problem(source, board, arm, names, carrier, camera, eye_to_hand, max_views, quiet)
    else:
        if eye_to_hand or camera is not None:
            raise InputError("needs --board.", field="--eye-to-hand, --camera", hint="give --board, or leave it out")
        motion, measured, delay = _tracked_problem(source, arm, names, carrier, joints, poses, same_clock)
    if arm is None and out is not None and link is None and not eye_to_hand:
        hint = "give the link whose frame the recorded poses are of (-1: the last), or --robot NAME with joints"
        raise InputError("is not known without a robot.", field="--link", hint=hint)
    with steps(quiet) as show:
        show("least squares")
        found = calibrate_hand_eye(
            motion, measured, offsets=wanted, scale=choices[scale or ("no" if board is None else "auto")], delay=delay
        )
    if not quiet:
        _print(found, source, eye_to_hand, board is not None)
    found.check(moving=not eye_to_hand, static=eye_to_hand or board is None)
    if out is not None and board is None and found.scale is not None and not found.scale.refusal:
        hint = f"divide the depth_scale of the camera file by {found.scale.value:.4f} and map the log again"
        raise InputError("is not 1, so that the map's lengths are wrong.", file=source, field="scale", hint=hint)
    if out is not None:
        _completed(scene, found, 0 if eye_to_hand else carrier, arm, tracked=board is None).save(out)
        _announce(out, quiet)
    return 0


def _announce(out: Path, quiet: bool) -> None:
    if not quiet:
        print(f"written: {out}")


def _find_board(source: ViewSource, board: str, max_views: int, quiet: bool) -> BoardRecording:
    """Return the views of a board, with progress and a note of damaged frames."""
    from splatbot.calibration.board_spec import parse_board
    from splatbot.calibration.views import find_board
    from splatbot.cli.progress import shares
    from splatbot.errors import InputError

    if max_views < 1:
        raise InputError(f"is {max_views}.", field="--max-views", hint="give 20 to 200")
    spec = parse_board(board)
    with shares(quiet) as show:
        recording = find_board(source, spec, max_views=max_views, on_share=lambda share: show("board", share))
    if source.skipped:
        print_message("warning", f"{source.source}: {source.skipped} damaged frames are skipped")
    return recording


def _board_problem(
    source: str,
    board: str,
    arm: RobotKinematics | None,
    names: Sequence[str],
    link: int,
    camera: str | None,
    eye_to_hand: bool,
    max_views: int,
    quiet: bool,
) -> tuple[LinkMotion, BoardMeasurement]:
    """Return the motion of the link and the corners of all images that show the board and know the arm."""
    import numpy as np

    from splatbot.calibration.intrinsics import calibrate_intrinsics
    from splatbot.calibration.link_motion import PoseLinkMotion
    from splatbot.calibration.measurements import BoardMeasurement
    from splatbot.calibration.views import ViewSource
    from splatbot.errors import InputError

    recording = _find_board(ViewSource(source), board, max_views, quiet)
    if camera is None:
        intrinsics = calibrate_intrinsics(recording.views, recording.size)
        intrinsics.check()
        lens = intrinsics.camera
    else:
        lens = _camera(camera, recording.size)
    seen = [(at, view) for at, view in zip(recording.arms, recording.views, strict=True) if view.usable]
    known = [(at.T_base_link if arm is None else _ordered(at, names), view) for at, view in seen]
    values, views = [value for value, _ in known if value is not None], [v for value, v in known if value is not None]
    if not values:
        hint = "give --robot NAME and joints with the images" if arm is None else "write joint_values: [q1, ...]"
        raise InputError("does not say where the arm was.", file=source, field="joints", hint=hint)
    if len({value.shape for value in values}) > 1:
        raise InputError("differ in number.", file=source, field="joints", hint="write all joints for each image")
    motion = PoseLinkMotion(np.array(values)) if arm is None else _by_joints(arm, np.array(values), link, source)
    return motion, BoardMeasurement(tuple(views), lens, not eye_to_hand)


def _ordered(at: ArmView, names: Sequence[str]) -> Array | None:
    from splatbot.logs.joints import select_joints

    if at.joints is None or not at.joint_names:
        return at.joints
    return select_joints(at.joint_names, at.joints, names)


def _by_joints(arm: RobotKinematics, joints: Array, link: int, source: str, stamps: Array | None = None) -> LinkMotion:
    """Return the motion of a link by joints that were checked."""
    from splatbot.calibration.link_motion import JointLinkMotion, check_joints
    from splatbot.collision import RobotSpheres

    check_joints(arm, joints, file=source)
    count = len(arm.chain)
    return JointLinkMotion(RobotSpheres(arm), joints[:, :count], link % (count + 1), stamps)


def _camera(name: str, size: tuple[int, int]) -> Camera:
    """Return the camera of a preset or a camera file, whose images have this size."""
    from splatbot.errors import CameraError
    from splatbot.logs.presets import find_calibration

    camera = find_calibration(name).camera
    if (camera.width, camera.height) != size:
        raise CameraError(
            f"is for {camera.width}x{camera.height}, the images are {size[0]}x{size[1]}.",
            file=name,
            field="width, height",
            hint="give the camera file of these images, or leave --camera out",
        )
    return camera


def _tracked_problem(
    source: str,
    arm: RobotKinematics | None,
    names: Sequence[str],
    link: int,
    joints: Path | None,
    poses: Path | None,
    same_clock: bool,
) -> tuple[LinkMotion, PoseMeasurement, float | None]:
    """Return the motion of the link, the tracked poses, and the time offset that the stamps of the motion lack."""
    from splatbot.calibration.link_motion import PoseLinkMotion
    from splatbot.calibration.streams import align_streams
    from splatbot.errors import InputError
    from splatbot.formats.trajectory import load_trajectory
    from splatbot.logs.joints import NAME, JointRecord
    from splatbot.results.folder import RunFolder

    run = RunFolder(source)
    if joints is None and poses is None and run.metrics.is_file():
        log = Path(str(run.load_metrics().get("log", {}).get("uri", "")))
        joints = log / NAME if (log / NAME).is_file() else None
    if (joints is None) == (poses is None):
        hint = "give --robot NAME --joints FILE, or --poses FILE; with images of a board, give --board"
        raise InputError("needs the joints or the poses of the arm.", file=source, field="--joints, --poses", hint=hint)
    tracked = run.load_trajectory() if run.path.is_dir() else load_trajectory(source, unordered=True)
    motion: LinkMotion
    if joints is not None:
        if arm is None:
            raise InputError("needs the arm of the joints.", file=joints, field="--robot", hint="give --robot NAME")
        record = JointRecord(joints)
        positions = record.ordered(names) if record.names else record.joints
        motion = _by_joints(arm, positions, link, str(joints), record.stamps)
    else:
        recorded = load_trajectory(str(poses), unordered=True)
        motion = PoseLinkMotion(recorded.T_world_camera, recorded.stamps)
    return align_streams(tracked, motion, same_clock=same_clock)


def _print(found: HandEyeCalibration, source: str, eye_to_hand: bool, board: bool) -> None:
    from splatbot.cli.calibrate import describe
    from splatbot.cli.tables import print_table

    moving = "board on its link" if eye_to_hand else "camera on its link"
    static = "camera in the base" if eye_to_hand else "board in the base" if board else "map in the base"
    rows = _pose_rows(moving, found.T_link_moving, found.covariance_moving)
    rows += _pose_rows(static, found.T_base_static, found.covariance_static)
    rows += [(name, describe(estimate)) for name, estimate in found.offsets.items()]
    if found.scale is not None:
        rows.append((f"scale of the {'board' if board else 'map'}", describe(found.scale)))
    if found.delay is not None:
        rows.append(("time offset", describe(found.delay)))
    rows.append(("error", f"{found.error:.2f} {found.unit} median, {found.views} views"))
    held_out = ", ".join(f"{error:.2f} {found.unit} {unknowns}" for unknowns, error in found.held_out.items())
    rows.append(("held-out views", f"{held_out} (median of every third view)"))
    print_table(rows, title=f"{source}: hand-eye")


def _pose_rows(name: str, T: Array, covariance: Array) -> list[tuple[str, str]]:
    """Return a pose with its standard deviations in millimetres and degrees."""
    import numpy as np

    from splatbot.geometry import so3_log

    R = T[:3, :3]
    sigma = np.sqrt(np.diag(R @ covariance[:3, :3] @ R.T))  # along the axes of the parent frame, as the translation
    shift = ", ".join(f"{1e3 * x:.1f} ± {1e3 * s:.1f}" for x, s in zip(T[:3, 3], sigma, strict=True))
    turn = ", ".join(f"{x:.2f}" for x in np.degrees(so3_log(R)))
    largest = np.degrees(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
    return [(name, f"{shift} mm"), ("", f"{turn} degrees (rotation vector), ± {largest:.2f} about any axis")]


def _completed(
    scene: Workspace, found: HandEyeCalibration, link: int, arm: RobotKinematics | None, *, tracked: bool
) -> Workspace:
    """Return a scene with the estimates: the camera, the joint offsets and, of tracked poses, the base."""
    import numpy as np

    from splatbot.geometry import inverse
    from splatbot.robots.joint_offsets import arm_name

    offsets = np.zeros(0 if arm is None else len(arm.chain))
    offsets[: len(found.joint_offsets)] = found.joint_offsets
    return replace(
        scene,
        T_link_camera=found.T_base_static if link == 0 else found.T_link_moving,
        camera_link=link,
        joint_offsets=offsets if offsets.any() else None,
        offsets_of=arm_name(arm.name) if arm is not None and offsets.any() else "",
        T_world_base=inverse(found.T_base_static) if tracked else scene.T_world_base,
        base_proposed=scene.base_proposed and not tracked,
        joint_delay=_joint_delay(found, scene.joint_delay) if tracked and arm is not None else scene.joint_delay,
    )


def _joint_delay(found: HandEyeCalibration, known_before: float) -> float:
    """Return the delay [s] of joint states for masks, or the one known before if the recordings do not determine it."""
    from splatbot.workspace import MAX_JOINT_DELAY_S

    delay = found.delay
    known = delay is not None and not delay.refusal and abs(delay.value) <= MAX_JOINT_DELAY_S
    return delay.significant if known and delay is not None else known_before
