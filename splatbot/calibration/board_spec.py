"""Descriptions of boards, as `--board` takes them."""

from __future__ import annotations

from collections.abc import Callable

from splatbot.calibration.board import Board, CharucoBoard
from splatbot.calibration.marker_grid import MarkerGrid
from splatbot.errors import InputError

_KINDS: dict[str, Callable[[str], Board]] = {
    "charuco": CharucoBoard.parse,
    "apriltag": MarkerGrid.parse,
    "grid": MarkerGrid.parse,
}


def parse_board(text: str) -> Board:
    """Parse `charuco:...`, `apriltag:...` or `grid:...`.

    Raises:
        InputError: the text is no board, or a value is out of range.
    """
    kind = text.partition(":")[0]
    if kind not in _KINDS:
        hint = "write charuco:10x14:0.07:0.04, apriltag:6x6:0.088:0.0264 or grid:5x7:0.04:0.01 (docs/guide/boards.md)"
        raise InputError(f"is {text!r}.", field="board", hint=hint)
    return _KINDS[kind](text)
