"""Grids of square markers: Kalibr's AprilTag grid, and OpenCV's ArUco grid board.

OpenCV finds the markers. Their corners are then the intersections of lines that are fitted to the edges. A corner alone
is rounded by the blur of the image, and the squares between Kalibr's tags touch it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.calibration.board import MAX_COUNT, MAX_LENGTH, MIN_CORNERS, BoardView, dictionaries, grey
from splatbot.errors import InputError

Array = NDArray[np.float64]

_SPECS = {
    "apriltag": "apriltag:COLUMNSxROWS:TAG:GAP[:FAMILY], as apriltag:6x6:0.088:0.0264:36h11",
    "grid": "grid:COLUMNSxROWS:MARKER:GAP[:DICTIONARY], as grid:5x7:0.04:0.01:6X6_250",
}
_APRILTAG = "APRILTAG_"
_BORDERS = (1, 2)
_SMALL = 2_000_000  # [px] of images that are searched at twice their size
_THRESHOLD = 15  # [1] OpenCV's adaptiveThreshConstant: parts tags from the black squares that touch their corners
_OFF_PLANE = 0.5  # [1] of the side of a marker, by which a corner may be off the plane of the others
_SAMPLES = np.linspace(-0.38, 0.38, 24)  # [1] places on an edge, away from its ends
_ACROSS = np.linspace(-1.0, 1.0, 25)  # [1] places across an edge, in units of the reach
_REACH = 0.7  # [1] of the width of border or gap, whichever is smaller
_REACH_PX = (1.5, 8.0)
_ROUNDS = 4


@dataclass(frozen=True)
class MarkerGrid:
    """Square markers in columns and rows, numbered from 0 along the rows.

    With ``kalibr``, marker 0 is at the lower left and rows follow upwards. The origin is its lower left corner, with x
    to the right and y upwards. Otherwise, as in OpenCV's GridBoard, marker 0 is at the upper left and rows follow
    downwards. The origin is then its upper left corner, with x to the right and y downwards.

    Args:
        columns, rows: numbers of markers.
        marker: side of a marker with its black border [m].
        gap: distance between markers [m].
        kalibr: whether rows follow upwards.
        dictionary: dictionary of the markers, such as "APRILTAG_36h11". If empty, :meth:`completed` finds it.
        border: width of the black border in bits, 1 or 2. If 0, :meth:`completed` finds it.
        turn: quarter turns by which each marker is printed from its place in OpenCV's dictionary. If None,
            :meth:`completed` finds it.

    Raises:
        InputError: a value is out of range.
    """

    columns: int
    rows: int
    marker: float
    gap: float
    kalibr: bool = False
    dictionary: str = ""
    border: int = 0
    turn: int | None = 0

    def __post_init__(self) -> None:
        if not (1 <= self.columns <= MAX_COUNT and 1 <= self.rows <= MAX_COUNT and self.columns * self.rows >= 2):
            hint = f"give 1 to {MAX_COUNT} each, 2 markers or more"
            raise InputError(f"has {self.columns}x{self.rows} markers.", field="board", hint=hint)
        if not (0.0 < self.marker <= MAX_LENGTH and 0.0 < self.gap <= MAX_LENGTH):
            hint = f"give both in metres, above 0 and up to {MAX_LENGTH:g}"
            raise InputError(f"has markers of {self.marker} and gaps of {self.gap} m.", field="board", hint=hint)
        if not self._names:
            known = ", ".join(dictionaries())
            named = self.dictionary or "any dictionary"
            hint = f"give one of {known}, with {self.columns * self.rows} markers or more"
            raise InputError(f"does not fit {named!r}.", field="board", hint=hint)

    @classmethod
    def parse(cls, text: str) -> MarkerGrid:
        """Parse ``apriltag:COLUMNSxROWS:TAG:GAP[:FAMILY]`` or ``grid:COLUMNSxROWS:MARKER:GAP[:DICTIONARY]``, in metres.

        Raises:
            InputError: the text is no such board, or a value is out of range.
        """
        kind, *words = text.split(":")
        try:
            columns, rows = (int(word) for word in words[0].lower().split("x"))
            marker, gap = float(words[1]), float(words[2])
            name = words[3] if len(words) == 4 else ""
        except (IndexError, ValueError):
            words = []
        if kind not in _SPECS or not 3 <= len(words) <= 4:
            spec = _SPECS.get(kind, " or ".join(_SPECS.values()))
            raise InputError(f"is {text!r}.", field="board", hint=f"write {spec}")
        if kind == "grid":
            return cls(columns, rows, marker, gap, dictionary=name.upper().replace("H", "h").removeprefix("DICT_"))
        family = name.upper().removeprefix(_APRILTAG).replace("H", "h").removeprefix("T") if name else ""
        return cls(columns, rows, marker, gap, True, _APRILTAG + family if family else "", turn=None)

    @property
    def complete(self) -> bool:
        """Return whether dictionary, border and turn are known."""
        return bool(self.dictionary and self.border) and self.turn is not None

    def completed(self, image: NDArray[np.uint8]) -> MarkerGrid:
        """Return the board with the dictionary, the border and the turn of which an image shows most corners.

        Raises:
            InputError: the image shows fewer than 8 corners in any of them.
        """
        if self.complete:
            return self
        borders = (self.border,) if self.border else _BORDERS
        # A small dictionary is the beginning of the larger ones of as many bits.
        smallest = {n if n.startswith(_APRILTAG) else n.partition("_")[0]: n for n in reversed(self._names)}
        boards = [replace(self, dictionary=d, border=b) for d, b in product(smallest.values(), borders)]
        # Without the correction of wrong bits, borders of another width are not read.
        best = max(boards, key=lambda board: len(board._markers(grey(image), corrected=False)[0]))
        turns = range(4) if self.turn is None else (self.turn,)
        turned = [replace(best, turn=turn) for turn in turns]
        corners = [len(board.detect(image)) for board in turned]
        if max(corners) >= MIN_CORNERS:
            return turned[int(np.argmax(corners))]
        raise InputError(
            f"is not in the image: it shows fewer than {MIN_CORNERS} of its corners.",
            field="board",
            hint="check the numbers of columns and rows and the images, or name the dictionary (36h11, 6X6_250, ...)",
        )

    def detect(self, image: NDArray[np.uint8]) -> BoardView:
        """Find the corners of an image (H, W) or (H, W, 3), to a fraction of a pixel; without the board, 0 corners.

        Markers whose number is not on the board, or that an image shows twice, are left out. So are those that are not
        in the plane of the others.

        Raises:
            InputError: the board has no dictionary, border or turn.
        """
        if not self.complete:
            raise InputError("is not complete.", field="board", hint="complete it with an image")
        shades = grey(image)
        ids, quads = self._markers(shades)
        points = self._points(ids)
        flat = _in_one_plane(points, quads)
        points, quads = points[flat], quads[flat]
        refined = refine_corners(shades, quads, _REACH * min(self.gap / self.marker, self.border / self._bits))
        size = np.array([shades.shape[1], shades.shape[0]])
        inside = ((refined > 0) & (refined < size - 1)).all(axis=(1, 2))  # False for NaN
        near = np.linalg.norm(refined - quads, axis=2).max(axis=1) < _OFF_PLANE * _sides(quads)
        good = inside & near
        return BoardView(points[good].reshape(-1, 3), refined[good].reshape(-1, 2))

    @property
    def _names(self) -> tuple[str, ...]:
        """Dictionaries that may be those of the board: with enough markers, and AprilTags for Kalibr's boards."""
        names = dictionaries() if not self.dictionary else (self.dictionary,)
        known = [n for n in names if n in dictionaries() and (n.startswith(_APRILTAG) or not self.kalibr)]
        return tuple(name for name in known if len(_dictionary(name).bytesList) >= self.columns * self.rows)

    @property
    def _bits(self) -> int:
        """Width of a marker in bits, with its border."""
        return int(_dictionary(self.dictionary).markerSize) + 2 * self.border

    def _markers(self, shades: NDArray[np.uint8], *, corrected: bool = True) -> tuple[NDArray[np.intp], Array]:
        """Return numbers (M,) of the board's markers that an image shows once, and their corners (M, 4, 2) [px]."""
        scale = 2 if shades.size <= _SMALL else 1
        stretched = cv2.normalize(shades, None, 0, 255, cv2.NORM_MINMAX)  # type: ignore[call-overload]
        large = cv2.resize(stretched, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits, parameters.adaptiveThreshConstant = self.border, _THRESHOLD
        if not corrected:
            parameters.errorCorrectionRate = parameters.maxErroneousBitsInBorderRate = 0.0
        quads, found, _ = cv2.aruco.ArucoDetector(_dictionary(self.dictionary), parameters).detectMarkers(large)
        ids = np.zeros(0, np.intp) if found is None else np.asarray(found, np.intp).reshape(-1)
        corners = (np.asarray(quads, np.float64).reshape(-1, 4, 2) + 0.5) / scale - 0.5
        numbers, first, count = np.unique(ids, return_index=True, return_counts=True)
        once = first[(count == 1) & (numbers < self.columns * self.rows)]
        return ids[once], corners[once]

    def _points(self, ids: NDArray[np.intp]) -> Array:
        """Return the corners (M, 4, 3) [m] of markers, in the order of OpenCV's detector."""
        row, column = np.divmod(ids, self.columns)
        origin = np.stack([column, row], axis=1)[:, None] * (self.marker + self.gap)
        clockwise = [[0, 1], [1, 1], [1, 0], [0, 0]] if self.kalibr else [[0, 0], [1, 0], [1, 1], [0, 1]]
        corners = origin + self.marker * np.roll(clockwise, -(self.turn or 0), axis=0)
        return np.concatenate([corners, np.zeros_like(corners[..., :1])], axis=2)


def refine_corners(shades: NDArray[np.uint8], quads: Array, reach: float) -> Array:
    """Return the corners (M, 4, 2) [px] of dark quadrangles as intersections of lines that are fitted to their edges.

    Across an edge, its place is the mean that is weighted by the squared rise of brightness outwards. A line through
    the places follows, with less weight for those far from it.

    Args:
        shades: image (H, W).
        quads: corners (M, 4, 2) [px], clockwise.
        reach: distance from an edge that is searched, as a share [1] of the shortest side.
    """
    if not len(quads):
        return quads
    image, along = shades.astype(np.float32), _SAMPLES[None, None]
    for _ in range(_ROUNDS):
        starts, ends = quads, np.roll(quads, -1, axis=1)
        edges = ends - starts
        u = edges / np.maximum(np.linalg.norm(edges, axis=2, keepdims=True), 1e-9)
        outwards = np.stack([u[..., 1], -u[..., 0]], axis=-1)
        offsets = np.clip(reach * _sides(quads), *_REACH_PX)[:, None] * _ACROSS  # (M, A)
        middles = 0.5 * (starts + ends)
        places = middles[:, :, None] + _SAMPLES[None, None, :, None] * edges[:, :, None]  # (M, 4, K, 2)
        at = places[:, :, :, None] + offsets[:, None, None, :, None] * outwards[:, :, None, None]
        x, y = np.moveaxis(at.reshape(len(quads), -1, 2).astype(np.float32), -1, 0)
        values = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).reshape(at.shape[:-1])
        rise = np.maximum(np.gradient(values, axis=-1), 0.0) ** 2 + 1e-9
        place = (rise * offsets[:, None, None]).sum(axis=-1) / rise.sum(axis=-1)  # (M, 4, K)
        centre, slope = _robust_line(np.broadcast_to(along, place.shape), place)
        a = starts + outwards * (centre - 0.5 * slope)[..., None]
        b = ends + outwards * (centre + 0.5 * slope)[..., None]
        lines = np.cross(_homogeneous(a), _homogeneous(b))
        crossing = np.cross(np.roll(lines, 1, axis=1), lines)
        with np.errstate(divide="ignore", invalid="ignore"):
            quads = crossing[..., :2] / crossing[..., 2:]
        if not np.isfinite(quads).all():
            quads = np.where(np.isfinite(quads).all(axis=(1, 2), keepdims=True), quads, starts)
    return quads


