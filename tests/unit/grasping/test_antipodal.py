"""Pairs of contacts against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.grasping.antipodal import PairSearch, antipodal_pairs
from splatbot.grasping.shape_completion import target_surface
from splatbot.grasping.surface import GraspSurface
from tests.unit.grasping.objects import BALL, BIG, BOX, CAN, OBJECTS, scene, target_of

FRICTION = 0.5
UP = np.array([0.0, 0.0, 1.0])


def _surface(name: str) -> GraspSurface:
    return target_surface(scene(), target_of(scene(), OBJECTS[name], name).rows)


def _search(name: str, stroke: float = 0.08) -> PairSearch:
    return antipodal_pairs(_surface(name), stroke=stroke, friction=FRICTION, samples=400, up=UP)


@pytest.mark.parametrize("name", ["box", "can", "ball"])
def test_contacts_are_on_the_surface_within_a_millimetre_and_a_half(name: str) -> None:
    pairs = _search(name).pairs
    assert len(pairs) > 30
    off = np.abs(OBJECTS[name].distance(pairs.contacts.reshape(-1, 3)))
    assert np.percentile(off, 95) < 1.5e-3
    assert np.percentile(off, 99) < 3e-3


@pytest.mark.parametrize("name", ["box", "can", "ball"])
def test_the_line_between_contacts_lies_in_both_true_friction_cones(name: str) -> None:
    """Normals by central differences of the exact distance; 6 degrees are left for the Gaussians' spacing."""
    pairs = _search(name).pairs
    step = 1e-5 * np.eye(3)
    line = pairs.contacts[:, 1] - pairs.contacts[:, 0]
    line /= np.linalg.norm(line, axis=1, keepdims=True)
    solid = OBJECTS[name]
    for side, sign in ((0, -1.0), (1, 1.0)):
        at = pairs.contacts[:, side]
        true = np.stack([solid.distance(at + d) - solid.distance(at - d) for d in step], axis=1)
        true /= np.linalg.norm(true, axis=1, keepdims=True)
        angle = np.degrees(np.arccos(np.clip(sign * np.einsum("ij,ij->i", true, line), -1, 1)))
        assert np.percentile(angle, 95) < np.degrees(np.arctan(FRICTION)) + 6.0


def test_widths_are_those_of_the_shapes() -> None:
    box = _search("box").pairs
    assert np.median(np.abs(box.width[box.closure > 0.9] - BOX.size[1])) < 0.5e-3
    can = _search("can").pairs
    assert np.median(can.width[can.closure > 0.9]) == pytest.approx(2 * CAN.radius, abs=2e-3)
    ball = _search("ball").pairs
    assert np.median(ball.width[ball.closure > 0.9]) == pytest.approx(2 * BALL.radius, abs=3e-3)


def test_an_object_wider_than_the_stroke_has_no_pairs_and_its_width_is_reported() -> None:
    found = _search("big")
    assert len(found.pairs) == 0
    assert found.too_wide > 100
    assert found.narrowest == pytest.approx(BIG.size[0], abs=2e-3)


def test_a_slippery_surface_leaves_only_nearly_opposite_contacts() -> None:
    pairs = antipodal_pairs(_surface("ball"), stroke=0.08, friction=0.1, samples=400, up=UP).pairs
    middle = pairs.contacts.mean(axis=1)
    assert len(pairs)
    assert np.linalg.norm(middle - BALL.center, axis=1).max() < 0.1 * BALL.radius + 4e-3


@pytest.mark.parametrize("name", ["ball", "can"])
def test_a_chord_becomes_a_diameter(name: str) -> None:
    """A ball's middle, and a can's axis, lie on the line between opposite contacts."""
    pairs = _search(name).pairs
    middle = pairs.contacts.mean(axis=1)
    level = np.abs(pairs.contacts[:, 1, 2] - pairs.contacts[:, 0, 2]) < 0.2 * pairs.width
    if name == "can":
        off = np.linalg.norm((middle - CAN.foot)[level, :2], axis=1)
    else:
        off = np.linalg.norm(middle - BALL.center, axis=1)
    assert len(off) > 30
    assert np.median(off) < 0.7e-3
    assert np.percentile(off, 90) < 2.5e-3


def test_the_same_seed_gives_the_same_pairs() -> None:
    np.testing.assert_array_equal(_search("can").pairs.contacts, _search("can").pairs.contacts)


def test_a_map_ten_kilometres_from_its_origin_has_the_same_widths() -> None:
    surface = _surface("box")
    from dataclasses import replace

    far = np.array([1e4, -1e4, 0.0])
    moved = replace(surface, points=surface.points + far, center=surface.center + far)
    here, there = (
        antipodal_pairs(s, stroke=0.08, friction=FRICTION, samples=200, up=UP).pairs for s in (surface, moved)
    )
    assert len(here) == len(there)
    np.testing.assert_allclose(there.width, here.width, atol=1e-5)


def test_contacts_stay_on_the_observed_surface() -> None:
    """A band of a ball above its equator: the diameters that chords are turned to end below the band."""
    radius, (low, high) = 0.035, np.radians([8.0, 24.0])
    around = np.linspace(0.0, 2 * np.pi, 100, endpoint=False)
    turn, height = (a.ravel() for a in np.meshgrid(around, np.linspace(low, high, 6)))
    normals = np.stack([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)], axis=1)
    n = len(normals)
    band = GraspSurface(
        radius * normals,
        normals,
        np.full((n, 3, 3), 5e-4),
        np.full(n, 1e-3),
        np.ones(n, np.bool_),
        np.zeros(n),
        np.zeros(3),
    )
    pairs = antipodal_pairs(band, stroke=0.08, friction=FRICTION, samples=400, up=UP).pairs
    assert len(pairs) > 100
    off = np.linalg.norm(pairs.contacts.reshape(-1, 1, 3) - band.points, axis=2).min(axis=1)
    assert off.max() < 5e-3
    assert pairs.contacts[..., 2].min() > radius * np.sin(low) - 5e-3
