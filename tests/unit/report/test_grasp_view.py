"""Views of a grasp: the contacts are visible although the hand is in front of them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.grasping.types import Grasp
from splatbot.report.annotations import legend_size
from splatbot.report.grasp_view import _IMPLIED, _LEGEND, _MEASURED, grasp_png
from splatbot.report.robot_drawing import DrawnPart
from tests.unit.grasping.objects import BOX, scene, target_of

_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
_FACES = np.array(
    [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]
)  # fmt: skip


def _hand_around_the_target() -> DrawnPart:
    """Return a closed box of 24 cm around the tool, which hides target and contacts from each side."""
    return DrawnPart(0, 0.12 * _CORNERS[_FACES], (0.6, 0.6, 0.6))


def _grasp() -> Grasp:
    T = np.eye(4)
    T[:3, 3] = BOX.center
    away = np.eye(4)
    away[:3, 3] = BOX.center + np.array([0.0, 0.0, 0.5])
    side = np.array([0.0, BOX.size[1] / 2, 0.0])
    return Grasp(
        T_world_tcp=T,
        width=BOX.size[1],
        opening=0.08,
        contacts=np.stack([BOX.center - side, BOX.center + side]),
        normals=np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]]),
        approach="top",
        terms={},
        total=0.5,
        clearance=0.01,
        T_world_pregrasp=away,
        depth_distance=np.array([0.0, np.inf]),
    )


def _pixels(image: NDArray[np.uint8], color: tuple[float, ...]) -> NDArray[np.int64]:
    """Return the pixels (N, 2) as (u, v) of a colour, without the legend."""
    near = np.abs(image.astype(float) - 255 * np.array(color)).max(axis=-1) < 12
    width, height = legend_size(_LEGEND)
    near[:height, :width] = False
    return np.argwhere(near)[:, ::-1]


def test_both_contacts_are_in_front_of_a_hand_that_encloses_them() -> None:
    rows = target_of(scene(), BOX, "box").rows
    encoded = grasp_png(scene(), rows, _grasp(), [_hand_around_the_target()], np.eye(4))
    decoded = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    image = decoded[..., ::-1].astype(np.uint8)
    measured, implied = _pixels(image, _MEASURED), _pixels(image, _IMPLIED)
    for left in (0, 640):  # the two views, in the middle of which are the contacts
        own = [found[(found[:, 0] >= left) & (found[:, 0] < left + 640)] for found in (measured, implied)]
        assert min(map(len, own)) > 60
        middle = (own[0].mean(axis=0) + own[1].mean(axis=0)) / 2
        np.testing.assert_allclose(middle, (left + 319.5, 239.5), atol=6.0)
        assert np.abs(own[0].mean(axis=0) - own[1].mean(axis=0)).max() > 8.0
