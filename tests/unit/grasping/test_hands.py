"""Contacts of pads, against closed forms of circles in contact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatbot.grasping.antipodal import Pairs
from splatbot.grasping.hands import Hands, measure_hands, place_hands
from splatbot.grasping.surface import GraspSurface
from splatbot.protocols import Array, HandShape
from splatbot.robots.panda import panda
from splatbot.robots.robot import GripperGeometry
from splatbot.robots.shapes import Box

FRICTION = 0.5
RADIUS = 0.03
UP = np.array([0.0, 0.0, 1.0])


def _hand() -> HandShape:
    hand = panda().hand
    assert hand is not None
    return hand


def _ball(count: int = 1500) -> GraspSurface:
    """Return evenly distributed points of a ball around the origin (Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + np.sqrt(5.0)) * k
    n = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], axis=1)
    spread = np.full(count, 2e-3)
    none = np.zeros((count, 3, 3))
    return GraspSurface(RADIUS * n, n, none, spread, np.ones(count, np.bool_), np.full(count, 3e-4), np.zeros(3))


def _pairs(line: Array) -> Pairs:
    contacts = np.stack([-RADIUS * line, RADIUS * line])[None]
    return Pairs(contacts, contacts / RADIUS, np.ones(1), np.ones(1), np.zeros(1))


def _from_above(hand: HandShape, ahead: float, aside: float = 0.0) -> Hands:
    """Place a hand on the ball's diameter along y, the centre ``ahead`` of the tool and ``aside`` along x [m]."""
    pairs = _pairs(np.array([0.0, 1.0, 0.0]))
    hands = place_hands(pairs, hand, rolls=1, depths=1, up=UP, lowest=0.9)
    hands.T[:, :3, 3] = [aside, 0.0, ahead]
    return measure_hands(hands, pairs, _ball(), hand, retreat=0.1, n_sigma=1.0, friction=FRICTION)


@pytest.mark.parametrize("beyond", [-0.012, -0.006, 0.0, 0.003, 0.006, 0.009])
def test_a_round_finger_end_pushes_a_ball_out_as_two_circles_that_meet(beyond: float) -> None:
    """Their common normal lies on the line of their centres, inclined by asin(offset / sum of radii).

    The compliance of the pads spreads the contact, hence the tolerance.
    """
    hand = _hand()
    closure = _from_above(hand, hand.pad + beyond).closure[0]
    turned = np.arcsin(max(beyond, 0.0) / (RADIUS + hand.tip - hand.pad))
    assert closure == pytest.approx(1.0 - turned / np.arctan(FRICTION), abs=0.15)


@pytest.mark.parametrize("aside", [0.0, 0.003, 0.006])
def test_a_round_finger_pushes_a_ball_aside_that_is_not_before_its_middle(aside: float) -> None:
    hand = _hand()
    closure = _from_above(hand, hand.pad - 0.012, aside).closure[0]
    turned = np.arcsin(aside / (RADIUS + hand.width / 2))
    assert closure == pytest.approx(1.0 - turned / np.arctan(FRICTION), abs=0.1)


def test_pads_that_are_flat_to_their_tips_hold_there_as_well() -> None:
    flat = replace(_hand(), pad=_hand().tip, pad_width=_hand().width)
    assert _from_above(flat, flat.tip - 0.004).closure[0] > 0.85
    assert _from_above(_hand(), _hand().tip - 0.004).closure[0] < 0.6


def test_places_that_are_not_opposite_are_outside_of_the_cone() -> None:
    """Two blocks of points whose middles are offset along the fingers by 0.7 of their distance: 35 degrees."""
    hand = replace(_hand(), pad=_hand().tip, pad_width=_hand().width)
    z, x = (g.ravel() for g in np.meshgrid(np.linspace(-0.003, 0.003, 9), np.linspace(-0.006, 0.006, 9)))
    offset = 0.35 * 0.03
    sides = [np.stack([x, np.full(x.size, s * 0.015), z + s * offset], axis=1) for s in (-1.0, 1.0)]
    count = 2 * x.size
    normals = np.repeat([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]], x.size, axis=0)
    none, seen = np.zeros((count, 3, 3)), np.ones(count, np.bool_)
    points, spread, normal_std = np.concatenate(sides), np.full(count, 1e-3), np.full(count, 3e-4)
    surface = GraspSurface(points, normals, none, spread, seen, normal_std, np.zeros(3))
    contacts = 0.015 * np.array([[[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]]])
    pairs = Pairs(contacts, contacts / 0.015, np.ones(1), np.ones(1), np.zeros(1))
    hands = place_hands(pairs, hand, rolls=1, depths=1, up=UP, lowest=0.9)
    hands.T[:, :3, 3] = [0.0, 0.0, -0.01]
    closure = measure_hands(hands, pairs, surface, hand, retreat=0.1, n_sigma=1.0, friction=FRICTION).closure[0]
    assert closure == pytest.approx(1.0 - np.arctan(0.7) / np.arctan(FRICTION), abs=0.03)
    assert closure < 0.0


def test_a_finger_that_is_a_box_is_flat_to_its_tip() -> None:
    robot, T = panda(), np.eye(4)
    T[:3, 3] = [0.0, 0.006, 0.027]
    assert robot.gripper is not None
    gripper = GripperGeometry(robot.gripper.T_link_finger, 0.04, (Box(0, T, (0.02, 0.012, 0.054)),), hand=None)
    hand = replace(robot, gripper=gripper).hand
    assert hand is not None
    assert hand.pad == hand.tip
    assert hand.pad_width == hand.width
