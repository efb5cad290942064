"""Pictures of a map for people and programs: colour, depth, normals and opacity from any pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from splatbot.camera import Camera
from splatbot.errors import CameraError, InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, quat_to_rotation, transform_points
from splatbot.rasterize.maps import render_map

Mode = Literal["rgb", "depth", "normal", "alpha"]
MODES: tuple[Mode, ...] = ("rgb", "depth", "normal", "alpha")


@dataclass(frozen=True)
class RenderViewConstants:
    """Constants of rendered views.

    Args:
        min_alpha: below this opacity a pixel is more background than map: it has no depth and no normal.
        visible_share: fraction of the Gaussians that the default view shows; the rest are mostly floaters.
        near: [m] nearest that a Gaussian may be in the default view.
        rotation_tolerance: largest deviation of a pose's rotation from an orthogonal matrix.
    """

    min_alpha: float = 0.5
    visible_share: float = 0.9
    near: float = 0.05
    rotation_tolerance: float = 1e-3


CONSTANTS = RenderViewConstants()


def render_view(
    model: GaussianModel,
    camera: Camera,
    T_world_camera: ArrayLike,
    mode: Mode = "rgb",
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> NDArray[np.float32]:
    """Render the map for a pinhole camera at a pose.

    Args:
        model: the map; its harmonics, of any degree, colour it as seen from the pose.
        camera: intrinsics and size; without distortion.
        T_world_camera: (4, 4) rigid.
        mode: "rgb" (H, W, 3) in 0..1. "depth" (H, W) [m] along the optical axis, of the Gaussians' planes. "normal"
            (H, W, 3) unit vectors in the camera frame that face the camera. "alpha" (H, W) in 0..1. Depth and normal
            are 0 where alpha < 0.5.
        background: RGB in 0..1 behind the map ("rgb" only).

    Raises:
        InputError: the pose is not a rigid transform, or the mode is unknown.
        CameraError: the camera has distortion.
    """
    T_camera_world = inverse(_rigid(T_world_camera))
    _check_pinhole(camera)
    if mode == "rgb":
        rgb, alpha = _splat(model, None, camera, T_camera_world, "RGB")
        rgb += (1.0 - alpha[..., None]) * np.asarray(background, dtype=np.float32)
        return rgb.clip(0.0, 1.0)
    if mode == "depth":
        depth, alpha = _splat(model, None, camera, T_camera_world, "ED")
        return np.where(alpha >= CONSTANTS.min_alpha, depth[..., 0], np.float32(0))
    if mode == "normal":
        blended, alpha = _splat(model, facing_normals(model, T_camera_world), camera, T_camera_world, "RGB")
        length = np.linalg.norm(blended, axis=-1, keepdims=True)
        known = (alpha[..., None] >= CONSTANTS.min_alpha) & (length > 1e-6)
        return np.divide(blended, length, out=np.zeros_like(blended), where=known)
    if mode == "alpha":
        return _splat(model, None, camera, T_camera_world, "RGB")[1]
    raise InputError(f"is {mode!r}.", field="mode", hint=f"one of {', '.join(MODES)}")


def render_rgbd(
    model: GaussianModel, camera: Camera, T_world_camera: ArrayLike, *, sh_degree: int | None = None
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Render colour times opacity (H, W, 3), opacity (H, W) and depth (H, W) [m] of a map, in one pass and unfiltered.

    Args:
        model: the map.
        camera: intrinsics and size; without distortion.
        T_world_camera: (4, 4) rigid.
        sh_degree: degree of the harmonics that are evaluated. If None, that of the map.

    Raises:
        InputError: the pose is not a rigid transform.
        CameraError: the camera has distortion.
    """
    T_camera_world = inverse(_rigid(T_world_camera))
    _check_pinhole(camera)
    images, alpha = _splat(model, None, camera, T_camera_world, "RGB+ED", sh_degree)
    return np.ascontiguousarray(images[..., :3]), alpha, images[..., 3]


def facing_normals(model: GaussianModel, T_camera_world: ArrayLike) -> Tensor:
    """Return unit normals (N, 3) in the camera frame: each Gaussian's flattest axis, signed to face the camera."""
    T = np.asarray(T_camera_world, dtype=np.float64)
    axes = T[:3, :3] @ quat_to_rotation(model.quats.detach().numpy())
    flattest = model.log_scales.detach().argmin(dim=1).numpy()
    normals = axes[np.arange(len(model)), :, flattest]
    points = transform_points(T, model.means.detach().numpy())
    away = (normals * points).sum(axis=-1, keepdims=True) > 0
    return torch.from_numpy(np.where(away, -normals, normals).astype(np.float32))


