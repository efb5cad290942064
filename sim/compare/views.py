"""The twin's images at a log's recorded poses against the camera's: colour, depth, and silhouettes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.evaluation import depth_error, psnr
from splatbot.frame import Frame
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, transform_points
from splatbot.protocols import Array
from splatbot.rasterize.views import colorize, render_view
from splatbot.robots.robot import RobotModel
from splatbot.segmentation import Support, find_support, given_support
from splatbot.sim.rays import Pixels, cast, pixel_rays
from splatbot.sim.scene import Scene, make_scene
from splatbot.sim.solids import rpy_of
from splatbot.sim.world import World, build_world


@dataclass(frozen=True)
class PoseViewConstants:
    """Constants of views of maps and twins."""

    min_height: float = 0.01
    """Height [m] over the support plane below which points are noise of the plane. A larger one cuts flat objects."""
    min_opacity: float = 0.3
    """Smallest opacity [1] of Gaussians that count as surface. A larger one loses parts that few frames show."""
    below_support: float = 0.05
    """Depth [m] of the map below the support plane that the twin keeps. A larger one adds legs and floor to the
    physics."""
    rays: int = 160
    """Number of rays [1] across an image of the collision geometry. More of them take quadratically longer."""
    max_range: float = 20.0
    """Length [m] of the rays. Geometry farther away is missing in the image."""


CONSTANTS = PoseViewConstants()


Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class ViewAgreement:
    """Agreement of one frame with the twin. Values without pixels to compare are undefined (None).

    Args:
        index: of the frame in the log.
        held_out: whether the frame was kept out of the map.
        psnr_db: of the Gaussians' colour.
        depth_l1_m, depth_median_m: error of the Gaussians' depth against the sensor over the whole image.
        coverage: fraction of the sensor's pixels for which the Gaussians have a depth.
        part_l1_m: mean depth error in the simulated part of the scene.
        physics_l1_m, physics_coverage: error and coverage of the collision geometry in that part.
        iou, physics_iou: of the silhouettes above the support plane, for the Gaussians and the collision geometry.
        camera_m, camera_rad: difference of the recorded to the tracked camera pose. If None, the frame was not tracked.
    """

    index: int
    held_out: bool
    psnr_db: float
    depth_l1_m: float | None
    depth_median_m: float | None
    coverage: float | None
    part_l1_m: float | None
    physics_l1_m: float | None
    physics_coverage: float | None
    iou: float | None
    physics_iou: float | None
    camera_m: float | None
    camera_rad: float | None


@dataclass(frozen=True, eq=False)
class SeenView:
    """The images of one frame: colour (H, W, 3) uint8, depth [m], silhouettes; those of the geometry are coarser.

    Args:
        rgb, depth: recorded.
        twin_rgb, twin_depth: rendered from the Gaussians.
        shape_depth: of the collision geometry (h, w).
        above, twin_above: masks (H, W) of pixels above the support plane. If None, there is no support plane.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    twin_rgb: NDArray[np.uint8]
    twin_depth: NDArray[np.float32]
    shape_depth: NDArray[np.float32]
    above: Mask | None
    twin_above: Mask | None


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The part of a map that the twin simulates, in the frame of the arm's base.

    Args:
        model: the map.
        T_world_base: (4, 4).
        support: support plane in the base frame. If None, no level plane is within reach.
        low, high: (3,) corners of the simulated part [m].
        values: of the scene, for :func:`splatbot.sim.scene.make_scene`.
    """

    model: GaussianModel
    T_world_base: Array
    support: Support | None
    low: Array
    high: Array
    values: dict[str, Any]

    def scene(self, robot: str | None = None) -> Scene:
        """Create the twin's scene, with an arm at the origin or without."""
        arm = None if robot is None else {"model": robot}
        return make_scene({**self.values, "robot": arm})

    def inside(self, points: Array) -> Mask:
        """Return whether points (..., 3) [m] in the base frame are in the simulated part."""
        return np.asarray(((points >= self.low) & (points <= self.high)).all(axis=-1))

    def above_support(self, points: Array) -> Mask:
        """Return whether points (..., 3) [m] in the base frame are in the simulated part above the support plane."""
        if self.support is None:
            return np.zeros(points.shape[:-1], np.bool_)
        return np.asarray(self.inside(points) & (self.support.height(points) > CONSTANTS.min_height))


