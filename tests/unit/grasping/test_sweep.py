"""Room that a hand has in the map, against the distances between balls."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.collision import GaussianCollisionField
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, transform_points
from splatbot.grasping.hands import CONSTANTS as HANDS
from splatbot.grasping.hands import Hands
from splatbot.grasping.sweep import finger_clearance, swept_clearance
from splatbot.protocols import Array, HandShape
from splatbot.robots.panda import panda

OPENING, RADIUS = 0.04, 0.002  # [m] of the fingers; of the one ball in the map
T_WORLD_TCP = np.array([[0.0, 1.0, 0.0, 0.4], [1.0, 0.0, 0.0, 0.1], [0.0, 0.0, -1.0, 0.3], [0.0, 0.0, 0.0, 1.0]])


def _hands(count: int = 1) -> Hands:
    some = [np.zeros(count) for _ in range(4)]
    return Hands(np.tile(T_WORLD_TCP, (count, 1, 1)), np.zeros(count, np.int64), np.full(count, OPENING), *some)


def _ball(at: Array) -> GaussianCollisionField:
    """Return the field of one ball at a point of the tool's frame [m]."""
    model = GaussianModel.from_activated(
        means=transform_points(T_WORLD_TCP, at[None]),
        quats=np.array([[1.0, 0.0, 0.0, 0.0]]),
        scales=np.full((1, 3), RADIUS),
        opacities=np.array([0.95]),
        colors=np.full((1, 3), 0.5),
    )
    return GaussianCollisionField(model, n_sigma=1.0)


def _spheres() -> tuple[Array, Array]:
    """Return centres and radii of the spheres of hand and fingers in the tool's frame [m]."""
    spheres = panda().spheres(OPENING)
    own = spheres.link == len(panda().chain)
    return transform_points(inverse(panda().T_link_tcp), spheres.centers[own]), spheres.radii[own]


def _hand() -> HandShape:
    hand = panda().hand
    assert hand is not None
    return hand


@pytest.mark.parametrize("y", [0.0, 0.015, 0.021, 0.03, 0.06])
def test_room_of_the_fingers_is_that_of_their_balls_where_the_hand_takes_hold(y: float) -> None:
    at = np.array([0.0, y, -0.01])
    centers, radii = _spheres()
    away = np.linalg.norm(centers - at, axis=1) - radii - RADIUS
    expected = min(1e-3, away[centers[:, 2] > -_hand().palm].min())
    clearance = finger_clearance(panda(), _hands(3), _ball(at), _hand())
    np.testing.assert_allclose(clearance, expected, atol=1e-4)


def test_obstacles_at_the_palm_or_on_the_approach_are_left_to_the_sweep() -> None:
    for at in (np.array([0.0, 0.0, -_hand().palm - 0.02]), np.array([0.0, 0.03, -0.12])):
        assert finger_clearance(panda(), _hands(), _ball(at), _hand())[0] == 1e-3
        assert swept_clearance(panda(), _hands(), _ball(at), retreat=0.1)[0] < 0.0


def test_the_sweep_has_the_least_room_of_all_its_places() -> None:
    at, back = np.array([0.0, 0.045, -0.05]), np.linspace(0.0, 0.1, 5)
    centers, radii = _spheres()
    places = centers[None] - back[:, None, None] * [0.0, 0.0, 1.0]
    expected = min(HANDS.max_clearance, (np.linalg.norm(places - at, axis=2) - radii - RADIUS).min())
    assert swept_clearance(panda(), _hands(), _ball(at), retreat=0.1)[0] == pytest.approx(expected, abs=1e-4)


def test_no_hands_have_no_room() -> None:
    field = _ball(np.zeros(3))
    assert finger_clearance(panda(), _hands(0), field, _hand()).shape == (0,)
    assert swept_clearance(panda(), _hands(0), field, retreat=0.1).shape == (0,)
