"""Measured surface outside of a map, as obstacles of plans."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from splatbot.cli import main
from splatbot.cli.grasp import graspable_objects
from splatbot.cli.placing import agree_with_plans
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import SplatbotError
from splatbot.frame import Frame
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, rotation_to_quat
from splatbot.logs import Log
from splatbot.planning import GaussianRRTStar
from splatbot.protocols import Array
from splatbot.results.folder import RunFolder
from splatbot.results.measured import CONSTANTS, enclosing_spheres, surface_outside
from splatbot.results.plan_obstacles import PlanObstacles
from splatbot.robots.in_view import reopen_log
from splatbot.robots.panda import panda
from splatbot.run.masked import MaskedLog
from splatbot.workspace import fit_workspace


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunFolder, GaussianModel, RobotSpheres]:
    """A run of four frames, its map without a ball of 6 cm of it, and an arm in it."""
    run = tmp_path_factory.mktemp("runs") / "table"
    assert main(["map", "synthetic:tabletop?frames=4&width=160&height=120", "--out", str(run), "--quiet"]) == 0
    model = GaussianModel.load(run / "map.ply")
    T = fit_workspace(model).T_world_base
    assert T is not None
    arm = RobotSpheres(panda(), T_world_base=T)
    means = model.means.double().numpy()
    hole = means[np.argmin(np.linalg.norm(means - transformed(T, [0.5, 0.0, 0.1]), axis=1))]
    kept = np.linalg.norm(means - hole, axis=1) > 0.06
    return RunFolder(run), model.select(torch.from_numpy(kept)), arm


def transformed(T: Array, point: list[float]) -> Array:
    return np.asarray(T[:3, :3] @ point + T[:3, 3])


def lifted(frame: Frame, T: Array, row: NDArray[np.int64], column: NDArray[np.int64]) -> Array:
    """Return the points (P, 3) of pixels."""
    c, z = frame.camera, frame.depth[row, column].astype(np.float64)
    return np.stack([(column - c.cx) / c.fx * z, (row - c.cy) / c.fy * z, z], axis=1) @ T[:3, :3].T + T[:3, 3]


def agreed_points(run: RunFolder, log: Log, rng: np.random.Generator) -> Array:
    """Return points that the nearest pixel of each other frame measures, within a fifth of the rule's tolerance."""
    poses, sensor = run.load_poses(), run.load_config().sensor
    found = []
    for own in poses:
        depth = log[own].depth
        pixels = np.argwhere(depth > 0)
        row, column = pixels[rng.permutation(len(pixels))[:1500]].T
        points = lifted(log[own], poses[own], row, column)
        agreed = np.ones(len(points), np.bool_)
        for other in set(poses) - {own}:
            frame, T = log[other], inverse(poses[other])
            local = points @ T[:3, :3].T + T[:3, 3]
            c = frame.camera
            u = np.rint(c.fx * local[:, 0] / local[:, 2] + c.cx).astype(int)
            v = np.rint(c.fy * local[:, 1] / local[:, 2] + c.cy).astype(int)
            inside = (u > 0) & (v > 0) & (u < c.width - 1) & (v < c.height - 1) & (local[:, 2] > 0)
            measured = np.where(inside, frame.depth[v.clip(0, c.height - 1), u.clip(0, c.width - 1)], np.nan)
            sigma = sensor.sigma_depth_floor + sensor.sigma_depth_quad * local[:, 2] ** 2
            agreed &= np.abs(measured - local[:, 2]) < 0.6 * sigma
        found.append(points[agreed])
    return np.concatenate(found)


def test_all_points_that_frames_agree_on_are_in_the_map_or_next_to_a_sphere(
    mapped: tuple[RunFolder, GaussianModel, RobotSpheres], rng: np.random.Generator
) -> None:
    run, model, arm = mapped
    log, field = reopen_log(run), GaussianCollisionField(model)
    spheres = surface_outside(run, log, field, arm)
    points = agreed_points(run, log, rng)
    points = points[np.linalg.norm(points - arm.T_world_base[:3, 3], axis=1) < arm.reach_radius - 0.01]
    missed = points[~field.in_collision(points)]
    assert len(missed) > 100  # the hole
    gap = (np.linalg.norm(missed[:, None] - spheres[None, :, :3], axis=2) - spheres[:, 3]).min(axis=1)
    assert gap.max() <= np.sqrt(3) * CONSTANTS.spacing
    assert not field.in_collision(spheres[spheres[:, 3] == CONSTANTS.least_radius][:, :3]).any()  # of single points