def surroundings(
    model: GaussianModel, file: Path, T_world_base: Array, robot: RobotModel, plane: Array | None = None
) -> Surroundings:
    """Extract the part of a map within an arm's reach, and the support plane there.

    Args:
        model: the map.
        file: of the map.
        T_world_base: (4, 4) of the arm.
        robot: the arm, whose reach bounds the part.
        plane: (n, d) of the support plane n · p + d = 0 in the map's frame. If None, it is estimated.
    """
    T_base_world = inverse(T_world_base)
    points = transform_points(T_base_world, model.means.detach().double().numpy())
    shoulder, reach = _reach(robot)
    near = (np.linalg.norm(points - shoulder, axis=1) < reach) & (
        model.opacities.detach().numpy() >= CONSTANTS.min_opacity
    )
    if plane is None:
        support = find_support(points[near])
    else:
        support = given_support(points[near], plane[:3] @ T_world_base[:3, :3], -float(plane @ T_world_base[:, 3]))
    low, high = shoulder - reach, shoulder + reach
    if support is not None:
        low[2] = support.offset / support.normal[2] - CONSTANTS.below_support
    clutter: dict[str, Any] = {
        "file": str(file.resolve()),
        "at": T_base_world[:3, 3].tolist(),
        "rpy": rpy_of(T_base_world[:3, :3]),
        "low": low.tolist(),
        "high": high.tolist(),
    }
    if support is not None:
        clutter["support"] = [*support.normal.tolist(), -support.offset]
    return Surroundings(model, T_world_base, support, low, high, {"name": file.parent.name, "map": clutter})


class TwinViews:
    """Renders the twin from the camera poses of a log. The arm itself is not in its images.

    Args:
        around: the simulated part of the map.
    """

    def __init__(self, around: Surroundings) -> None:
        self._around = around
        self.world: World = build_world(around.scene())
        self._data = mujoco.MjData(self.world.model)
        mujoco.mj_forward(self.world.model, self._data)

    def compare(
        self, frame: Frame, T_base_camera: Array, *, held_out: bool, gap: tuple[float, float] | None
    ) -> tuple[ViewAgreement, SeenView]:
        """Compare a frame with the twin's images from ``T_base_camera`` (4, 4); masked pixels are left out."""
        T_world_camera = self._around.T_world_base @ T_base_camera
        rgb = render_view(self._around.model, frame.camera, T_world_camera, "rgb")
        depth = render_view(self._around.model, frame.camera, T_world_camera, "depth")
        used = np.ones(depth.shape, np.bool_) if frame.mask is None else frame.mask
        sensor = np.where(used, np.nan_to_num(frame.depth, nan=0.0, posinf=0.0), np.float32(0)).astype(np.float32)
        rows, columns = _grid(frame.camera)
        coarse = np.ix_(rows, columns)
        rays = pixel_rays(frame.camera, rows, columns)
        shapes = cast(self.world.model, self._data, rays, T_base_camera, CONSTANTS.max_range)[1].astype(np.float32)
        points = _points(sensor, frame.camera, T_base_camera)
        part = np.where(self._around.inside(points), sensor, np.float32(0))
        above = self._around.above_support(points) & (sensor > 0)
        twin_above = self._around.above_support(_points(depth, frame.camera, T_base_camera)) & (depth > 0)
        physics = self._around.above_support(_points(shapes, frame.camera, T_base_camera, rows, columns)) & (shapes > 0)
        whole, physical = depth_error(depth, sensor), depth_error(shapes, part[coarse])
        found = ViewAgreement(
            index=frame.index,
            held_out=held_out,
            psnr_db=psnr(rgb[used], frame.rgb[used]),
            depth_l1_m=whole.l1,
            depth_median_m=whole.median,
            coverage=whole.coverage,
            part_l1_m=depth_error(depth, part).l1,
            physics_l1_m=physical.l1,
            physics_coverage=physical.coverage,
            iou=overlap(above, twin_above, sensor > 0),
            physics_iou=overlap(above[coarse], physics, sensor[coarse] > 0),
            camera_m=None if gap is None else gap[0],
            camera_rad=None if gap is None else gap[1],
        )
        known = self._around.support is not None
        seen = SeenView(
            frame.rgb,
            sensor,
            colorize(rgb, "rgb"),
            depth,
            shapes,
            above if known else None,
            twin_above & (sensor > 0) if known else None,
        )
        return found, seen


def overlap(a: Mask, b: Mask, among: Mask) -> float | None:
    """Compute the intersection over union of two masks among some pixels, or None if both are empty."""
    union = int(((a | b) & among).sum())
    return int((a & b & among).sum()) / union if union else None


def _grid(camera: Camera) -> tuple[Pixels, Pixels]:
    step = max(1, camera.width // CONSTANTS.rays)
    return np.arange(step // 2, camera.height, step), np.arange(step // 2, camera.width, step)


def _points(
    depth: NDArray[np.float32],
    camera: Camera,
    T_base_camera: Array,
    rows: Pixels | None = None,
    columns: Pixels | None = None,
) -> Array:
    """Backproject a depth image, at all pixels or the given ones, to points (h, w, 3) in the base frame [m]."""
    return transform_points(T_base_camera, pixel_rays(camera, rows, columns) * depth[..., None].astype(np.float64))


def _reach(robot: RobotModel) -> tuple[Array, float]:
    """Return the position (3,) of the arm's second joint at home, and the tool's largest distance from it [m]."""
    shoulder = np.asarray(robot.fk(robot.home)[min(2, len(robot)), :3, 3])
    tools = robot.tcp(robot.random(2000, np.random.default_rng(0)))[:, :3, 3]
    return shoulder, float(np.linalg.norm(tools - shoulder, axis=1).max())
