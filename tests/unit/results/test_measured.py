"""Measured surface outside of a map, as obstacles of plans."""

from __future__ import annotations

import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

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
from splatbot.results.measured import CONSTANTS, MeasuredSurface, blocks_within
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


@pytest.fixture
def own_run(mapped: tuple[RunFolder, GaussianModel, RobotSpheres], tmp_path: Path) -> RunFolder:
    """A copy of the run without kept surface."""
    shutil.copytree(mapped[0].path, tmp_path / "run", ignore=shutil.ignore_patterns("measured_surface.npz"))
    return RunFolder(tmp_path / "run")


class NoLog:
    """A log that must not be opened."""


def surface_of(
    run: RunFolder, model: GaussianModel, log: Log | NoLog | None = None, **settings: Any
) -> MeasuredSurface:
    """Return the measured surface outside of a map, from the log of its run or another one."""

    def open_log() -> Log:
        if isinstance(log, NoLog):
            raise LookupError("was opened")
        return reopen_log(run) if log is None else log

    return MeasuredSurface(run, open_log, model, GaussianCollisionField(model, **settings))


def transformed(T: Array, point: list[float]) -> Array:
    return np.asarray(T[:3, :3] @ point + T[:3, 3])


def lifted(frame: Frame, T: Array, row: NDArray[np.int64], column: NDArray[np.int64]) -> Array:
    """Return the points (P, 3) of pixels."""
    c, z = frame.camera, frame.depth[row, column].astype(np.float64)
    return np.stack([(column - c.cx) / c.fx * z, (row - c.cy) / c.fy * z, z], axis=1) @ T[:3, :3].T + T[:3, 3]


def lifted_all(run: RunFolder, log: Log) -> Array:
    """Return the points (P, 3) of all pixels with depth."""
    return np.concatenate(
        [lifted(log[index], T, *np.nonzero(log[index].depth > 0)) for index, T in run.load_poses().items()]
    )


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


def test_all_points_that_frames_agree_on_are_in_the_map_or_in_a_sphere(
    mapped: tuple[RunFolder, GaussianModel, RobotSpheres], rng: np.random.Generator
) -> None:
    run, model, arm = mapped
    log, field = reopen_log(run), GaussianCollisionField(model)
    spheres = surface_of(run, model).near(arm)
    points = agreed_points(run, log, rng)
    points = points[np.linalg.norm(points - arm.T_world_base[:3, 3], axis=1) < arm.reach_radius - 0.01]
    missed = points[~field.in_collision(points)]
    assert len(missed) > 100  # the hole
    gap = (np.linalg.norm(missed[:, None] - spheres[None, :, :3], axis=2) - spheres[:, 3]).min(axis=1)
    assert gap.max() <= 0.0
    every = lifted_all(run, log)
    away = cKDTree(every[~field.in_collision(every)]).query(spheres[:, :3])[0]
    assert away.max() <= np.sqrt(3) / 2 * CONSTANTS.cell + 1e-9  # each sphere has a point outside of the map


def test_masked_pixels_are_no_obstacle(
    own_run: RunFolder, mapped: tuple[RunFolder, GaussianModel, RobotSpheres]
) -> None:
    _, model, arm = mapped
    log = reopen_log(own_run)

    def with_an_arm_in_view(frame: Frame, *, masked: bool) -> Frame:
        depth, mask = frame.depth.copy(), np.ones(frame.depth.shape, np.bool_)
        depth[:, 60:100] *= 0.75
        mask[:, 60:100] = not masked
        return replace(frame, depth=depth, mask=mask)

    found = []
    for masked in (False, True):
        found.append(surface_of(own_run, model, MaskedLog(log, partial(with_an_arm_in_view, masked=masked))).near(arm))
        own_run.measured.unlink()
    seen, left_out = found
    assert len(seen) > 2 * len(left_out)


def test_blocks_are_all_that_the_ball_meets(rng: np.random.Generator) -> None:
    for _ in range(5):
        center, reach = rng.uniform(-5, 5, 3), float(rng.uniform(0.1, 1.2))
        blocks = {tuple(block) for block in blocks_within(center, reach).tolist()}
        ball = center + reach * rng.uniform(-1, 1, (20_000, 3))
        ball = ball[np.linalg.norm(ball - center, axis=1) <= reach]
        assert {tuple(block) for block in np.floor(ball / CONSTANTS.block).astype(int).tolist()} <= blocks
        low, high = (np.array(sorted(blocks)) + side for side in (0, 1))
        nearest = np.clip(center, low * CONSTANTS.block, high * CONSTANTS.block)
        assert (np.linalg.norm(nearest - center, axis=1) <= reach).all()


