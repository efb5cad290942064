"""A scan of the twin: discs where its surfaces are, without the arm."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree

from splatbot.bench.tabletop import Ball, Block
from splatbot.errors import InputError
from splatbot.sim.scan import scan
from splatbot.sim.scene import make_scene
from splatbot.sim.twin import Twin

pytest.importorskip("mujoco")

BOX, BALL = Block((0.5, 0.1, 0.05), (0.10, 0.06, 0.10)), Ball((0.5, -0.15, 0.04), 0.04)


def twin(*sensor: str) -> Twin:
    objects = [
        {"name": "table", "shapes": [{"kind": "plane"}]},
        {"name": "box", "shapes": [{"kind": "box", "size": list(BOX.size)}], "at": list(BOX.center), "movable": True,
         "color": [0.9, 0.1, 0.1]},
        {"name": "ball", "shapes": [{"kind": "sphere", "radius": BALL.radius}], "at": list(BALL.center),
         "movable": True},
    ]  # fmt: skip
    camera = {"at": [1.3, -0.7, 0.8], "look_at": [0.4, 0.0, 0.1], "sensor": list(sensor)}
    return Twin(make_scene({"name": "scanned", "objects": objects, "camera": camera}))


def off(points: np.ndarray) -> np.ndarray:
    """Return the distance [m] of points from the nearest surface."""
    table = points[:, 2]
    return np.abs(np.min([BOX.distance(points), BALL.distance(points), table], axis=0))


def test_discs_are_on_the_surfaces_and_cover_the_objects() -> None:
    model = scan(twin(), views=6, width=160)
    points = model.means.double().numpy()
    assert np.percentile(off(points), 99) < 1.5e-3  # means over 4 mm of a curve lie inside of it
    for solid, share in ((BOX, 0.9), (BALL, 0.5)):  # no camera sees the ball from below
        patches = solid.patches()
        surface = np.concatenate([p.at(*np.random.default_rng(0).uniform(0, [[p.width], [p.height]], (2, 200)))[0]
                                  for p in patches])  # fmt: skip
        surface = surface[surface[:, 2] > 0.01]
        away = KDTree(points).query(surface)[0]
        assert (away < 8e-3).mean() > share
    red = points[np.abs(model.colors.numpy() - [0.9, 0.1, 0.1]).max(axis=1) < 0.05]
    assert len(red) > 500
    assert np.abs(BOX.distance(red)).max() < 0.01


def test_the_arm_and_its_stand_are_not_in_it() -> None:
    points = scan(twin(), views=6, width=160).means.double().numpy()
    assert np.linalg.norm(points[:, :2], axis=1).min() > 0.19
    assert points[:, 2].max() < 0.12  # nothing is higher than the box


def test_noise_of_the_sensor_is_in_it_by_seed() -> None:
    clean, noisy, again = scan(twin(), views=2, width=96), *(scan(twin("depth_noise"), views=2, width=96) for _ in "ab")
    assert np.array_equal(noisy.means.numpy(), again.means.numpy())
    assert off(noisy.means.double().numpy()).mean() > 2 * off(clean.means.double().numpy()).mean()


def test_what_makes_no_sense_is_refused() -> None:
    with pytest.raises(InputError, match="no object to scan"):
        scan(Twin(make_scene({"name": "bare", "objects": [{"name": "table", "shapes": [{"kind": "plane"}]}]})))
    for wrong in ({"views": 0}, {"width": 8}, {"spacing": 0.0}):
        with pytest.raises(InputError, match="out of range"):
            scan(twin(), **wrong)