def test_masked_pixels_are_no_obstacle(mapped: tuple[RunFolder, GaussianModel, RobotSpheres]) -> None:
    run, model, arm = mapped
    log, field = reopen_log(run), GaussianCollisionField(model)

    def with_an_arm_in_view(frame: Frame, *, masked: bool) -> Frame:
        depth, mask = frame.depth.copy(), np.ones(frame.depth.shape, np.bool_)
        depth[:, 60:100] *= 0.75
        mask[:, 60:100] = not masked
        return replace(frame, depth=depth, mask=mask)

    seen, left_out = (
        surface_outside(run, MaskedLog(log, partial(with_an_arm_in_view, masked=masked)), field, arm)
        for masked in (False, True)
    )
    assert len(seen) > 2 * len(left_out)


@pytest.mark.parametrize("voxel", [0.003, 0.02])
def test_one_sphere_encloses_the_points_of_each_voxel(voxel: float, rng: np.random.Generator) -> None:
    points = rng.normal(0.0, 0.05, (1000, 3))
    points[:50] = points[0]
    spheres = enclosing_spheres(points, voxel, 0.001)
    cells = np.floor(points / voxel).astype(int)
    assert len(spheres) == len({tuple(cell) for cell in cells})
    gap = np.linalg.norm(points[:, None] - spheres[None, :, :3], axis=2) - spheres[:, 3]
    assert gap.min(axis=1).max() <= 1e-12
    assert spheres[:, 3].min() >= 0.001
    assert spheres[:, 3].max() <= np.sqrt(3) * voxel
    assert enclosing_spheres(np.zeros((0, 3)), voxel, 0.001).shape == (0, 4)


def test_an_end_in_measured_surface_is_refused_with_its_name_and_place(
    mapped: tuple[RunFolder, GaussianModel, RobotSpheres],
) -> None:
    _, model, arm = mapped
    robot, field = arm.robot, GaussianCollisionField(model)
    goal = np.array([0.3, 0.2, 0.0, -2.0, 0.0, 2.0, 0.8])
    at_the_hand = arm.centers(goal[None])[0, -1]
    spheres = np.c_[at_the_hand[None], 0.004]

    def plan(measured: Array | None) -> PlanObstacles:
        around = PlanObstacles(field, model, arm, robot.home, measured=measured)
        planner = GaussianRRTStar(around.field(0.005), robot, T_world_base=arm.T_world_base, margin=0.005)
        around.check(planner.plan(robot.home, goal, budget_ms=30))
        return around

    assert not plan(None).covers_measured
    with pytest.raises(SplatbotError, match="in surface that two frames measured and the map lacks at") as refused:
        plan(spheres)
    assert "margin in metres" in str(refused.value)
    assert plan(spheres + np.array([0.0, 0.0, 3.0, 0.0])).covers_measured


def test_the_way_to_a_pre_grasp_avoids_measured_surface_if_its_margin_is_audited(
    mapped: tuple[RunFolder, GaussianModel, RobotSpheres], tmp_path: Path
) -> None:
    run, model, arm = mapped
    shutil.copytree(run.path, tmp_path / "run")
    model.save(tmp_path / "run" / "map.ply")
    (tmp_path / "run" / "SHA256SUMS").unlink()  # the map is changed on purpose
    T = arm.T_world_base
    base = (*T[:3, 3].tolist(), *rotation_to_quat(T[:3, :3]).tolist())
    sampler = graspable_objects(tmp_path / "run", base).sampler(arm.robot)
    fields = []
    for measured in (False, True):
        agree_with_plans(sampler, tmp_path / "run", panda(), arm.robot.home, "free", measured=measured)
        assert sampler.departure is not None
        fields.append(sampler.departure)
    without, with_surface = fields
    spheres = surface_outside(RunFolder(tmp_path / "run"), reopen_log(run), without, arm)
    assert len(with_surface) == len(without) + len(spheres)
    assert with_surface.in_collision(spheres[:, :3]).all()