def test_what_was_searched_is_kept_and_an_arm_that_moves_adds_what_it_reaches_now(
    own_run: RunFolder, mapped: tuple[RunFolder, GaussianModel, RobotSpheres]
) -> None:
    _, model, arm = mapped
    first = surface_of(own_run, model)
    near = first.near(arm)
    kept = own_run.measured.read_bytes()
    np.testing.assert_array_equal(surface_of(own_run, model, NoLog()).near(arm), near)
    assert own_run.measured.read_bytes() == kept
    T = arm.T_world_base.copy()
    T[:3, 3] += T[:3, :3] @ [0.3, 0.2, 0.0]
    moved = RobotSpheres(panda(), T_world_base=T)
    both = surface_of(own_run, model)
    added = both.near(moved)
    np.testing.assert_array_equal(surface_of(own_run, model, NoLog()).near(moved), added)
    np.testing.assert_array_equal(both.near(arm), near)
    own_run.measured.unlink()
    fresh = surface_of(own_run, model).near(moved)
    assert set(map(tuple, fresh.tolist())) == set(map(tuple, added.tolist()))
    assert len(fresh) > 100


@pytest.mark.parametrize("change", ["the map", "the gate", "the poses", "n_sigma"])
def test_what_was_searched_for_another_map_is_not_used(
    change: str, own_run: RunFolder, mapped: tuple[RunFolder, GaussianModel, RobotSpheres]
) -> None:
    _, model, arm = mapped
    surface_of(own_run, model).near(arm)
    settings: dict[str, Any] = {}
    if change == "the map":
        model = model.select(torch.arange(len(model)) > 10)
    elif change == "the poses":
        *lines, last = own_run.trajectory.read_text().splitlines()
        stamp, x, *others = last.split()
        own_run.trajectory.write_text("\n".join([*lines, " ".join([stamp, str(float(x) + 0.001), *others]), ""]))
        (own_run.path / "SHA256SUMS").unlink()
    else:
        settings = {"n_sigma": 1.5} if change == "n_sigma" else {"min_observations": 2}
    with pytest.raises(LookupError, match="opened"):
        surface_of(own_run, model, NoLog(), **settings).near(arm)


@pytest.mark.parametrize("damage", ["cut", "flipped", "other", "pickled", "folder"])
def test_a_damaged_file_is_searched_again(
    damage: str, own_run: RunFolder, mapped: tuple[RunFolder, GaussianModel, RobotSpheres]
) -> None:
    _, model, arm = mapped
    near, file = surface_of(own_run, model).near(arm), own_run.measured
    data = bytearray(file.read_bytes())
    if damage == "cut":
        file.write_bytes(data[: len(data) // 2])
    elif damage == "flipped":
        data[len(data) // 2] ^= 1
        file.write_bytes(data)
    elif damage == "folder":
        file.unlink()
        file.mkdir()  # can be neither read nor replaced
    else:
        with np.load(file) as loaded:
            values = dict(loaded)
        values["cells"] = values["cells"].astype(object) if damage == "pickled" else values["cells"][:, :2]
        np.savez(file, **values)
    np.testing.assert_array_equal(surface_of(own_run, model).near(arm), near)


def test_requests_at_once_search_once(
    own_run: RunFolder, mapped: tuple[RunFolder, GaussianModel, RobotSpheres]
) -> None:
    _, model, arm = mapped
    opened = []

    def open_log() -> Log:
        opened.append(1)
        return reopen_log(own_run)

    surface = MeasuredSurface(own_run, open_log, model, GaussianCollisionField(model))
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(surface.near, [arm] * 4))
    assert len(opened) == 1
    assert all(np.array_equal(spheres, found[0]) for spheres in found)


def test_a_new_map_removes_what_was_searched(
    own_run: RunFolder, mapped: tuple[RunFolder, GaussianModel, RobotSpheres]
) -> None:
    _, model, arm = mapped
    surface_of(own_run, model).near(arm)
    own_run.replace_map(model)
    assert not own_run.measured.exists()
    surface_of(own_run, model).near(arm)
    assert own_run.check()  # a kept search alters no checksum


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
    spheres = MeasuredSurface(RunFolder(tmp_path / "run"), lambda: reopen_log(run), model, without).near(arm)
    assert len(with_surface) == len(without) + len(spheres)
    assert with_surface.in_collision(spheres[:, :3]).all()
