"""A wide simulated scene: a textured floor, seen by cameras above it, of which each sees a small part."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.geometry import look_at

_RNG = np.random.default_rng(0)
_WAVES = _RNG.normal(size=(24, 2)) * np.geomspace(1.0, 25.0, 24)[:, None]  # [rad/m]
_PHASES = _RNG.uniform(0.0, 2 * np.pi, 24)
_WEIGHTS = _RNG.uniform(-0.25, 0.25, (24, 3))


def texture(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the colour (..., 3) of the floor at places (..., 2) [m]."""
    return np.asarray(np.clip(0.5 + np.sin(xy @ _WAVES.T + _PHASES) @ _WEIGHTS, 0.0, 1.0))


def write_wide_scene(
    folder: Path, *, points: int, side: float = 4.0, rows: int = 4, size: tuple[int, int] = (64, 48)
) -> Path:
    """Write a Nerfstudio scene with exact images.

    Args:
        folder: to write.
        points: number of points on the floor.
        side: of the square that the cameras look at [m].
        rows: number of rows of as many cameras, 1.5 m above the floor.
        size: of an image, width and height [px].
    """
    folder.mkdir(parents=True, exist_ok=True)
    width, height = size
    focal = 0.75 * width
    u, v = np.meshgrid(np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2)
    frames: list[dict[str, object]] = []
    for x in np.linspace(0.1 * side, 0.9 * side, rows):
        for y in np.linspace(0.1 * side, 0.9 * side, rows):
            eye = np.array([x, y, 1.5])
            T = look_at(eye, np.array([x + 0.3 * np.cos(9 * x + y), y + 0.3 * np.sin(9 * x + y), 0.0]))
            rays = np.stack([u / focal, v / focal, np.ones_like(u)], axis=-1) @ T[:3, :3].T
            rgb = texture(eye[:2] - eye[2] / rays[..., 2:] * rays[..., :2])
            name = f"{len(frames):03d}.png"
            cv2.imwrite(str(folder / name), np.rint(255 * rgb[..., ::-1]).astype(np.uint8))
            frames.append({"file_path": name, "transform_matrix": (T @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()})
    camera = {"fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2, "w": width, "h": height}
    (folder / "transforms.json").write_text(json.dumps({**camera, "ply_file_path": "points.ply", "frames": frames}))
    _write_points(folder / "points.ply", points, side)
    return folder


def _write_points(file: Path, count: int, side: float) -> None:
    rng = np.random.default_rng(1)
    rows = np.zeros(count, [(axis, "<f4") for axis in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")])
    xy = rng.uniform(-0.2 * side, 1.2 * side, (count, 2))
    rows["x"], rows["y"] = xy.T
    rows["z"] = rng.normal(scale=0.002, size=count)
    for name, channel in zip(("red", "green", "blue"), np.rint(255 * texture(xy)).astype(np.uint8).T, strict=True):
        rows[name] = channel
    properties = [f"property float {axis}" for axis in "xyz"]
    properties += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *properties, "end_header"]
    file.write_bytes("\n".join([*header, ""]).encode() + rows.tobytes())
