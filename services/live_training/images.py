"""Images of the page: photographs of a training, and its map from their poses or others."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.geometry import inverse
from splatbot.rasterize.maps import render_map
from splatbot.rasterize.native import one_torch_thread
from splatbot.services.live_training.requests import MAX_WIDTH, LiveRequest
from splatbot.training.images import ImageCache
from splatbot.training.session import TrainingSession

WIDTHS = (96, 128, 192, 256, 384, 512, 768, MAX_WIDTH)  # [px] of pictures, up to that of the photograph

_QUALITY = 85  # of JPEG
_COVERED_ALPHA = 0.5
_REDUCTIONS = (8, 4, 2)


@dataclass(frozen=True, eq=False)
class LivePicture:
    """The map from a pose.

    Args:
        image: (H, W, 3) RGB.
        pose: (4, 4) T_world_camera.
        distance: depth of the map in the middle of the image [m]; the extent of the scene where the map has none.
    """

    image: NDArray[np.uint8]
    pose: NDArray[np.float64]
    distance: float


def widths(session: TrainingSession, request: LiveRequest) -> list[int]:
    """Return the widths [px] that a picture of a request may have, ascending."""
    most = min(request.width, photographed_by(session, request.view).width)
    return [width for width in WIDTHS if width < most] + [most]


def draw(session: TrainingSession, request: LiveRequest, width: int) -> LivePicture:
    """Render the map as it is now; no random number is drawn.

    Args:
        session: the training.
        request: view and pose.
        width: of the image [px].
    """
    camera = _resized(photographed_by(session, request.view), width)
    viewmat = torch.from_numpy(_viewmat(session, request))
    model, background = session.trainer.model, session.options.shade
    with torch.no_grad(), one_torch_thread():
        render = render_map(
            model,
            viewmat,
            torch.from_numpy(camera.K_corner),
            camera.width,
            camera.height,
            background=background,
            render_mode="RGB+ED",
            antialiased=session.options.antialiased,
        )
        image = (255 * render.image[..., :3].clamp(0, 1)).round().to(torch.uint8).numpy()
        third = (
            slice(camera.height // 3, -(-2 * camera.height // 3)),
            slice(camera.width // 3, -(-2 * camera.width // 3)),
        )
        covered = render.image[..., 3][third][render.alpha[..., 0][third] > _COVERED_ALPHA]
        distance = float(covered.median()) if len(covered) else session.trainer.extent
    return LivePicture(image, inverse(viewmat.numpy()), distance)


def photograph(session: TrainingSession, request: LiveRequest) -> NDArray[np.uint8]:
    """Return the photograph (H, W, 3) RGB of a view, in front of the background of the training.

    Raises:
        SplatbotError: the image cannot be read.
    """
    images, index = _place(session, request.view)
    camera = images.views[index].camera
    width = min(request.width, camera.width)
    reduce = next((factor for factor in _REDUCTIONS if camera.width // factor >= width), 1)
    with one_torch_thread():
        image = images.photo(index, reduce).over(session.options.shade)
        pixels = (255 * image).round().to(torch.uint8).numpy()
    small = _resized(camera, width)
    return np.asarray(cv2.resize(pixels, (small.width, small.height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def photographed_by(session: TrainingSession, view: int) -> Camera:
    """Return the camera of a view, of the full size of its photograph."""
    images, index = _place(session, view)
    return images.views[index].camera


def jpeg(image: NDArray[np.uint8]) -> str:
    """Return an image (H, W, 3) RGB as JPEG in base64."""
    _, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return base64.b64encode(data.tobytes()).decode()


def up_direction(session: TrainingSession) -> list[float]:
    """Return the mean direction (3,) up in the training photographs; in the first one, if there is no mean."""
    ups = -np.stack([view.T_world_camera[:3, 1] for view in session.images.views])
    mean = ups.mean(0)
    up = mean if np.linalg.norm(mean) > 0.1 else ups[0]
    return [float(value) for value in up / np.linalg.norm(up)]


def _place(session: TrainingSession, view: int) -> tuple[ImageCache, int]:
    """Return the images that hold a view of a request, and its index in them."""
    count = len(session.images.views)
    return (session.images, view) if view < count else (session.held_out, view - count)


def _viewmat(session: TrainingSession, request: LiveRequest) -> NDArray[np.float64]:
    """Return T_camera_world (4, 4); that of a training view is the estimated one."""
    if request.pose is not None:
        return inverse(request.pose)
    images, index = _place(session, request.view)
    if images is session.images:
        return np.array(session.trainer.poses.viewmats[index].numpy())
    return inverse(images.views[index].T_world_camera)


def _resized(camera: Camera, width: int) -> Camera:
    return camera.resized(width, max(1, round(camera.height * width / camera.width)))
