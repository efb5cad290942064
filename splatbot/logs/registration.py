"""Colour of one camera at the pixels of a depth camera that has another size, lens or place."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.camera import Camera
from splatbot.errors import LogError
from splatbot.logs.undistort import check_size


class ColorRegistration:
    """Resamples colour images at the pixels of an undistorted depth camera.

    Each depth pixel is projected to the colour camera. A pixel without depth takes the colour of the point at infinity
    on its ray. A finer colour image is first reduced to the resolution of the depth camera, by areas.

    Occlusion is not resolved: a depth pixel that the colour camera does not see takes the colour in front of it.

    Args:
        color: undistorted colour camera.
        depth: undistorted depth camera.
        T_color_depth: (4, 4), points of the depth camera to those of the colour camera.
        unseen: pixels (H, W) of the undistorted colour image that its lens does not show. Depth there is dropped.

    Raises:
        CameraError: an image is too large.
    """

    def __init__(
        self,
        color: Camera,
        depth: Camera,
        T_color_depth: ArrayLike | None = None,
        *,
        unseen: NDArray[np.bool_] | None = None,
    ) -> None:
        for camera in (color, depth):
            check_size(camera)
        T = np.eye(4) if T_color_depth is None else np.asarray(T_color_depth, np.float64)
        self.color_size, self.depth_size = (color.width, color.height), (depth.width, depth.height)
        share = min(1.0, depth.fx / color.fx)
        self._reduced = color.resized(*(max(1, round(share * side)) for side in self.color_size))
        self._unseen = None
        if unseen is not None and unseen.any():
            self._unseen = self._resized(unseen.astype(np.uint8) * 255) > 0
        x = (np.arange(depth.width) - depth.cx) / depth.fx
        y = (np.arange(depth.height) - depth.cy) / depth.fy
        rays = np.stack([*np.meshgrid(x, y), np.ones((depth.height, depth.width))])
        # A point at depth z projects to K (R ray + t / z), up to scale; 1 / z is 0 at infinity.
        K = self._reduced.K
        self._infinite = np.tensordot(K @ T[:3, :3], rays, 1).astype(np.float32)
        self._parallax = (K @ T[:3, 3]).astype(np.float32)

    def register(
        self, rgb: NDArray[np.uint8], depth: NDArray[np.float32], source: object
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return colour (H, W, 3) at the depth pixels, and depth (H, W) [m] without the pixels outside of the colour.

        Args:
            rgb: image of the colour camera.
            depth: image of the depth camera [m], 0 where missing.
            source: name of the frame in errors.

        Raises:
            LogError: an image is not of its camera's size.
        """
        for field, image, size in (("colour size", rgb, self.color_size), ("depth size", depth, self.depth_size)):
            if (image.shape[1], image.shape[0]) != size:
                raise LogError(
                    f"is {image.shape[1]}x{image.shape[0]}, its camera is {size[0]}x{size[1]}.",
                    file=str(source),
                    field=field,
                    hint="give the intrinsics of this image size",
                )
        inverse_depth = np.zeros_like(depth)
        np.divide(1.0, depth, out=inverse_depth, where=depth > 0)
        x, y, z = self._infinite + self._parallax[:, None, None] * inverse_depth
        ahead = z > 1e-6
        z = np.where(ahead, z, 1.0)
        width, height = self._reduced.width, self._reduced.height
        u, v = (np.clip(np.where(ahead, a / z, -1.0), -1.0, n) for a, n in ((x, width), (y, height)))
        seen = (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)
        if self._unseen is not None:
            seen &= ~self._unseen[np.rint(v).astype(int).clip(0, height - 1), np.rint(u).astype(int).clip(0, width - 1)]
        at = u.astype(np.float32), v.astype(np.float32)
        color = cv2.remap(self._resized(rgb), *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(color, dtype=np.uint8), np.where(seen, depth, np.float32(0))

    def _resized(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Reduce an image of the colour camera to the resolution of the depth camera."""
        size = (self._reduced.width, self._reduced.height)
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
