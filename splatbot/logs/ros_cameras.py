"""Colour and depth of ROS topics as images of one undistorted camera, whether one camera or two record them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.logs.registration import ColorRegistration
from splatbot.logs.undistort import Undistorter
from splatbot.protocols import Array

FindTransform = Callable[[str, str], Array | None]
"""Returns T_target_source (4, 4) [m] of two frames of TF, or None if no static transforms connect them."""


class CameraPair:
    """Removes the distortion of colour and depth, and puts colour of another camera at the pixels of depth.

    The undistorted images have the intrinsic matrices of the recorded ones. They show the middle of a fisheye image.

    Args:
        color: colour camera.
        depth: depth camera. If it equals the colour camera at the same place, images stay at their pixels.
        T_color_depth: (4, 4), points of the depth camera to those of the colour camera [m].

    Raises:
        CameraError: an image is too large.

    Attributes:
        camera: undistorted camera of the images: that of depth.
        one: whether colour and depth are of one camera.
    """

    def __init__(self, color: Camera, depth: Camera, T_color_depth: ArrayLike) -> None:
        self.color, self.depth, self.T_color_depth = color, depth, np.asarray(T_color_depth, np.float64)
        self._lens_of_color = Undistorter(color) if color.distortion else None
        self._lens_of_depth = self._lens_of_color
        if color != depth:
            self._lens_of_depth = Undistorter(depth) if depth.distortion else None
        self.camera = depth.pinhole
        self.one = color == depth and np.array_equal(self.T_color_depth, np.eye(4))
        unseen = self._lens_of_color.unseen if self._lens_of_color else None
        self._registration = (
            None if self.one else ColorRegistration(color.pinhole, self.camera, self.T_color_depth, unseen=unseen)
        )

    def images(
        self, rgb: NDArray[np.uint8], depth: NDArray[np.float32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return colour (H, W, 3) and depth (H, W) [m] at the pixels of ``camera``.

        Raises:
            InputError: an image is not of its camera's size.
        """
        for name, shape, camera in (("colour", rgb.shape, self.color), ("depth", depth.shape, self.depth)):
            if shape[:2] != (camera.height, camera.width):
                size = f"{shape[1]}x{shape[0]}, its camera_info {camera.width}x{camera.height}"
                hint = "publish the camera_info of these images; depth of another camera than colour has its own"
                raise InputError(f"is {size}.", field=f"{name} image", hint=hint)
        if self._lens_of_color is not None:
            rgb = self._lens_of_color.color(rgb)
        if self._lens_of_depth is not None:
            depth = self._lens_of_depth.depth(depth)
        return (rgb, depth) if self._registration is None else self._registration.register(rgb, depth, "frame")

    def mask(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return a mask (H, W) of the recorded images of one camera at the pixels of ``camera``."""
        return mask if self._lens_of_color is None else self._lens_of_color.mask(mask)


class RosCameras:
    """The cameras of colour and depth as their messages describe them, which may change.

    Attributes:
        color: colour camera, None while it is not known.

    Args:
        find_transform: of TF, between the frames of two cameras on one mount.
    """

    def __init__(self, find_transform: FindTransform) -> None:
        self.color: Camera | None = None
        self._depth: tuple[str, Camera] | None = None
        self._find_transform = find_transform
        self._pair: CameraPair | None = None

    def set_depth(self, camera: Camera, frame: str) -> None:
        """Keep a camera_info of depth, whose header names a frame of TF."""
        self._depth = frame, camera

    def pair(self, color_frame: str, depth_frame: str, *, same_size: bool) -> CameraPair:
        """Return the pair for images whose headers name frames of TF; the colour camera is known.

        Images of one size are of the colour camera if their frames are equal, or one is empty. Other depth has a camera
        of its own: a camera_info of its frame, and its place by TF.

        Raises:
            InputError: depth is of another camera, and its intrinsics or its place are not known.
            CameraError: an image is too large.
        """
        assert self.color is not None  # of the caller
        one_place = color_frame == depth_frame or not (color_frame and depth_frame)
        if one_place and same_size:
            return self._known(self.color, np.eye(4))
        where = f"is of {depth_frame or 'no frame'}, colour of {color_frame or 'no frame'}"
        if one_place and not (color_frame and depth_frame):
            hint = "name the frame of its camera in the header of each image"
            raise InputError(f"{where}, and of another size.", field="depth", hint=hint)
        if self._depth is None or self._depth[0] not in ("", depth_frame):
            known = "no camera_info" if self._depth is None else f"a camera_info of {self._depth[0]}"
            hint = "publish its camera_info and TF between both, or depth registered to colour with its frame_id"
            raise InputError(f"{where}, and depth has {known}.", field="depth", hint=hint)
        T = np.eye(4) if one_place else self._find_transform(color_frame, depth_frame)
        if T is None:
            hint = "publish it on /tf_static, or depth that is registered to colour with its frame_id"
            raise InputError(f"{where}, and static TF does not connect them.", field="depth", hint=hint)
        return self._known(self._depth[1], T)

    def _known(self, depth: Camera, T: Array) -> CameraPair:
        """Return the current pair if nothing changed, else a new one."""
        known, color = self._pair, self.color
        assert color is not None
        if known is None or (known.color, known.depth) != (color, depth) or not np.array_equal(known.T_color_depth, T):
            known = self._pair = CameraPair(color, depth, T)
        return known
