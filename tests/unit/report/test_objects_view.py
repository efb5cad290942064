"""Tests of splatbot.report.objects_view."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.grasping.object_list import list_objects
from splatbot.protocols import Array
from splatbot.report import objects_view
from splatbot.report.annotations import Color, with_legend, with_numbers
from splatbot.report.objects_view import CONSTANTS, drawn_objects, objects_png
from splatbot.robots.panda import panda
from tests.unit.grasping.objects import scene


def test_fragments_are_left_out_of_the_picture() -> None:
    found = list_objects(scene(), panda())
    small = replace(found[0], size=np.full(3, CONSTANTS.min_size - 1e-3))
    hanging = replace(found[1], on_support=False)
    wall = replace(found[2], structure="longer than 0.3 m")
    assert drawn_objects([small, hanging, wall, *found[3:]]) == list(found[3:])


def test_without_any_support_the_larger_pieces_are_drawn() -> None:
    found = [replace(item, on_support=False) for item in list_objects(scene(), panda())]
    assert drawn_objects(found) == found


def test_a_picture_of_more_objects_than_its_legend_has_rows_numbers_all_and_counts_those_without_a_row(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (item, *_), legends, numbers = list_objects(scene(), panda()), [], []

    def kept(image: NDArray[np.float32], rows: list[tuple[str, Color]]) -> NDArray[np.float32]:
        legends.append([text for text, _ in rows])
        return with_legend(image, rows)

    def counted(image: NDArray[np.float32], places: dict[int, Array], *rest: Any, **corner: Any) -> NDArray[np.float32]:
        numbers.append((list(places), corner["free_of"]))
        return with_numbers(image, places, *rest, **corner)

    monkeypatch.setattr(objects_view, "with_legend", kept)
    monkeypatch.setattr(objects_view, "with_numbers", counted)
    many = replace(scene(), objects=tuple(replace(scene().objects[item.number], number=k) for k in range(60)))
    found = [replace(item, number=k) for k in range(60)]
    objects_png(many, [*found, replace(item, number=0, on_support=False)])
    ((*named, more, pieces),), ((drawn, (_, tall)),) = legends, numbers
    assert more == f"and {60 - len(named)} more"
    assert pieces.startswith("1 pieces of structure, on no support or below 40 mm")
    assert drawn == list(range(60))
    assert tall <= 800


def test_the_picture_of_no_objects_is_still_drawn() -> None:
    image = cv2.imdecode(np.frombuffer(objects_png(scene(), []), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    assert image.shape == (800, 1280, 3)
