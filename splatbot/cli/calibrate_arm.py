"""`splatbot calibrate intrinsics` and `hand-eye`: cameras and arms from views of a board, or from a map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from splatbot.calibration.board import BoardView
    from splatbot.calibration.estimate import Estimate
    from splatbot.calibration.hand_eye import HandEyeCalibration
    from splatbot.calibration.intrinsics import IntrinsicsCalibration
    from splatbot.calibration.link_motion import LinkMotion
    from splatbot.calibration.measurements import BoardMeasurement, Measurement, PoseMeasurement
    from splatbot.calibration.views import ArmView
    from splatbot.camera import Camera
    from splatbot.protocols import Array, KinematicChain

_MAX_VIEWS = 100
_MOST_MISSES = 10  # images without the board before all others are given up: each is searched with all dictionaries


def calibrate_intrinsics_command(
    views: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="IMAGES|LOG")],
    /,
    board: str,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    depth_scale: float = 1000.0,
    max_views: int = _MAX_VIEWS,
    quiet: bool = False,
) -> int:
    """Estimate focal lengths, principal point and distortion of a camera from views of a ChArUco board.

    Boards have the form charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY][:legacy] with numbers of squares and lengths in
    metres. The dictionary and the legacy pattern are found in the images if they are not given. Take 20 images or more
    from different sides, with the board up to the corners of the image.

    Examples:
        splatbot calibrate intrinsics images --board charuco:10x14:0.07:0.04 --out camera.json
        splatbot map recordings/desk --camera camera.json

    Args:
        views: folder of images, or a log.
        board: the board, as charuco:10x14:0.07:0.04.
        out: camera file to write; by default only the table is printed.
        depth_scale: units of the depth images per metre, for the camera file.
        max_views: largest number of images that are used, evenly spread.
        quiet: no progress and no table, only errors.
    """
    from splatbot.calibration.intrinsics import calibrate_intrinsics
    from splatbot.cli.paths import check_output
    from splatbot.cli.tables import print_table
    from splatbot.logs.calibration import Calibration, save_calibration

    check_output(out, folder=False)
    found, size = _detect(views, board, max_views, quiet)
    result = calibrate_intrinsics([view for _, view in found], size)
    if not quiet:
        rows = [(name, _value(e)) for name, e in result.estimates.items()]
        rows.append(("reprojection", f"{result.rms:.3f} px RMS, {result.corners:,} corners, {len(result.views)} views"))
        print_table(rows, title=f"{views}: camera {size[0]}x{size[1]}")
    _require(result, views)
    if out is not None:
        save_calibration(Calibration(result.camera, depth_scale), out)
    return 0


def calibrate_hand_eye_command(
    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="IMAGES|LOG|RUN|POSES")],
    /,
    board: str | None = None,
    robot: str | None = None,
    joints: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    poses: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    camera: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE")] = None,
    eye_to_hand: bool = False,
    link: int | None = None,
    offsets: Literal["auto", "yes", "no"] = "auto",
    same_clock: bool = False,
    max_views: int = _MAX_VIEWS,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    quiet: bool = False,
) -> int:
    """Estimate the pose of a camera on an arm, with joint offsets and a time offset.

    With a board: images or a log show a static ChArUco board from the camera on the arm. With --eye-to-hand, they show
    a board on the arm from a static camera. Each image has the arm's joints or pose: in a YAML file of its name
    (joint_values, T_base_link), or in the log. The arm is at rest in each image.

    Without a board: the poses that `splatbot map` has tracked, with the joints or the poses of the arm over time. Two
    pose files of one motion do as well.

    Every third view is held out. Offsets of joints are estimated if this lowers the error of the held-out views by a
    tenth. A value that the motion does not determine is refused with its reason.

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
        same_clock: the stamps of both recordings agree; no time offset is estimated.
        max_views: largest number of images that are used, evenly spread.
        out: scene.yaml to write; the fields of an existing one that this command estimates are replaced.
        quiet: no progress and no table, only errors.
    """
    from splatbot.calibration.hand_eye import calibrate_hand_eye
    from splatbot.cli.paths import check_output
    from splatbot.errors import InputError
    from splatbot.robots.store import load_robot

    check_output(out, folder=False)
    chain = None if robot is None else load_robot(robot).chain
    carrier = -1 if link is None else link
    if chain is not None and not (-len(chain) <= carrier <= len(chain) and carrier != 0):
        raise InputError(f"is {link}.", field="--link", hint=f"{robot} has links 1..{len(chain)} that move")
    number = 0 if chain is None else carrier % (len(chain) + 1)
    motion: LinkMotion
    measured: Measurement
    delay: float | None
    wanted = {"auto": None, "yes": True, "no": False}[offsets]
    if wanted and chain is None:
        raise InputError("needs the arm's joints.", field="--offsets", hint="give --robot NAME with its joints")
    if board is not None:
        if joints is not None or poses is not None:
            raise InputError("goes without --board.", field="--joints, --poses", hint="joints come with the images")
        motion, measured = _board_problem(source, board, robot, chain, number, camera, eye_to_hand, max_views, quiet)
        delay = None
    else:
        if eye_to_hand or camera is not None:
            raise InputError("needs --board.", field="--eye-to-hand, --camera", hint="give --board, or leave it out")
        motion, measured, delay = _tracked_problem(source, robot, chain, number, joints, poses, same_clock)
    if chain is None and out is not None and link is None and not eye_to_hand:
        hint = "give the link whose frame the recorded poses are of (-1: the last), or --robot NAME with joints"
        raise InputError("is not known without a robot.", field="--link", hint=hint)
    found = calibrate_hand_eye(motion, measured, offsets=wanted, delay=delay)
    if not quiet:
        _print(found, source, eye_to_hand, board is not None)
    found.check(moving=not eye_to_hand, static=eye_to_hand or board is None)
    if out is not None:
        joint_count = 0 if chain is None else len(chain)
        _write(found, out, carrier, eye_to_hand, tracked=board is None, joints=joint_count)
    return 0


def _require(found: IntrinsicsCalibration, source: str) -> None:
    """Check that the views determine each value of a camera.

    Raises:
        InputError: they do not.
    """
    from splatbot.errors import InputError

    for name, estimate in found.estimates.items():
        if estimate.refusal:
            hint = "take more images, with the board tilted by 20 to 40 degrees and up to the corners of the image"
            raise InputError(f"is not determined: {estimate.refusal}.", file=source, field=name, hint=hint)


def _value(estimate: Estimate) -> str:
    if estimate.refusal:
        return f"not known: {estimate.refusal}"
    return f"{estimate.value:.4g} ± {estimate.sigma:.2g} {estimate.unit}".rstrip()


def _detect(
    source: str, board: str, max_views: int, quiet: bool
) -> tuple[list[tuple[ArmView, BoardView]], tuple[int, int]]:
    """Return the arm at each image with the corners in it, and the size (width, height) of all of them.

    Raises:
        InputError: the images differ in size, or none shows the board.
    """
    from splatbot.calibration.board import CharucoBoard
    from splatbot.calibration.views import read_views
    from splatbot.cli.progress import shares
    from splatbot.errors import InputError

    spec = CharucoBoard.parse(board)
    if max_views < 1:
        raise InputError(f"is {max_views}.", field="--max-views", hint="give 20 to 200")
    found: list[tuple[ArmView, BoardView]] = []
    sizes: set[tuple[int, int]] = set()
    refusal, misses = None, 0
    with shares(quiet) as show:
        for share, arm, image in read_views(source, max_views=max_views):
            show("board", share)
            sizes.add((image.shape[1], image.shape[0]))
            if len(sizes) > 1:
                named = ", ".join(f"{w}x{h}" for w, h in sorted(sizes))
                hint = "give images of one camera"
                raise InputError(f"has images of {named}.", file=source, field="views", hint=hint)
            if not spec.complete:
                try:
                    spec = spec.completed(image)
                except InputError as error:  # the board may be in a later image
                    refusal = error
                    misses += 1
                    if misses == _MOST_MISSES:
                        break
                    continue
            found.append((arm, spec.detect(image)))
    if refusal is not None and not found:
        raise refusal
    if not sizes:
        raise InputError("has no images.", file=source, field="views", hint="give a folder of images or a log")
    return found, sizes.pop()


def _board_problem(
    source: str,
    board: str,
    robot: str | None,
    chain: KinematicChain | None,
    link: int,
    camera: str | None,
    eye_to_hand: bool,
    max_views: int,
    quiet: bool,
) -> tuple[LinkMotion, BoardMeasurement]:
    """Return the motion of the link and the corners of all images that show the board and know the arm."""
    import numpy as np

    from splatbot.calibration.intrinsics import calibrate_intrinsics
    from splatbot.calibration.link_motion import JointLinkMotion, PoseLinkMotion, check_joints
    from splatbot.calibration.measurements import BoardMeasurement
    from splatbot.errors import InputError

    found, size = _detect(source, board, max_views, quiet)
    seen = [(view, corners) for view, corners in found if corners.usable]
    if camera is None:
        intrinsics = calibrate_intrinsics([corners for _, corners in seen], size)
        _require(intrinsics, source)
        lens = intrinsics.camera
    else:
        lens = _camera(camera, size)
    motion: LinkMotion
    if chain is not None:
        usable = [(arm, c) for arm, c in seen if arm.joints is not None]
        joints = _rows([arm.joints for arm, _ in usable if arm.joints is not None], source)
        if usable:
            check_joints(chain, joints, robot=robot or "", file=source)
        motion = JointLinkMotion(chain, joints[:, : len(chain)], link)
    else:
        usable = [(arm, c) for arm, c in seen if arm.T_base_link is not None]
        motion = PoseLinkMotion(np.array([arm.T_base_link for arm, _ in usable]))
    if not usable:
        hint = "give --robot NAME and joints with the images" if chain is None else "write joint_values: [q1, ...]"
        raise InputError("does not say where the arm was.", file=source, field="joints", hint=hint)
    return motion, BoardMeasurement(tuple(c for _, c in usable), lens, not eye_to_hand)


def _rows(joints: list[Array], source: str) -> Array:
    """Return joint positions (V, J) of as many joints in each view.

    Raises:
        InputError: they differ in number.
    """
    import numpy as np

    from splatbot.errors import InputError

    counts = {len(q) for q in joints}
    if len(counts) > 1:
        hint = "write all joints for each image"
        raise InputError(f"has {min(counts)} to {max(counts)} joints.", file=source, field="joints", hint=hint)
    return np.array(joints).reshape(len(joints), -1)


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
    robot: str | None,
    chain: KinematicChain | None,
    link: int,
    joints: Path | None,
    poses: Path | None,
    same_clock: bool,
) -> tuple[LinkMotion, PoseMeasurement, float | None]:
    """Return the motion of the link, the tracked poses, and the time offset that the stamps of the motion lack."""
    from splatbot.calibration.link_motion import check_joints
    from splatbot.calibration.streams import align_streams, load_stream
    from splatbot.errors import InputError
    from splatbot.logs.joints import NAME, JointRecord
    from splatbot.results.folder import RunFolder

    run = RunFolder(source)
    if joints is None and poses is None and run.metrics.is_file():
        log = Path(str(run.load_metrics().get("log", {}).get("uri", "")))
        joints = log / NAME if (log / NAME).is_file() else None
    if (joints is None) == (poses is None):
        hint = "give --robot NAME --joints FILE, or --poses FILE; with images of a board, give --board"
        raise InputError("needs the joints or the poses of the arm.", file=source, field="--joints, --poses", hint=hint)
    tracked = run.load_trajectory() if run.path.is_dir() else load_stream(run.path)
    if joints is not None:
        if chain is None:
            raise InputError("needs the arm of the joints.", file=joints, field="--robot", hint="give --robot NAME")
        record = JointRecord(joints)
        check_joints(chain, record.joints, robot=robot or "", file=str(joints))
        return align_streams(
            tracked, record.stamps, joints=record.joints, chain=chain, link=link, same_clock=same_clock
        )
    assert poses is not None
    arm = load_stream(poses)
    return align_streams(tracked, arm.stamps, T_base_link=arm.T_world_camera, same_clock=same_clock)


def _print(found: HandEyeCalibration, source: str, eye_to_hand: bool, board: bool) -> None:
    from splatbot.cli.tables import print_table

    moving, static = (
        ("board on its link", "camera in the base") if eye_to_hand else ("camera on its link", "board in the base")
    )
    if not board:
        static = "map in the base"
    rows = [*_pose_rows(moving, found.T_link_moving, found.covariance_moving)]
    rows += _pose_rows(static, found.T_base_static, found.covariance_static)
    for name, estimate in found.offsets.items():
        value = f"{1e3 * estimate.value:+.1f} ± {1e3 * estimate.sigma:.1f} m{estimate.unit}"
        rows.append((name, f"not known: {estimate.refusal}" if estimate.refusal else value))
    if found.delay is not None:
        value = f"{1e3 * found.delay.value:.1f} ± {1e3 * found.delay.sigma:.1f} ms"
        rows.append(("time offset", f"{value}; {found.delay.refusal}" if found.delay.refusal else value))
    rows.append(("error", f"{found.error:.2f} {found.unit} median, {found.views} views"))
    names = ("without joint offsets", "with joint offsets")
    held_out = ", ".join(f"{e:.2f} {found.unit} {n}" for e, n in zip(found.held_out, names, strict=False))
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


def _write(found: HandEyeCalibration, path: Path, link: int, eye_to_hand: bool, *, tracked: bool, joints: int) -> None:
    """Write the estimates into a scene.yaml."""
    import numpy as np

    from splatbot.geometry import inverse
    from splatbot.workspace import Workspace

    scene = Workspace.load(path) if path.exists() else Workspace()
    if eye_to_hand:
        scene = replace(scene, T_link_camera=found.T_base_static, camera_link=0)
    else:
        scene = replace(scene, T_link_camera=found.T_link_moving, camera_link=link)
    if tracked:
        scene = replace(scene, T_world_base=inverse(found.T_base_static))
    offsets = np.zeros(joints)
    offsets[: len(found.joint_offsets)] = found.joint_offsets
    scene = replace(scene, joint_offsets=offsets if np.any(offsets) else None)
    scene.save(path)
