"""Small scenes in the layouts of other programs, and marks whose places in the images are known."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from splatbot.geometry import look_at

WIDTH, HEIGHT = 160, 120

CAMERA_PARAMS: Mapping[str, Sequence[float]] = {
    "SIMPLE_PINHOLE": (140, 81, 58.5),
    "PINHOLE": (140, 133, 81, 58.5),
    "SIMPLE_RADIAL": (140, 81, 58.5, 0.12),
    "RADIAL": (140, 81, 58.5, -0.15, 0.05),
    "OPENCV": (140, 133, 81, 58.5, -0.12, 0.04, 0.004, -0.006),
    "OPENCV_FISHEYE": (140, 133, 81, 58.5, 0.05, -0.02, 0.01, -0.003),
    "FULL_OPENCV": (140, 133, 81, 58.5, 0.1, -0.05, 0.003, 0.004, 0.02, 0.08, 0.01, -0.01),
    "SIMPLE_RADIAL_FISHEYE": (140, 81, 58.5, 0.06),
    "RADIAL_FISHEYE": (140, 81, 58.5, 0.06, -0.03),
}
"""Parameters of each supported camera model of COLMAP."""

UNSUPPORTED_PARAMS: Mapping[str, Sequence[float]] = {
    "FOV": (140, 133, 81, 58.5, 0.4),
    "THIN_PRISM_FISHEYE": (140, 133, 81, 58.5, 0, 0, 0, 0, 0, 0, 0, 0),
}

RAYS = np.array([(x, y, 1.0) for x in (-0.4, -0.2, 0.0, 0.25, 0.4) for y in (-0.3, 0.0, 0.3)])
"""Directions (15, 3) of the marks in the camera frame."""


def colmap_scene(folder: Path, models: Mapping[str, Sequence[float]], *, text: bool = False) -> pycolmap.Reconstruction:
    """Write a COLMAP scene by pycolmap: an image for each camera model, and three points."""
    scene = pycolmap.Reconstruction()
    (folder / "images").mkdir(parents=True)
    for number, (model, params) in enumerate(models.items(), 1):
        camera = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=list(params), camera_id=number)
        scene.add_camera_with_trivial_rig(camera)
        T = np.linalg.inv(look_at(np.array([2.0, 0.3 * number, 1.0]), np.zeros(3)))
        image = pycolmap.Image(name=f"{model}.png", camera_id=number, image_id=number)
        scene.add_image_with_trivial_frame(image, pycolmap.Rigid3d(T[:3]))
        cv2.imwrite(str(folder / "images" / f"{model}.png"), marks_image(camera.img_from_cam(RAYS) - 0.5))
    for row in range(3):
        scene.add_point3D(np.array([row, 0.5, -0.25]), pycolmap.Track(), np.array([10, 20, 30 + row], np.uint8))
    model_folder = folder / "sparse" / "0"
    model_folder.mkdir(parents=True)
    if text:
        scene.write_text(model_folder)
    else:
        scene.write_binary(model_folder)
    return scene


def marks_image(pixels: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Draw bright marks at pixels (N, 2), whose centres are integers, on black."""
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    squares = [(u - x) ** 2 + (v - y) ** 2 for x, y in pixels]
    return np.rint(255 * np.exp(-np.array(squares) / 8).max(axis=0)).astype(np.uint8)


def mark_centers(image: NDArray[np.uint8], pixels: NDArray[np.float64], reach: int) -> NDArray[np.float64]:
    """Measure the centres (N, 2) of the marks near pixels (N, 2) of an image (H, W, 3)."""
    centers = []
    for x, y in np.rint(pixels).astype(int):
        part = image[y - reach : y + reach + 1, x - reach : x + reach + 1, 0].astype(np.float64)
        v, u = np.mgrid[y - reach : y + reach + 1, x - reach : x + reach + 1]
        centers.append(((u * part).sum() / part.sum(), (v * part).sum() / part.sum()))
    return np.array(centers)


def transforms_scene(folder: Path, name: str = "transforms.json", *, frames: int = 3, **values: Any) -> dict[str, Any]:
    """Write a scene of images r_0.png... that look at the origin, and return the content of its JSON file."""
    content: dict[str, Any] = {"camera_angle_x": 1.0, **values, "frames": []}
    stem = name.removesuffix(".json").removeprefix("transforms_")
    (folder / stem).mkdir(parents=True)
    for index in range(frames):
        cv2.imwrite(str(folder / stem / f"r_{index}.png"), np.full((HEIGHT, WIDTH, 3), 40 * index, np.uint8))
        T = look_at(np.array([2.0, 0.2 * index, 1.0]), np.zeros(3)) @ np.diag([1.0, -1.0, -1.0, 1.0])
        content["frames"].append({"file_path": f"./{stem}/r_{index}", "transform_matrix": T.tolist()})
    (folder / name).write_text(json.dumps(content))
    return content