def default_view(
    model: GaussianModel, *, width: int = 640, height: int = 480, fov_deg: float = 60.0
) -> tuple[Camera, NDArray[np.float64]]:
    """Return a camera and pose T_world_camera (4, 4) that show a map whose poses are unknown.

    The camera keeps the world's axes; those of a mapped log are its first camera's (x right, y down, z forward). It
    looks at the opacity-weighted centre of mass from a distance along -z that has 90 % of the Gaussians' centres in
    view.

    Args:
        width, height: of the image [px].
        fov_deg: horizontal field of view [deg].

    Raises:
        InputError: the field of view is not between 0.001 and 180 degrees.
    """
    if not 1e-3 <= fov_deg < 180.0:  # narrower, the focal length overflows
        raise InputError(f"is {fov_deg}.", field="fov_deg", hint="give degrees between 0.001 and 180")
    focal = 0.5 * width / np.tan(np.radians(fov_deg) / 2)
    camera = Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    T_world_camera = np.eye(4)
    if len(model):
        means = model.means.detach().to(torch.float64).numpy()
        centre = np.average(means, axis=0, weights=model.opacities.detach().to(torch.float64).numpy())
        x, y, z = (means - centre).T
        half = np.stack(
            [np.abs(x) * focal / (0.5 * width), np.abs(y) * focal / (0.5 * height), np.full_like(x, CONSTANTS.near)]
        )
        backing = np.quantile(
            half.max(axis=0) - z, CONSTANTS.visible_share, method="higher"
        )  # distance at which each enters
        T_world_camera[:3, 3] = centre - np.array([0.0, 0.0, max(float(backing), CONSTANTS.near)])
    return camera, T_world_camera


def depth_limits(depth: NDArray[np.float32]) -> tuple[float, float]:
    """Return the range (near, far) [m] of 96 % of the known depths (H, W), or (0, 1) without any."""
    known = depth[depth > 0]
    if known.size == 0:
        return 0.0, 1.0
    near, far = np.percentile(known, (2, 98))
    return float(near), float(max(far, near + 1e-3))


def colorize(
    view: NDArray[np.float32], mode: Mode, *, depth_range: tuple[float, float] | None = None
) -> NDArray[np.uint8]:
    """Convert a view of :func:`render_view` to an image, (H, W, 3) RGB or, for "alpha", (H, W).

    Depth runs from red (near) to blue (far) over ``depth_range`` [m], by default :func:`depth_limits`; unknown is
    black. Normals are drawn as (x, -y, -z) → RGB, so that a surface facing the camera is light blue.
    """
    if mode == "depth":
        near, far = depth_range or depth_limits(view)
        share = np.clip((far - view) / max(far - near, 1e-9), 0.0, 1.0)
        image = cv2.applyColorMap(_bytes(share), cv2.COLORMAP_TURBO)[..., ::-1].astype(np.uint8)
        return np.where((view > 0)[..., None], image, np.uint8(0))
    if mode == "normal":
        known = np.abs(view).sum(-1, keepdims=True) > 0
        return np.where(known, _bytes(0.5 + 0.5 * view * np.array([1, -1, -1], dtype=np.float32)), np.uint8(0))
    return _bytes(view)


def to_png(view: NDArray[np.float32], mode: Mode, *, depth_range: tuple[float, float] | None = None) -> bytes:
    """Encode a view of :func:`render_view` as the bytes of an 8-bit PNG (see :func:`colorize`)."""
    image = colorize(view, mode, depth_range=depth_range)
    ordered = image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1])  # OpenCV writes BGR
    ok, encoded = cv2.imencode(".png", ordered)
    if not ok:
        raise InputError(f"of shape {image.shape} cannot be encoded.", field="image", hint="give at least 1x1 pixels")
    return encoded.tobytes()


def _splat(
    model: GaussianModel,
    features: Tensor | None,
    camera: Camera,
    T_camera_world: NDArray[np.float64],
    render_mode: Literal["RGB", "ED", "RGB+ED"],
    sh_degree: int | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Blend features (H, W, C), or the model's colours if None; return them with the opacity (H, W)."""
    with torch.no_grad():
        render = render_map(
            model,
            torch.as_tensor(T_camera_world, dtype=torch.float64),
            torch.as_tensor(camera.K_corner, dtype=torch.float64),
            camera.width,
            camera.height,
            features=features,
            degree=sh_degree,
            render_mode=render_mode,
        )
    return render.image.numpy(), render.alpha[..., 0].numpy()


def _check_pinhole(camera: Camera) -> None:
    if camera.distortion:
        raise CameraError(
            "is set, and views are pinhole.", field="distortion", hint="pass the camera with distortion=()"
        )


def _rigid(T: ArrayLike) -> NDArray[np.float64]:
    M = np.asarray(T, dtype=np.float64)
    hint = "give a rotation in the upper left (3, 3), metres in the last column, and (0, 0, 0, 1) as the last row"
    if M.shape != (4, 4) or not np.isfinite(M).all():
        raise InputError(f"is {M.shape} or not finite.", field="T_world_camera", hint=hint)
    R = M[:3, :3]
    off = max(float(np.abs(R @ R.T - np.eye(3)).max()), float(np.abs(M[3] - (0, 0, 0, 1)).max()))
    if off > CONSTANTS.rotation_tolerance or np.linalg.det(R) < 0:
        raise InputError(f"is no rigid transform (off by {off:.2g}).", field="T_world_camera", hint=hint)
    return M


def _bytes(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.rint(np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8)
