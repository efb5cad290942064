"""Calibration boards: their corners in images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.errors import InputError

Array = NDArray[np.float64]

MIN_CORNERS = 8
"""Least number of corners of a view that is used [1]: a pose has 6 unknowns, two of them for each corner."""
MAX_COUNT, MAX_LENGTH = 100, 10.0
"""Largest number of columns and of rows [1], and largest length [m] of a board's parts."""
_SPEC = "charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY][:legacy], as charuco:10x14:0.07:0.04"
_DICTIONARIES = ("4X4", "5X5", "6X6", "7X7")
_SIZES = (50, 100, 250, 1000)


@dataclass(frozen=True, eq=False)
class BoardView:
    """Corners of a board in one image.

    Args:
        points: (N, 3) corners in the frame of the board [m].
        pixels: (N, 2) the same corners in the image [px].
    """

    points: Array
    pixels: Array

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def usable(self) -> bool:
        """Return whether the corners determine a pose: 8 or more, not in one line."""
        if len(self) < MIN_CORNERS:
            return False
        spread = np.linalg.svd(self.points - self.points.mean(axis=0), compute_uv=False)
        return bool(spread[1] > 0.05 * spread[0])


class Board(Protocol):
    """A flat board with known corners."""

    def completed(self, image: NDArray[np.uint8]) -> Self:
        """Return the board with the properties that its description leaves open, as an image shows them.

        Raises:
            InputError: the image shows fewer than 8 corners.
        """
        ...

    def detect(self, image: NDArray[np.uint8]) -> BoardView:
        """Find the corners of an image (H, W) or (H, W, 3); without the board, 0 corners."""
        ...


@dataclass(frozen=True)
class CharucoBoard:
    """Chessboard with ArUco markers in its white squares.

    Args:
        columns, rows: numbers of squares.
        square: side of a square [m].
        marker: side of a marker [m].
        dictionary: dictionary of the markers, such as "5X5_1000". If empty, :meth:`completed` finds it.
        legacy: whether the pattern is that of OpenCV before 4.6, which differs for an even number of rows. If None,
            :meth:`completed` finds it.

    Raises:
        InputError: a value is out of range.
    """

    columns: int
    rows: int
    square: float
    marker: float
    dictionary: str = ""
    legacy: bool | None = None

    def __post_init__(self) -> None:
        if not (2 <= self.columns <= MAX_COUNT and 2 <= self.rows <= MAX_COUNT):
            raise InputError(
                f"has {self.columns}x{self.rows} squares.", field="board", hint=f"give 2 to {MAX_COUNT} each"
            )
        if not 0.0 < self.marker < self.square <= MAX_LENGTH:
            hint = "give both in metres, the marker smaller than the square"
            raise InputError(f"has squares of {self.square} and markers of {self.marker} m.", field="board", hint=hint)
        if self.dictionary and self.dictionary not in dictionaries():
            names = ", ".join(dictionaries())
            raise InputError(
                f"has the unknown dictionary {self.dictionary!r}.", field="board", hint=f"give one of {names}"
            )

    @classmethod
    def parse(cls, text: str) -> CharucoBoard:
        """Parse ``charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY][:legacy]`` with lengths in metres.

        Raises:
            InputError: the text is no board, or a value is out of range.
        """
        kind, *words = text.split(":")
        legacy = True if "legacy" in words[3:] else None
        rest = [word for word in words[3:] if word != "legacy"]
        try:
            columns, rows = (int(word) for word in words[0].lower().split("x"))
            square, marker = float(words[1]), float(words[2])
        except (IndexError, ValueError):
            kind = ""
            columns = rows = 0
            square = marker = 0.0
        if kind != "charuco" or len(rest) > 1:
            raise InputError(f"is {text!r}.", field="board", hint=f"write {_SPEC}")
        return cls(columns, rows, square, marker, rest[0].upper().removeprefix("DICT_") if rest else "", legacy)

    @property
    def complete(self) -> bool:
        """Return whether dictionary and pattern are known."""
        return bool(self.dictionary) and self.legacy is not None

    def completed(self, image: NDArray[np.uint8]) -> CharucoBoard:
        """Return the board with the dictionary and the pattern of which an image shows most corners.

        Raises:
            InputError: the image shows fewer than 8 corners in any of them.
        """
        if self.complete:
            return self
        needed = self.columns * self.rows // 2
        names = (self.dictionary,) if self.dictionary else dictionaries()
        patterns = (False, True) if self.legacy is None else (self.legacy,)
        markers = {name: self._markers(image, name, needed) for name in names}
        best = max(names, key=lambda name: markers[name])
        boards = [replace(self, dictionary=best, legacy=legacy) for legacy in patterns]
        corners = [len(board.detect(image)) for board in boards] if markers[best] else [0]
        if max(corners) >= MIN_CORNERS:
            return boards[int(np.argmax(corners))]
        raise InputError(
            f"is not in the image: it shows fewer than {MIN_CORNERS} of its corners.",
            field="board",
            hint="check the numbers of squares and the images, or name the dictionary (4X4_50, 5X5_1000, ...)",
        )

    def detect(self, image: NDArray[np.uint8]) -> BoardView:
        """Find the corners of an image (H, W) or (H, W, 3), to a fraction of a pixel; without the board, 0 corners.

        Raises:
            InputError: the board has no dictionary.
        """
        corners, ids, _, _ = self._detector.detectBoard(grey(image))
        if ids is None or corners is None:
            return BoardView(np.zeros((0, 3)), np.zeros((0, 2)))
        chosen = np.asarray(ids).reshape(-1)
        points = np.asarray(self._board.getChessboardCorners(), np.float64)[chosen]
        return BoardView(points, np.asarray(corners, np.float64).reshape(-1, 2))

    def _markers(self, image: NDArray[np.uint8], name: str, needed: int) -> int:
        """Return how many markers with the board's numbers an image shows, 0 if the dictionary has too few."""
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
        if len(dictionary.bytesList) < needed:
            return 0
        ids = cv2.aruco.ArucoDetector(dictionary).detectMarkers(grey(image))[1]
        return 0 if ids is None else int((np.unique(ids) < needed).sum())

    @cached_property
    def _board(self) -> Any:
        if not self.dictionary:
            raise InputError("has no dictionary.", field="board", hint=f"write {_SPEC}")
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, dictionary)
        board.setLegacyPattern(bool(self.legacy))
        return board

    @cached_property
    def _detector(self) -> Any:
        return cv2.aruco.CharucoDetector(self._board)


def dictionaries() -> tuple[str, ...]:
    """Return the names of the dictionaries, such as "4X4_50" and "APRILTAG_36h11"; small ones before large ones."""
    aruco = tuple(f"{bits}_{size}" for size in _SIZES for bits in _DICTIONARIES)
    return (*aruco, "ARUCO_ORIGINAL", "APRILTAG_36h11", "APRILTAG_25h9", "APRILTAG_16h5")


def grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the brightness (H, W) of an image (H, W) or (H, W, 3) RGB."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
