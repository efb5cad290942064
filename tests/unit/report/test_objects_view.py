"""Tests of splatbot.report.objects_view."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from splatbot.grasping.object_list import list_objects
from splatbot.report.objects_view import CONSTANTS, drawn_objects, objects_png
from splatbot.robots.panda import panda
from tests.unit.grasping.objects import scene


def test_fragments_are_left_out_of_the_picture() -> None:
    found = list_objects(scene(), panda())
    small = replace(found[0], size=np.full(3, CONSTANTS.min_size - 1e-3))
    hanging = replace(found[1], on_support=False)
    assert drawn_objects([small, hanging, *found[2:]]) == list(found[2:])


def test_without_any_support_the_larger_pieces_are_drawn() -> None:
    found = [replace(item, on_support=False) for item in list_objects(scene(), panda())]
    assert drawn_objects(found) == found


def test_the_picture_of_no_objects_is_still_drawn() -> None:
    image = cv2.imdecode(np.frombuffer(objects_png(scene(), []), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    assert image.shape == (800, 1280, 3)
