"""Reach of objects: the hand and the support on which an object stands."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.bench.tabletop import Block
from splatbot.gaussians import GaussianModel
from splatbot.geometry import frame_along, rotation_to_quat
from splatbot.grasping import object_reach
from splatbot.grasping.object_reach import out_of_reach
from splatbot.robots.panda import panda
from splatbot.segmentation import SegmentedMap, segment
from tests.unit.grasping.objects import colored

_ALL = object_reach._approaches


def block_on_table(height: float) -> SegmentedMap:
    block = Block((0.45, 0.10, height / 2), (0.10, 0.05, height), 0.4)
    return segment(colored({"block": block}, 24_000, {}), np.eye(4))


def only(monkeypatch: pytest.MonkeyPatch, axis: int) -> None:
    """Leave the approaches out in which this axis of the tool is not vertical."""
    monkeypatch.setattr(object_reach, "_approaches", lambda center: [T for T in _ALL(center) if abs(T[2, axis]) > 0.5])


def plane(height: float) -> GaussianModel:
    """Return a wide disc at a height [m], as the support plane of a scene.yaml."""
    return GaussianModel.from_activated(
        means=[[0.5, 0.0, height - 0.005]],
        quats=[rotation_to_quat(frame_along(np.array([0.0, 0.0, 1.0])))],
        scales=[[0.5, 0.5, 0.0025]],
        opacities=[0.99],
        colors=[[0.5, 0.5, 0.5]],
    )


def test_a_level_hand_may_not_be_in_the_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hand that is turned on its side reaches 104 mm down from the tool."""
    only(monkeypatch, axis=1)
    low, high = block_on_table(0.18), block_on_table(0.24)
    found = out_of_reach(low, low.objects[0], panda())
    assert found is not None
    assert "link 7 (after panda_joint7)" in found.reason
    assert out_of_reach(high, high.objects[0], panda()) is None


def test_from_above_the_fingers_may_be_in_the_support_and_the_rest_of_the_hand_may_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    only(monkeypatch, axis=2)
    low = block_on_table(0.02)
    assert out_of_reach(low, low.objects[0], panda()) is None
    assert out_of_reach(low, low.objects[0], panda(), solids=plane(0.0)) is None
    found = out_of_reach(low, low.objects[0], panda(), solids=plane(0.06))  # the fingers are 4 to 5 cm long
    assert found is not None
    assert "deep in the map" in found.reason
