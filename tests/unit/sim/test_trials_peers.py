"""The comparison stacks of trials: meshes and octrees by python-fcl, and paths from discrete configurations."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.gaussians import GaussianModel
from splatbot.logs.shapes import box
from splatbot.protocols import Array
from splatbot.robots.panda import panda
from splatbot.sim.trials.discrete import CONSTANTS as DISCRETE
from splatbot.sim.trials.discrete import connect, edge_free
from splatbot.sim.trials.run import TrialsPlan, run_trials
from splatbot.sim.trials.solid import SolidArm

pytest.importorskip("mujoco")
pytest.importorskip("fcl")

WALL = box([0.04, 0.6, 0.5]).placed([0.5, 0.0, 0.0])


def points_on_wall(spacing: float = 0.004) -> Array:
    y, z = np.meshgrid(np.arange(-0.3, 0.3, spacing), np.arange(0.0, 0.5, spacing))
    return np.concatenate([np.stack([np.full(y.size, x), y.ravel(), z.ravel()], axis=1) for x in (0.48, 0.52)])


def test_mesh_and_octree_say_what_the_field_says_away_from_the_surface() -> None:
    from splatbot.collision.fcl_models import fcl_mesh, fcl_octree

    rng = np.random.default_rng(0)
    own_body = panda()
    assert own_body.gripper is not None
    # The peers move the capsules of the twin. Spheres that are generated from these reach 8 mm beyond them at most.
    robot = replace(own_body, covering=None, slack=0.008, gripper=replace(own_body.gripper, covering=None))
    q = rng.uniform(robot.chain.lower, robot.chain.upper, (600, 7))
    points = points_on_wall()
    scales = np.tile([0.002, 0.002, 0.001], (len(points), 1))
    turned = np.tile([np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0], (len(points), 1))
    ones = np.full(len(points), 0.9)
    model = GaussianModel.from_activated(
        means=points, quats=turned, scales=scales, opacities=ones, colors=np.full((len(points), 3), 0.5)
    )
    field = GaussianCollisionField(model, 1.0)
    for geometry, slack in (
        (fcl_mesh(WALL.vertices, WALL.triangles.astype(np.int64)), 0.002),
        (fcl_octree(points, 0.01), 0.012),
    ):
        found = SolidArm(robot, np.eye(4), 0.04, geometry)
        free = found.free(q)
        wide = RobotSpheres(robot, opening=0.04, margin=slack)
        assert free[~wide.check(field, q).in_collision].all()
        room = RobotSpheres(robot, opening=0.04).clearance(field, q).distance
        own = RobotSpheres(robot, opening=0.04).check(None, q).in_collision
        deep = (room < -0.012) & ~own
        assert deep.sum() > 10
        assert not free[deep].any()
        assert not free[own].any()


def test_paths_from_single_configurations_go_around_and_none_is_found_through_a_wall() -> None:
    def free(q: Array) -> np.ndarray:
        return np.asarray((np.abs(q[:, 0]) > 0.2) | (q[:, 1] > 0.5))

    low, high = np.array([-1.0, -1.0]), np.array([1.0, 1.0])
    start, goal = np.array([-0.6, -0.5]), np.array([0.6, -0.5])
    path = connect(free, low, high, start, goal, seconds=5.0, seed=1)
    np.testing.assert_array_equal(path[[0, -1]], [start, goal])
    assert all(edge_free(free, a, b) for a, b in pairwise(path))
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    shortest = 2 * np.hypot(0.4, 1.0) + 0.4
    assert shortest - 4 * DISCRETE.resolution < length < 1.3 * shortest
    walled = connect(lambda q: np.abs(q[:, 0]) > 0.2, low, high, start, goal, seconds=0.1, seed=1)
    assert len(walled) == 0


@pytest.mark.long
def test_all_stacks_pick_from_the_same_scan(tmp_path: Path) -> None:
    plan = TrialsPlan(trials=1, first=1, stacks=("gaussians", "mesh", "cloud"))
    rows, interrupted = run_trials(plan, tmp_path)
    assert not interrupted
    assert [row.stack for row in rows] == ["gaussians", "mesh", "cloud"]
    assert rows[0].ideal.success
    assert rows[0].held_out.success
    for row in rows:
        assert row.ideal.success == (row.ideal.failure == "")
        assert (row.world_bytes or 0) > 1_000_000
        assert row.plan_ms is None or row.plan_ms < 3000.0
