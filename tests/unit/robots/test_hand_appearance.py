"""Pictures of the 2F-85: its pads are as far apart as the opening, on any arm, and damaged files are named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatbot.errors import FormatError
from splatbot.geometry import inverse, transform_points
from splatbot.robots import hand_appearance
from splatbot.robots.hand_appearance import hand_parts
from splatbot.robots.store import load_robot


@pytest.mark.parametrize("name", ["ur5e-2f85", "panda-2f85"])
@pytest.mark.parametrize("opening", [0.005, 0.04, 0.085])
def test_the_drawn_pads_are_as_far_apart_as_the_hand_is_open(name: str, opening: float) -> None:
    robot = load_robot(name)
    parts = hand_parts(robot, opening)
    assert parts
    corners = transform_points(
        inverse(robot.T_link_tcp), np.concatenate([part.triangles.reshape(-1, 3) for part in parts])
    )
    tips = corners[corners[:, 2] > corners[:, 2].max() - 0.01]
    gap = tips[tips[:, 1] > 0, 1].min() - tips[tips[:, 1] < 0, 1].max()
    assert gap == pytest.approx(opening, abs=3e-3)  # positions are stored every 3 mm
    assert {part.link for part in parts} == {len(robot)}


def test_a_hand_without_stored_meshes_has_no_parts() -> None:
    assert hand_parts(load_robot("panda"), None) is None
    assert hand_parts(replace(load_robot("ur5e-2f85"), gripper=None), None) is None


def test_damaged_meshes_are_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    file = tmp_path / "hand.npz"
    file.write_bytes(b"no archive")
    monkeypatch.setattr(hand_appearance, "_FILE", file)
    hand_appearance._stored.cache_clear()
    with pytest.raises(FormatError, match=r"hand\.npz.*holds no meshes"):
        hand_parts(load_robot("ur5e-2f85"), None)
    hand_appearance._stored.cache_clear()
