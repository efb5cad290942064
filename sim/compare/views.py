"""The twin's images at a log's recorded poses beside what the camera saw: colour, depth, and what stands up."""

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

ABOVE = 0.01  # [m] over the support from which something stands up; below is the sensor's noise
_OPAQUE = 0.3  # fainter Gaussians are no surface
_UNDER = 0.05  # [m] below the support that the twin still holds
_RAYS = 160  # across an image, of the physics' shapes
_MISSED = 20.0  # [m]; farther is nothing

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class ViewAgreement:
    """One frame against the twin. Figures are None where there is nothing to compare.

    Args:
        index: of the frame in the log.
        held_out: whether it was kept out of the map.
        psnr_db: of the Gaussians' colour.
        depth_l1_m, depth_median_m: difference of the Gaussians' depth to the sensor's over the whole image.
        coverage: share of the sensor's pixels for which the Gaussians have a depth.
        part_l1_m: the mean difference again, in the part of the scene that is simulated.
        physics_l1_m, physics_coverage: there, of the shapes that physics computes with.
        iou, physics_iou: of what stands above the support, as the Gaussians and the shapes have it.
        camera_m, camera_rad: the camera's recorded pose against the tracked one; None where it was not tracked.
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
    """The images of one frame: colour (H, W, 3) uint8, depth [m], what stands up; the shapes' are coarser.

    Args:
        rgb, depth: recorded.
        twin_rgb, twin_depth: rendered from the Gaussians.
        shape_depth: of the shapes of physics (h, w).
        stands, twin_stands: masks (H, W); None without a support.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    twin_rgb: NDArray[np.uint8]
    twin_depth: NDArray[np.float32]
    shape_depth: NDArray[np.float32]
    stands: Mask | None
    twin_stands: Mask | None


@dataclass(frozen=True, eq=False)
class Surroundings:
    """A map as the twin has it, in the frame of the arm's base.

    Args:
        model: the map.
        T_world_base: (4, 4).
        support: what things stand on, in the base's frame; None: no level plane is within reach.
        low, high: (3,) corners of the part of the map that the twin simulates [m].
        values: the scene's, as :func:`splatbot.sim.scene.make_scene` takes them.
    """

    model: GaussianModel
    T_world_base: Array
    support: Support | None
    low: Array
    high: Array
    values: dict[str, Any]

    def scene(self, robot: str | None = None) -> Scene:
        """The twin's scene, with an arm at the origin or without."""
        arm = None if robot is None else {"model": robot}
        return make_scene({**self.values, "robot": arm})

    def inside(self, points: Array) -> Mask:
        """Whether points (..., 3) in the base's frame are in the part that is simulated."""
        return np.asarray(((points >= self.low) & (points <= self.high)).all(axis=-1))

    def stands(self, points: Array) -> Mask:
        """Whether they are above the support, too."""
        if self.support is None:
            return np.zeros(points.shape[:-1], np.bool_)
        return np.asarray(self.inside(points) & (self.support.height(points) > ABOVE))


def surroundings(
    model: GaussianModel, file: Path, T_world_base: Array, robot: RobotModel, plane: Array | None = None
) -> Surroundings:
    """The part of a map within an arm's reach, and the level plane there.

    Args:
        model: the map.
        file: that it is in.
        T_world_base: (4, 4) of the arm.
        robot: the arm, whose reach bounds the part.
        plane: (n, d) that things stand on, n · p + d = 0 in the map's frame; None: it is sought.
    """
    T_base_world = inverse(T_world_base)
    points = transform_points(T_base_world, model.means.detach().double().numpy())
    shoulder, reach = _reach(robot)
    near = (np.linalg.norm(points - shoulder, axis=1) < reach) & (model.opacities.detach().numpy() >= _OPAQUE)
    if plane is None:
        support = find_support(points[near])
    else:
        support = given_support(points[near], plane[:3] @ T_world_base[:3, :3], -float(plane @ T_world_base[:, 3]))
    low, high = shoulder - reach, shoulder + reach
    if support is not None:
        low[2] = support.offset / support.normal[2] - _UNDER
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
    """Looks at the twin from where a log's camera was. The arm itself is left out of its images.

    Args:
        around: the map.
    """

    def __init__(self, around: Surroundings) -> None:
        self._around = around
        self.world: World = build_world(around.scene())
        self._data = mujoco.MjData(self.world.model)
        mujoco.mj_forward(self.world.model, self._data)

    def compare(
        self, frame: Frame, T_base_camera: Array, *, held_out: bool, gap: tuple[float, float] | None
    ) -> tuple[ViewAgreement, SeenView]:
        """A frame beside the twin's images from ``T_base_camera`` (4, 4); masked pixels are left out of the figures."""
        T_world_camera = self._around.T_world_base @ T_base_camera
        rgb = render_view(self._around.model, frame.camera, T_world_camera, "rgb")
        depth = render_view(self._around.model, frame.camera, T_world_camera, "depth")
        used = np.ones(depth.shape, np.bool_) if frame.mask is None else frame.mask
        sensor = np.where(used, np.nan_to_num(frame.depth, nan=0.0, posinf=0.0), np.float32(0)).astype(np.float32)
        rows, columns = _grid(frame.camera)
        coarse = np.ix_(rows, columns)
        rays = pixel_rays(frame.camera, rows, columns)
        shapes = cast(self.world.model, self._data, rays, T_base_camera, _MISSED)[1].astype(np.float32)
        points = _points(sensor, frame.camera, T_base_camera)
        part = np.where(self._around.inside(points), sensor, np.float32(0))
        stands = self._around.stands(points) & (sensor > 0)
        theirs = self._around.stands(_points(depth, frame.camera, T_base_camera)) & (depth > 0)
        physics = self._around.stands(_points(shapes, frame.camera, T_base_camera, rows, columns)) & (shapes > 0)
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
            iou=overlap(stands, theirs, sensor > 0),
            physics_iou=overlap(stands[coarse], physics, sensor[coarse] > 0),
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
            stands if known else None,
            theirs & (sensor > 0) if known else None,
        )
        return found, seen


def overlap(a: Mask, b: Mask, among: Mask) -> float | None:
    """Intersection over union of two masks among some pixels; None where both are empty."""
    union = int(((a | b) & among).sum())
    return int((a & b & among).sum()) / union if union else None


def _grid(camera: Camera) -> tuple[Pixels, Pixels]:
    step = max(1, camera.width // _RAYS)
    return np.arange(step // 2, camera.height, step), np.arange(step // 2, camera.width, step)


def _points(
    depth: NDArray[np.float32],
    camera: Camera,
    T_base_camera: Array,
    rows: Pixels | None = None,
    columns: Pixels | None = None,
) -> Array:
    """What a depth image, of all pixels or of those, shows (h, w, 3), in the base's frame [m]."""
    return transform_points(T_base_camera, pixel_rays(camera, rows, columns) * depth[..., None].astype(np.float64))


def _reach(robot: RobotModel) -> tuple[Array, float]:
    """Where the arm's second joint is at home (3,), and how far from there its tool gets [m]."""
    shoulder = np.asarray(robot.fk(robot.home)[min(2, len(robot)), :3, 3])
    tools = robot.tcp(robot.random(2000, np.random.default_rng(0)))[:, :3, 3]
    return shoulder, float(np.linalg.norm(tools - shoulder, axis=1).max())