def _robust_line(x: Array, y: Array) -> tuple[Array, Array]:
    """Fit y = centre + slope x along the last axis, with less weight for values far from the line."""
    weight = np.ones_like(y)
    for _ in range(3):
        total = weight.sum(axis=-1)
        mx, my = (weight * x).sum(axis=-1) / total, (weight * y).sum(axis=-1) / total
        dx = x - mx[..., None]
        slope = (weight * dx * (y - my[..., None])).sum(axis=-1) / (weight * dx**2).sum(axis=-1)
        centre = my - slope * mx
        error = np.abs(y - centre[..., None] - slope[..., None] * x)
        scale = 1.4826 * np.median(error, axis=-1, keepdims=True) + 0.02
        weight = 1.0 / np.maximum(1.0, error / scale) ** 2
    return centre, slope


def _in_one_plane(points: Array, quads: Array) -> NDArray[np.bool_]:
    """Return which markers (M,) are at their places in the plane that most of them agree on."""
    if len(quads) < 2:
        return np.ones(len(quads), bool)
    source, target = points[..., :2].reshape(-1, 2), quads.reshape(-1, 2)
    limit = _OFF_PLANE * float(np.median(_sides(quads)))
    _, inside = cv2.findHomography(source, target, cv2.RANSAC, limit)
    if inside is None:
        return np.zeros(len(quads), bool)
    return np.asarray(inside.reshape(-1, 4).all(axis=1))


def _sides(quads: Array) -> Array:
    """Return the shortest side (M,) [px] of quadrangles (M, 4, 2)."""
    return np.asarray(np.linalg.norm(quads - np.roll(quads, -1, axis=1), axis=2).min(axis=1))


def _homogeneous(pixels: Array) -> Array:
    return np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1)


def _dictionary(name: str) -> Any:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
