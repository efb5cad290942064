"""Legends, scale bars and numbers on rendered pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.protocols import Array


@dataclass(frozen=True)
class AnnotationConstants:
    """Constants of annotations.

    Args:
        row: [px] height of a row of a legend.
        font: scale of OpenCV's Hershey font.
        dim: brightness of the picture behind a legend, relative to the picture.
        badge: [px] least distance between two numbers along an axis.
        turns: places around a centre that are tried for a number, from inside to outside.
        ring: [px] radius of a ring.
        dot: [px] radius of the dot at the start of an arrow.
        bars: [m] lengths of which a scale bar takes the largest that fills at most a fifth of the width.
    """

    row: int = 22
    font: float = 0.5
    dim: float = 0.25
    badge: tuple[int, int] = (34, 26)
    turns: int = 2000
    ring: int = 14
    dot: int = 5
    bars: tuple[float, ...] = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01)


CONSTANTS = AnnotationConstants()

Color = tuple[float, float, float]
GREY: Color = (0.5, 0.5, 0.5)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_LIGHT, _DARK = (242, 242, 242), (25, 28, 32)


def with_legend(image: NDArray[np.float32], rows: Sequence[tuple[str, Color]]) -> NDArray[np.float32]:
    """Return an image (H, W, 3) in 0..1 with names and their colours in the upper left corner."""
    rows = fitting(rows, image.shape[0])
    width, height = legend_size(rows)
    marked = _bytes(image)
    corner = marked[:height, :width]
    corner[:] = (CONSTANTS.dim * corner).astype(np.uint8)
    for number, (name, color) in enumerate(rows):
        y = 24 + CONSTANTS.row * number
        cv2.line(marked, (14, y - 5), (38, y - 5), _shade(color), 5, cv2.LINE_AA)
        cv2.putText(marked, name, (46, y), _FONT, CONSTANTS.font, _LIGHT, 1, cv2.LINE_AA)
    return _floats(marked)


def over_legend(image: NDArray[np.float32], rows: Sequence[tuple[str, Color]]) -> NDArray[np.float32]:
    """Return an image (H, W, 3) in 0..1 on top of a band with names and their colours, which hides nothing of it."""
    band = np.zeros((legend_size(rows)[1], image.shape[1], 3), np.float32)
    return np.concatenate([image, with_legend(band, rows)])


def fitting(
    rows: Sequence[tuple[str, Color]], height: int, *, last: Sequence[tuple[str, Color]] = ()
) -> list[tuple[str, Color]]:
    """Return the rows of a legend that fit a picture's height [px], and then the rows ``last``.

    If some do not fit, a row counts them.
    """
    fits = max((height - 14) // CONSTANTS.row - len(last), 1)
    if len(rows) > fits:
        rows = [*rows[: fits - 1], (f"and {len(rows) - fits + 1} more", GREY)]
    return [*rows, *last]


def legend_size(rows: Sequence[tuple[str, Color]]) -> tuple[int, int]:
    """Return the width and height [px] of a legend."""
    width = max((cv2.getTextSize(name, _FONT, CONSTANTS.font, 1)[0][0] for name, _ in rows), default=0) + 58
    return width, CONSTANTS.row * len(rows) + 14


def with_scale(image: NDArray[np.float32], camera: Camera, depth: float, where: str) -> NDArray[np.float32]:
    """Return an image (H, W, 3) in 0..1 with a bar in its lower right corner that shows a length at a depth [m]."""
    most = camera.width / 5
    length = next((m for m in CONSTANTS.bars if camera.fx * m / depth <= most), CONSTANTS.bars[-1])
    pixels = round(camera.fx * length / depth)
    marked = _bytes(image)
    right, y = image.shape[1] - 20, image.shape[0] - 18
    text = f"{100 * length:g} cm {where}"
    wide = cv2.getTextSize(text, _FONT, CONSTANTS.font, 1)[0][0]
    corner = marked[y - 34 :, right - max(wide, pixels) - 16 :]
    corner[:] = (CONSTANTS.dim * corner).astype(np.uint8)
    cv2.rectangle(marked, (right - pixels, y - 1), (right, y + 1), _LIGHT, -1)
    cv2.putText(marked, text, (right - wide, y - 12), _FONT, CONSTANTS.font, _LIGHT, 1, cv2.LINE_AA)
    return _floats(marked)


def with_ring(image: NDArray[np.float32], place: tuple[float, float], color: Color) -> NDArray[np.float32]:
    """Return an image (H, W, 3) in 0..1 with a ring around a place (u, v) [px], in front of everything."""
    marked = _bytes(image)
    center = (round(place[0]), round(place[1]))
    for shade, width in ((_DARK, 6), (_shade(color), 3)):
        cv2.circle(marked, center, CONSTANTS.ring, shade, width, cv2.LINE_AA)
    return _floats(marked)


def with_arrows(image: NDArray[np.float32], arrows: Sequence[tuple[Array, Array, Color]]) -> NDArray[np.float32]:
    """Return an image (H, W, 3) in 0..1 with arrows in front of everything: from (u, v) with a dot, to (u, v) [px]."""
    marked = _bytes(image)
    for start, end, color in arrows:
        tail, head = ((round(float(u)), round(float(v))) for u, v in (start, end))
        for shade, wide in ((_DARK, 3), (_shade(color), 0)):
            cv2.arrowedLine(marked, tail, head, shade, 2 + wide, cv2.LINE_AA, tipLength=0.3)
            cv2.circle(marked, tail, CONSTANTS.dot + wide // 2, shade, -1, cv2.LINE_AA)
    return _floats(marked)


def with_numbers(
    image: NDArray[np.float32],
    places: Mapping[int, Array],
    colors: Mapping[int, Color],
    *,
    free_of: tuple[int, int] = (0, 0),
) -> NDArray[np.float32]:
    """Return an image (H, W, 3) in 0..1 with numbers at places (2,) [px]; crowded ones move aside, on a line.

    No number is in the upper left corner of the size ``free_of`` [px], which a legend covers.
    """
    marked = _bytes(image)
    apart = _apart(places, np.array([image.shape[1], image.shape[0]]), np.array(free_of))
    for number, at in apart.items():
        if np.abs(at - places[number]).max() > 1:
            ends = [tuple(int(x) for x in end.round()) for end in (places[number], at)]
            cv2.line(marked, ends[0], ends[1], _LIGHT, 1, cv2.LINE_AA)
    for number, at in apart.items():
        wide, tall = cv2.getTextSize(str(number), _FONT, CONSTANTS.font, 1)[0]
        left, bottom = round(float(at[0]) - wide / 2), round(float(at[1]) + tall / 2)
        cv2.rectangle(marked, (left - 4, bottom - tall - 4), (left + wide + 4, bottom + 4), _DARK, -1)
        cv2.rectangle(marked, (left - 4, bottom - tall - 4), (left + wide + 4, bottom + 4), _shade(colors[number]), 1)
        cv2.putText(marked, str(number), (left, bottom), _FONT, CONSTANTS.font, _LIGHT, 1, cv2.LINE_AA)
    return _floats(marked)


def _apart(places: Mapping[int, Array], size: Array, corner: Array) -> dict[int, Array]:
    """Return places [px] with the distance of a badge between them, each the first free one on a spiral.

    Args:
        places: wanted places (2,) [px]; those outside of the picture are left out.
        size: (2,) of the picture [px].
        corner: (2,) size of the upper left corner that stays free [px].
    """
    step = np.arange(CONSTANTS.turns)
    angle, radius = 2.4 * step, 4.0 * np.sqrt(step)  # golden angle
    spiral = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    taken: dict[int, Array] = {}
    badge = np.array(CONSTANTS.badge)
    for number, place in places.items():
        if not ((place >= 0) & (place < size)).all():
            continue
        tried = np.clip(place + spiral, badge / 2 + 2, size - badge / 2 - 2)
        others = np.array(list(taken.values())).reshape(-1, 2)
        free = (np.abs(tried[:, None] - others) >= badge).any(axis=2).all(axis=1)
        free &= (tried >= corner + badge / 2).any(axis=1)
        taken[number] = tried[int(np.argmax(free))]
    return taken


def _bytes(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.rint(255 * np.clip(image, 0.0, 1.0)).astype(np.uint8)  # OpenCV writes text into 8 bits only


def _floats(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    return image.astype(np.float32) / np.float32(255)


def _shade(color: Sequence[float]) -> tuple[int, int, int]:
    r, g, b = (round(255 * float(c)) for c in color)
    return r, g, b
