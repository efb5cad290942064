"""AprilTags in pictures."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.grasping.affordance import AffordanceError, ObservedView, TagHint
from splatbot.grasping.tags import FAMILIES, TagAffordance, find_tags
from tests.unit.grasping.objects import CAN, scene, target_of
from tests.unit.grasping.test_affordance import VIEW, _pixel


def _picture(number: int, at: tuple[float, float]) -> ObservedView:
    """Return a view with a grey image that contains a tag of 24 pixels."""
    rgb = np.full((240, 320, 3), 160, np.uint8)
    tag = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(FAMILIES["36h11"]), number, 24)
    u, v = round(at[0]) - 12, round(at[1]) - 12
    rgb[v - 4 : v + 28, u - 4 : u + 28] = 255
    rgb[v : v + 24, u : u + 24] = tag[:, :, None]
    return replace(VIEW, rgb=rgb)


def test_the_object_with_a_tag_is_found() -> None:
    at = _pixel((0.50, -0.15, 0.12))
    view = _picture(7, at)
    corners = find_tags(view)
    np.testing.assert_allclose(corners[7].mean(axis=0), at, atol=1.5)
    found = TagAffordance().locate(TagHint(7, (view,)), scene())
    assert (found.backend, found.label) == ("apriltag", "tag 7")
    assert found.number == target_of(scene(), CAN, "can").number


def test_another_tag_is_no_target_and_the_detected_tags_are_reported() -> None:
    view = _picture(7, _pixel((0.50, -0.15, 0.12)))
    with pytest.raises(AffordanceError, match="these tags are: 7"):
        TagAffordance().locate(TagHint(8, (view,)), scene())


def test_views_without_pictures_and_unknown_families_are_refused() -> None:
    with pytest.raises(InputError, match="no picture"):
        find_tags(VIEW)
    with pytest.raises(InputError, match="family"):
        find_tags(_picture(1, (100, 100)), "99h1")
