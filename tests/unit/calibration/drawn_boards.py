"""Boards that are drawn square by square, and photographed by casting a ray through each part of a pixel."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera

Array = NDArray[np.float64]
Bits = NDArray[np.bool_]

PART = 4  # rays a pixel, in each direction
CELLS = 280  # pixels of a drawing on the side of a marker: whole ones for each of 7, 8 or 10 bits
KALIBR_CODES = (
    *(0xD5D628584, 0xD97F18B49, 0xDD280910E, 0xE479E9C98, 0xEBCBCA822, 0xF31DAB3AC),
    *(0x056A5D085, 0x10652E1D4, 0x22B1DFEAD, 0x265AD0472, 0x34FE91B86, 0x3FF962CD5),
)
"""First tags of the family 36h11 as kalibr_create_target_pdf lists them."""


def kalibr_tag(number: int) -> Bits:
    """Return a tag (10, 10) as kalibr_create_target_pdf paints it, True where it is white.

    Bit 6 i + j of the code is row i and column j. They are turned by 180 degrees, in a border of two bits.
    """
    code = KALIBR_CODES[number]
    bits = np.array([[code >> (6 * i + j) & 1 for j in range(6)] for i in range(6)], bool)
    return np.pad(np.rot90(bits, 2), 2)


def aruco_marker(name: str, number: int, border: int = 1) -> Bits:
    """Return a marker of a dictionary of OpenCV, True where it is white."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
    side = dictionary.markerSize + 2 * border
    return np.asarray(cv2.aruco.generateImageMarker(dictionary, number, side, borderBits=border) > 0)


class Drawing:
    """A white sheet with markers; pixels of `unit` [m], x right and y down from its upper left corner."""

    def __init__(self, width: float, height: float, unit: float) -> None:
        self.unit = unit
        self.shades = np.full((round(height / unit), round(width / unit)), 255, np.uint8)

    def square(self, x: float, y: float, side: float, white: bool = False) -> None:
        """Paint a square whose upper left corner is at x, y [m]."""
        u, v, u1, v1 = (round(value / self.unit) for value in (x, y, x + side, y + side))
        self.shades[max(v, 0) : v1, max(u, 0) : u1] = 255 * white

    def marker(self, x: float, y: float, side: float, bits: Bits) -> None:
        """Paint a marker whose upper left corner is at x, y [m]."""
        self.square(x, y, side)
        cell = side / len(bits)
        for row, column in np.argwhere(bits):
            self.square(x + column * cell, y + row * cell, cell, white=True)


def kalibr_board(columns: int, rows: int, tag: float, gap: float) -> Drawing:
    """Draw Kalibr's grid: tag 0 at the lower left, rows upwards, black squares at the corners of all tags.

    The sheet has a margin of two gaps around the tags.
    """
    pitch = tag + gap
    drawing = Drawing(columns * pitch + 3 * gap, rows * pitch + 3 * gap, tag / CELLS)
    for number in range(columns * rows):
        x = 2 * gap + number % columns * pitch
        y = 2 * gap + (rows - 1 - number // columns) * pitch
        drawing.marker(x, y, tag, kalibr_tag(number))
        for dx, dy in ((-gap, -gap), (tag, -gap), (-gap, tag), (tag, tag)):
            drawing.square(x + dx, y + dy, gap)
    return drawing


def aruco_grid(columns: int, rows: int, side: float, gap: float, name: str, border: int = 1) -> Drawing:
    """Draw OpenCV's grid: marker 0 at the upper left, rows downwards, with a margin of two gaps."""
    pitch = side + gap
    drawing = Drawing(columns * pitch + 3 * gap, rows * pitch + 3 * gap, side / CELLS)
    for number in range(columns * rows):
        x, y = 2 * gap + number % columns * pitch, 2 * gap + number // columns * pitch
        drawing.marker(x, y, side, aruco_marker(name, number, border))
    return drawing


def photograph(
    drawing: Drawing,
    origin: tuple[float, float],
    T_camera_board: Array,
    camera: Camera,
    *,
    upwards: bool,
    noise: float = 2.0,
    seed: int = 0,
) -> NDArray[np.uint8]:
    """Return a photograph of a drawing with a lens of 0.7 px blur, and with noise.

    Args:
        drawing: the sheet.
        origin: origin of the board's frame on the sheet [m].
        T_camera_board: (4, 4) pose of the board's frame [m].
        camera: camera with distortion.
        upwards: whether y of the board's frame is up on the sheet.
        noise: standard deviation of the noise, of 255.
        seed: seed of the noise.
    """
    rays = _rays(camera)
    H = np.linalg.inv(T_camera_board[:3, [0, 1, 3]])
    on_board = np.stack([rays[..., 0] * h[0] + rays[..., 1] * h[1] + h[2] for h in H])
    x, y = on_board[0] / on_board[2], on_board[1] / on_board[2]
    u = (origin[0] + x) / drawing.unit - 0.5
    v = (origin[1] + (-y if upwards else y)) / drawing.unit - 0.5
    seen = cv2.remap(
        drawing.shades, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR, borderValue=(255, 255, 255)
    )
    small = cv2.resize(seen, (camera.width, camera.height), interpolation=cv2.INTER_AREA).astype(np.float64)
    blurred = 40.0 + 0.7 * cv2.GaussianBlur(small, (0, 0), 0.7)
    noisy = blurred + np.random.default_rng(seed).normal(0.0, noise, blurred.shape)
    return np.repeat(np.clip(np.rint(noisy), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


@lru_cache(maxsize=2)
def _rays(camera: Camera) -> NDArray[np.float32]:
    """Return the rays (H PART, W PART, 2) at z = 1 through the parts of all pixels."""
    u, v = ((np.arange(n * PART) + 0.5) / PART - 0.5 for n in (camera.width, camera.height))
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 1, 2)
    lens = np.array(camera.distortion) if camera.distortion else None
    rays = cv2.undistortPoints(pixels, camera.K, lens)
    return np.asarray(rays.reshape(len(v), len(u), 2), np.float32)
