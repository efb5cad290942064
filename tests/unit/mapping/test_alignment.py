"""Alignment of two maps: their pose is known from the simulator, and maps without a common place are refused."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.geometry import inverse
from splatbot.logs import open_log
from splatbot.mapping.alignment import CONSTANTS, align_maps
from splatbot.mapping.keyframes import Keyframe
from splatbot.mapping.rigid_motion import move_keyframe
from splatbot.slam import Slam
from splatbot.tracking.nearby_keyframes import pose_distance
from tests.rgbd import small_config

Array = NDArray[np.float64]
CONFIG = small_config()


@cache
def _mapped(scene: str, query: str) -> tuple[tuple[Keyframe, ...], Array]:
    """Return the keyframes of a map, and the pose (4, 4) of its first camera in the scene."""
    log = open_log(f"synthetic:{scene}?frames=12&rate=4&width=160&height=120{query}")
    slam = Slam(CONFIG)
    for frame in log:
        slam.process(frame)
    slam.close()
    assert log.ground_truth is not None
    return tuple(slam.keyframes), log.ground_truth.T_world_camera[0]


def test_a_map_from_another_path_is_located_within_the_stated_deviation() -> None:
    (a, T_scene_a), (b, T_scene_b) = _mapped("tabletop", ""), _mapped("tabletop", "&trajectory=arm")
    shares: list[float] = []
    found = align_maps(a, b, CONFIG, shares.append)
    true = inverse(T_scene_a) @ T_scene_b
    moved, turned = pose_distance(true, found.T_a_b)
    assert pose_distance(np.eye(4), true)[0] > 0.05  # the first cameras are not at one place
    assert moved < 3 * np.sqrt(3) * found.sigmas[0] < 0.03
    assert turned < 3 * np.sqrt(3) * found.sigmas[1] < 0.03
    assert found.tried >= found.found >= len(found.located) >= CONSTANTS.least_agreeing
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_maps_of_different_places_are_refused() -> None:
    (a, _), (b, _) = _mapped("tabletop", ""), _mapped("room", "")
    with pytest.raises(InputError, match="are found in A") as caught:
        align_maps(a, b, CONFIG)
    assert caught.value.field == "overlap"


def test_keyframes_that_contradict_each_other_are_refused() -> None:
    (a, _), (b, _) = _mapped("tabletop", ""), _mapped("tabletop", "&trajectory=arm")
    torn = []
    for number, keyframe in enumerate(b):
        T = np.eye(4)
        T[0, 3] = 0.2 * number  # each keyframe claims another place
        torn.append(move_keyframe(keyframe, {keyframe.number: T}))
    with pytest.raises(InputError, match="agree on its pose") as caught:
        align_maps(a, torn, CONFIG)
    assert caught.value.field == "T_A_B"


def test_maps_of_too_few_keyframes_are_refused() -> None:
    (a, _) = _mapped("tabletop", "")
    with pytest.raises(InputError, match=r"B has 2 keyframes, 3 are needed\. Fix: record longer"):
        align_maps(a, a[:2], CONFIG)
    with pytest.raises(InputError, match="no keyframes with features"):
        align_maps(a, [], CONFIG)
