"""The bodies of a twin rendered by MuJoCo, with antialiased edges and depth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import NativeError
from splatbot.protocols import Array
from splatbot.sim.view import TwinView
from splatbot.sim.world import BODY_GROUP, MAP_GROUP, World


@dataclass(frozen=True)
class BodiesViewConstants:
    """Constants of views of bodies.

    Args:
        supersampling: samples along a pixel's side.
        background: fraction of the far plane's distance beyond which a sample is background.
        same_surface: relative difference of depth within one surface in a pixel.
    """

    supersampling: int = 2
    background: float = 0.999
    same_surface: float = 0.02


CONSTANTS = BodiesViewConstants()


class BodiesView:
    """MuJoCo's renderer with a general pinhole camera.

    Each pixel is the mean of 2 x 2 samples, each of which is known to hit a body or not. MuJoCo's own multisampling
    would mix edges with the background colour.

    Args:
        world: a compiled scene.
        camera: any pinhole.
        map_too: also draw the collision geometry of the map.

    Raises:
        NativeError: rendering is not available on this machine.
    """

    def __init__(self, world: World, camera: Camera, *, map_too: bool) -> None:
        self.camera, self._of_robot, m = camera, world.of_robot, world.model
        width, height = CONSTANTS.supersampling * camera.width, CONSTANTS.supersampling * camera.height
        m.vis.global_.offwidth, m.vis.global_.offheight = width, height
        m.vis.quality.offsamples = 0
        self._far = CONSTANTS.background * float(m.vis.map.zfar * m.stat.extent)
        self._shown = mujoco.MjvOption()
        self._shown.geomgroup[MAP_GROUP] = int(map_too)
        self._shown.geomgroup[BODY_GROUP] = 0
        self._own = mujoco.MjData(m) if world.for_views else None
        self._shown.sitegroup[:] = 0  # markers such as that of the tool, which a real camera does not see
        try:
            self._renderer = mujoco.Renderer(m, height, width)
        except Exception as error:  # EGL, OSMesa and GLFW raise different types
            raise NativeError(
                f"MuJoCo cannot draw here: {error}.", field="camera", hint="install libegl1 and set MUJOCO_GL=egl"
            ) from error

    def view(self, data: Any, T_world_camera: Array) -> TwinView:
        """Render the bodies from a pose (4, 4)."""
        self._aim(data, T_world_camera)
        self._renderer.disable_depth_rendering()
        color = self._renderer.render().astype(np.float32) / 255.0
        self._renderer.enable_depth_rendering()
        depth = self._renderer.render().astype(np.float32)
        hit = depth < self._far
        alpha = _pixels(hit.astype(np.float32)).mean(axis=-1)
        shown = np.stack([_pixels(color[..., k] * hit).mean(axis=-1) for k in range(3)], axis=-1)
        return TwinView(shown, alpha, _nearest(_pixels(np.where(hit, depth, np.float32(np.inf)))), alpha)

    def robot(self, data: Any, T_world_camera: Array) -> NDArray[np.float32]:
        """Compute the fraction (H, W) of each pixel in which the robot is the foremost body, from a pose (4, 4)."""
        self._aim(data, T_world_camera)
        self._renderer.enable_segmentation_rendering()
        number, kind = np.moveaxis(self._renderer.render(), -1, 0)
        self._renderer.disable_segmentation_rendering()
        geom = kind == int(mujoco.mjtObj.mjOBJ_GEOM)
        return _pixels((geom & self._of_robot[np.where(geom, number, 0)]).astype(np.float32)).mean(axis=-1)

    def close(self) -> None:
        """Release the rendering context."""
        self._renderer.close()

    def _posed(self, own: Any, data: Any) -> Any:
        """Return data of a world for views at the positions of the simulated one."""
        own.qpos[:], own.mocap_pos[:], own.mocap_quat[:] = data.qpos, data.mocap_pos, data.mocap_quat
        m = self._renderer.model
        for place in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight, mujoco.mj_flex):
            place(m, own)
        return own

    def _aim(self, data: Any, T: Array) -> None:
        if self._own is not None:
            data = self._posed(self._own, data)
        self._renderer.update_scene(data, scene_option=self._shown)
        c = self.camera
        for eye in self._renderer.scene.camera:  # a stereo pair that MuJoCo averages
            near = eye.frustum_near
            eye.pos, eye.forward, eye.up = T[:3, 3], T[:3, 2], -T[:3, 1]
            eye.frustum_center = near * (0.5 * (c.width - 1) - c.cx) / c.fx
            eye.frustum_width = near * 0.5 * c.width / c.fx
            eye.frustum_top = near * (c.cy + 0.5) / c.fy
            eye.frustum_bottom = -near * (c.height - 0.5 - c.cy) / c.fy


def _pixels(samples: NDArray[np.float32]) -> NDArray[np.float32]:
    """Group the samples of each pixel: (H, W, 4)."""
    height, width = samples.shape[0] // CONSTANTS.supersampling, samples.shape[1] // CONSTANTS.supersampling
    grouped = samples.reshape(height, CONSTANTS.supersampling, width, CONSTANTS.supersampling).transpose(0, 2, 1, 3)
    return grouped.reshape(height, width, CONSTANTS.supersampling * CONSTANTS.supersampling)


def _nearest(samples: NDArray[np.float32]) -> NDArray[np.float32]:
    """Average the depth (H, W) of the nearest surface among samples (H, W, S), so that no mean crosses an edge."""
    nearest = samples.min(axis=-1)
    same = samples <= (1.0 + CONSTANTS.same_surface) * nearest[..., None]
    total = np.where(same & np.isfinite(samples), samples, 0.0).sum(axis=-1)
    return np.where(np.isfinite(nearest), total / np.maximum(same.sum(axis=-1), 1), np.float32(np.inf)).astype(
        np.float32
    )
