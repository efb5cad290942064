"""The room to keep from a run's map."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from splatbot.cli import main
from splatbot.collision import GaussianCollisionField
from splatbot.errors import FormatError
from splatbot.frame import Frame
from splatbot.gaussians import GaussianModel
from splatbot.protocols import Array
from splatbot.results.folder import RunFolder
from splatbot.results.margin import AuditedError, own_margin
from splatbot.robots.in_view import reopen_log
from splatbot.run.masked import MaskedLog
from splatbot.workspace import fit_workspace


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, GaussianModel, Array]:
    """A run of four frames, its map, and the pose of the base in it."""
    run = tmp_path_factory.mktemp("runs") / "table"
    words = ["map", "synthetic:tabletop?frames=4&width=160&height=120", "--out", str(run), "--quiet"]
    assert main([*words, "--set", "mapping.final_iterations=20"]) == 0
    model = GaussianModel.load(run / "map.ply")
    T = fit_workspace(model).T_world_base
    assert T is not None
    return run, model, T


def test_the_margin_of_a_run_is_what_its_depth_leaves_outside_of_the_ellipsoids(
    mapped: tuple[Path, GaussianModel, Array],
) -> None:
    run, model, T = mapped
    thin, thick = (own_margin(run, reopen_log(RunFolder(run)), GaussianCollisionField(model, n), T) for n in (0.2, 3.0))
    assert 0.0 <= thick < thin < 0.3


def test_a_folder_that_holds_no_run_has_none(tmp_path: Path) -> None:
    field = GaussianCollisionField(GaussianModel.empty())
    with pytest.raises(FormatError, match="metrics"):
        own_margin(tmp_path, reopen_log(RunFolder(tmp_path)), field, np.eye(4))


def test_what_the_run_left_out_does_not_count(mapped: tuple[Path, GaussianModel, Array]) -> None:
    run, model, T = mapped
    field, log = GaussianCollisionField(model), reopen_log(RunFolder(run))

    def with_an_arm_in_view(frame: Frame, *, masked: bool) -> Frame:
        depth, mask = frame.depth.copy(), np.ones(frame.depth.shape, np.bool_)
        depth[:, 60:100] *= 0.75
        mask[:, 60:100] = not masked
        return replace(frame, depth=depth, mask=mask)

    clean = own_margin(run, log, field, T)
    seen, left_out = (
        own_margin(run, MaskedLog(log, partial(with_an_arm_in_view, masked=masked)), field, T)
        for masked in (False, True)
    )
    assert seen > clean + 0.02
    assert left_out <= clean + 0.005


@pytest.mark.parametrize(
    ("distance", "least", "count"), [(0.25, 0, 3), (0.25, 2, 3), (0.25, 6, 6), (0.05, 1, 1), (0.25, 20, 11)]
)
def test_the_region_of_a_motion_grows_to_the_nearest_points_until_it_has_enough(
    distance: float, least: int, count: int
) -> None:
    points = np.zeros((11, 3))
    points[:, 0] = np.arange(11) / 10  # 10 cm apart, the first at the arm
    error = AuditedError(points[::-1], np.arange(11)[::-1] / 1000)
    near = error.near(np.zeros((1, 3)), distance, least)
    assert len(near) == count
    np.testing.assert_allclose(np.sort(near.error), np.arange(count) / 1000)


def test_a_region_without_any_point_has_no_error() -> None:
    empty = AuditedError(np.zeros((0, 3)), np.zeros(0))
    assert empty.near(np.zeros((1, 3)), 0.2, 5).quantile(0.999) == 0.0


@pytest.mark.parametrize(("distance", "least"), [(0.05, 0), (0.2, 50), (0.05, 400), (0.01, 3000), (0.5, 5000)])
def test_near_points_are_those_of_an_exhaustive_search(distance: float, least: int) -> None:
    rng = np.random.default_rng(least)
    points, centers = rng.uniform(-1, 1, (3000, 3)), rng.uniform(-0.3, 0.3, (2000, 3)) * [1.0, 0.1, 0.1]
    audited = AuditedError(points, rng.uniform(0, 0.01, 3000))
    gap = np.linalg.norm(points[:, None] - centers, axis=2).min(axis=1)
    most = max(distance, np.sort(gap)[min(least, 3000) - 1] if least else 0.0)
    want = gap <= most if (gap <= distance).sum() < least else gap <= distance
    found = audited.near(centers, distance, least)
    np.testing.assert_array_equal(found.points, points[want])
    np.testing.assert_array_equal(found.error, audited.error[want])
