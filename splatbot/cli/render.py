"""`splatbot render`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from splatbot.cli.loading import without_line
from splatbot.cli.paths import check_file, check_output
from splatbot.cli.tiled import check_tiled
from splatbot.layouts import is_tiled_map, map_file

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from splatbot.camera import Camera
    from splatbot.gaussians import GaussianModel
    from splatbot.rasterize.views import Mode

_LONGEST_VIDEO_S = 600.0

_LEAST_SINE = 1e-3  # of the angle between a view and up, below which no horizon is defined
_UP = (0.0, -1.0, 0.0)

Pose = tuple[float, float, float, float, float, float, float]
Point = tuple[float, float, float]


def render(
    map_: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MAP")],
    /,
    mode: Literal["rgb", "depth", "normal", "alpha"] = "rgb",
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    pose: Annotated[Pose | None, tyro.conf.arg(metavar="X Y Z QW QX QY QZ")] = None,
    look_from: Annotated[Point | None, tyro.conf.arg(metavar="X Y Z")] = None,
    look_at: Annotated[Point | None, tyro.conf.arg(metavar="X Y Z")] = None,
    trajectory: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    index: Annotated[int | None, tyro.conf.arg(metavar="I")] = None,
    size: Annotated[str, tyro.conf.arg(metavar="WxH")] = "640x480",
    fov: Annotated[float, tyro.conf.arg(metavar="DEG")] = 60.0,
    video: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    seconds: Annotated[float, tyro.conf.arg(metavar="S")] = 8.0,
    pixel_error: Annotated[float | None, tyro.conf.arg(metavar="PX")] = None,
    memory_mb: Annotated[float | None, tyro.conf.arg(metavar="MB")] = None,
) -> int:
    """Render a view of a map to a PNG, or a fly-through to a video.

    Without a pose the camera backs off until it sees most of the map. Depth runs from red (near) to blue (far). A
    fly-through follows the smoothed path of the recording camera.

    Examples:
        splatbot render runs/latest
        splatbot render map.ply --mode depth --out depth.png --size 1280x720
        splatbot render map.ply --pose 0 0 -1.5 1 0 0 0
        splatbot render runs/latest --look-from 0.8 -0.6 -0.2 --look-at 0 0 1
        splatbot render runs/latest --index 30 --mode normal
        splatbot render runs/latest --video fly.mp4 --seconds 10

    Args:
        map_: a map file, a run folder, or a tiled map, of which only the tiles in view are loaded.
        mode: colour, depth, surface normals or opacity.
        out: PNG to write; by default NAME-MODE.png here.
        pose: T_world_camera: position [m] and quaternion (w x y z); camera axes x right, y down, z forward.
        look_from: place of the camera instead of --pose [m]. The frame is that of the map: its first camera's, with x
            right, y down, z forward. The camera is upright, by the scene.yaml next to the map if there is one.
        look_at: point in the middle of the image [m], in the same frame.
        trajectory: TUM file to take the pose from, with --index. A run folder brings its own.
        index: which pose of the trajectory, from 0; -1 is the last.
        size: width and height of the image [px].
        fov: horizontal field of view [deg].
        video: MP4 of a fly-through, instead of a PNG; a map file needs --trajectory.
        seconds: length of the video [s].
        pixel_error: of a tiled map: largest edge of a cell of merged Gaussians [px], by default 1. 0 is exact.
        memory_mb: of a tiled map: memory of tiles [MB], by default 24.
    """
    width, height = _parse_size(size)
    is_tiled = is_tiled_map(map_)
    file = map_ if is_tiled else map_file(map_)
    path = trajectory or (None if is_tiled else _own_trajectory(map_, index, video))
    tiled = {"--pixel-error": pixel_error, "--memory-mb": memory_mb}
    check_tiled(is_tiled, whole={"--video": video}, tiled=tiled)
    check_file(trajectory, "--trajectory")
    check_output(out, folder=False)
    check_output(video, folder=False)
    if video is not None:
        _check_video(path, seconds, pose=pose or look_from or look_at, index=index, out=out)
    looking = _looking(
        map_, look_from, look_at, excluded={"--pose": pose, "--trajectory": trajectory, "--index": index}
    )

    from splatbot.atomic import atomic_write
    from splatbot.gaussians import GaussianModel
    from splatbot.rasterize.views import default_view, render_view, to_png

    given = looking if looking is not None else _given_pose(pose, path, index) if video is None else None
    if is_tiled:
        model, camera, T_world_camera = _load_view(file, given, (width, height, fov), pixel_error, memory_mb)
    else:
        model = GaussianModel.load(file)
        camera, T_world_camera = default_view(model, width=width, height=height, fov_deg=fov)
    if video is not None:
        assert path is not None
        _fly(model, camera, path, video, mode, seconds)
        return 0
    view = render_view(model, camera, T_world_camera if given is None else given, mode)
    target = out if out is not None else Path(f"{map_.resolve().name if map_.is_dir() else map_.stem}-{mode}.png")
    with atomic_write(target) as image:
        image.write(to_png(view, mode))
    print(target)
    return 0


def _load_view(
    folder: Path,
    given: NDArray[np.float64] | None,
    image: tuple[int, int, float],
    pixel_error: float | None,
    memory_mb: float | None,
) -> tuple[GaussianModel, Camera, NDArray[np.float64]]:
    """Return the Gaussians of a tiled map for a view, its camera and pose; the coarsest level gives a default pose."""
    from splatbot.cli.messages import print_message
    from splatbot.rasterize.views import default_view
    from splatbot.tiles.tiled_map import CONSTANTS, TiledMap

    error = CONSTANTS.pixel_error if pixel_error is None else pixel_error
    with TiledMap(folder, memory_mb=CONSTANTS.memory_mb if memory_mb is None else memory_mb) as tiles:
        width, height, fov = image
        camera, T_world_camera = default_view(tiles.overview(), width=width, height=height, fov_deg=fov)
        T_world_camera = T_world_camera if given is None else given
        view = tiles.in_view(camera, T_world_camera, pixel_error=error)
    if view.pixel_error > error:
        print_message("warning", f"the memory allows a pixel error of {view.pixel_error:.2f}, not {error:g} px")
    return view.model, camera, T_world_camera


def _own_trajectory(path: Path, index: int | None, video: Path | None) -> Path | None:
    return path / "trajectory.tum" if path.is_dir() and (index is not None or video is not None) else None


def _check_video(
    path: Path | None, seconds: float, *, pose: Pose | Point | None, index: int | None, out: Path | None
) -> None:
    """Refuse a video without a path, or with options of a single view.

    Raises:
        InputError: an option does not fit.
    """
    from splatbot.errors import InputError

    for name, value in (("--pose, --look-from", pose), ("--index", index), ("--out", out)):
        if value is not None:
            raise InputError("is for a single view.", field=name, hint="leave it out, or leave --video out")
    if path is None:
        raise InputError("needs a camera path.", field="--video", hint="give a run folder, or --trajectory FILE")
    if not 0.1 <= seconds <= _LONGEST_VIDEO_S:
        raise InputError(f"is {seconds:g}.", field="--seconds", hint=f"give 0.1 to {_LONGEST_VIDEO_S:g}")


def _fly(model: GaussianModel, camera: Camera, path: Path, video: Path, mode: Mode, seconds: float) -> None:
    import sys

    from rich.console import Console
    from rich.progress import Progress

    from splatbot.rasterize.fly_through import CONSTANTS, smooth_path, write_fly_through
    from splatbot.trajectory import Trajectory

    poses = smooth_path(Trajectory.load(path), max(2, round(CONSTANTS.fps * seconds)))
    with (
        without_line(),
        Progress(console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()) as bars,
    ):
        task = bars.add_task("rendering", total=len(poses))
        write_fly_through(
            model, camera, poses, video, mode, report_progress=lambda done, _: bars.update(task, completed=done)
        )
    print(video)


def _parse_size(text: str) -> tuple[int, int]:
    from splatbot.errors import InputError

    match = re.fullmatch(r"(\d+)[xX](\d+)", text.strip())
    if not match or not all(1 <= int(part) <= 16384 for part in match.groups()):
        raise InputError(f"is {text!r}.", field="--size", hint="write WIDTHxHEIGHT in pixels, as in 640x480")
    return int(match[1]), int(match[2])


def _looking(
    map_: Path, look_from: Point | None, look_at: Point | None, *, excluded: Mapping[str, object]
) -> NDArray[np.float64] | None:
    """Return T_world_camera (4, 4) of an upright camera at a point that faces another, None without both.

    Raises:
        InputError: one of them is missing, not finite or the other, or the camera looks straight up or down.
    """
    from splatbot.errors import InputError

    if look_from is None and look_at is None:
        return None
    for name, value in excluded.items():
        if value is not None:
            raise InputError("excludes --look-from and --look-at.", field=name, hint="give the one or the others")
    if look_from is None or look_at is None:
        missing, known = ("--look-from", "--look-at") if look_from is None else ("--look-at", "--look-from")
        raise InputError(f"is missing next to {known}.", field=missing, hint=f"give it too: {missing} X Y Z, in metres")

    import numpy as np

    from splatbot.geometry import look_at as facing
    from splatbot.workspace import find_workspace

    for flag, point in (("--look-from", look_from), ("--look-at", look_at)):
        if not np.isfinite(point).all():
            where = " ".join(f"{value:g}" for value in point)
            raise InputError(f"is {where}.", field=flag, hint="give finite numbers, in metres")
    scene, up = find_workspace(map_), np.array(_UP)
    if scene is not None and scene.gravity is not None:
        up = -scene.gravity
    elif scene is not None and scene.T_world_base is not None:
        up = scene.T_world_base[:3, 2]
    view = np.subtract(look_at, look_from)
    length = float(np.linalg.norm(view))
    if length == 0.0:
        raise InputError(
            "is the point of --look-from.", field="--look-at", hint="give another point, ahead of the camera"
        )
    if float(np.linalg.norm(np.cross(view / length, up))) < _LEAST_SINE:
        hint = "move --look-from to one side, by a hundredth of the distance, or give --pose"
        raise InputError(
            "is straight above or below --look-from, so that no side of the image is up.", field="--look-at", hint=hint
        )
    return facing(np.array(look_from), np.array(look_at), up=up)


def _given_pose(pose: Pose | None, path: Path | None, index: int | None) -> NDArray[np.float64] | None:
    from splatbot.errors import InputError
    from splatbot.geometry import pose_from_quat
    from splatbot.trajectory import Trajectory

    if pose is not None:
        if path is not None:
            raise InputError("excludes --trajectory and --index.", field="--pose", hint="give one of them")
        try:
            return pose_from_quat(pose[:3], pose[3:])
        except ValueError as error:
            raise InputError(f"{error}.", field="--pose", hint="QW QX QY QZ of no rotation are 1 0 0 0") from error
    if path is None:
        if index is not None:
            raise InputError("needs a trajectory.", field="--index", hint="give --trajectory FILE, or a run folder")
        return None
    poses, chosen = Trajectory.load(path).T_world_camera, index or 0
    if not -len(poses) <= chosen < len(poses):
        raise InputError(f"is {index}, {path} has {len(poses)} poses.", field="--index", hint="count from 0")
    return poses[chosen]
