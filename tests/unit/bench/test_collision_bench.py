"""`splatbot bench collision` in its quick form, and the truth that it compares with."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from splatbot.bench.collision import BENCHMARK, CollisionSettings
from splatbot.bench.results import Results
from splatbot.bench.tabletop import Ball, Block, Can, Tabletop, tabletop
from splatbot.bench.truth import Truth, score, without_self_collision
from splatbot.cli import main
from splatbot.collision import RobotSpheres
from splatbot.robots.panda import panda


@pytest.fixture(scope="module")
def results(folder: Path) -> Results:
    """One quick run with peers, for all tests."""
    return BENCHMARK.run(CollisionSettings(out=folder, peers=True, quick=True))


@pytest.mark.long
def test_speed_and_memory_are_measured_at_every_size(results: Results) -> None:
    for count in CollisionSettings.quick_values["counts"]:
        for threads in ("1 thread", "2 threads"):
            for metric in ("build", "memory", "configurations", "exact clearance in the clutter"):
                found = results.find(f"{count} Gaussians, {threads}", metric)
                assert found is not None
                assert found > 0


def test_no_configuration_or_certified_edge_is_called_free_wrongly(results: Results) -> None:
    cases = [row for row in results.rows if row.metric == "false free, count" and "(default)" in row.case]
    assert len(cases) >= 3
    assert all(row.value == 0 for row in cases)
    certified = [row for row in results.rows if row.metric == "self-collisions missed" and "certified" in row.case]
    assert certified
    assert all(row.value == 0 for row in certified)


def test_gates_give_back_what_floaters_block(results: Results) -> None:
    clean, none, all_three = (
        results.find(f"gate: {label}", "reported free")
        for label in ("clean map", "1 % floaters, none", "1 % floaters, all three")
    )
    assert clean is not None
    assert none is not None
    assert all_three is not None
    assert none < all_three <= clean


def test_brute_force_agrees(results: Results) -> None:
    differences = [row.value for row in results.rows if row.metric == "verdicts that differ from float64's"]
    assert differences == [0.0]
    own = [row for row in results.rows if row.metric.startswith("largest relative") and row.peer is None]
    assert own[0].value is not None
    assert own[0].value < 1e-5


def test_files_hold_the_rows(results: Results, folder: Path) -> None:
    written = json.loads((folder / "collision.json").read_text())
    assert len(written["rows"]) == len(results.rows)
    with (folder / "collision.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(results.rows)
    assert (folder / "collision-accuracy.png").read_bytes().startswith(b"\x89PNG")


def test_the_command_prints_its_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["bench", "collision", "--quick", "--out", str(tmp_path / "o"), "--json", str(tmp_path / "f.json")])
    assert code == 0
    out = capsys.readouterr().out
    assert "Edges against the ground truth" in out
    assert (tmp_path / "f.json").exists()


@pytest.mark.parametrize(
    "solid", [Block((0.1, 0.2, 0.3), (0.2, 0.1, 0.3), 0.7), Can((0.1, 0, 0.1), 0.05, 0.2), Ball((0.0, 0.1, 0), 0.1)]
)
def test_gaussians_lie_on_the_shapes_surface_facing_outwards(solid: Block | Can | Ball) -> None:
    scene = Tabletop((solid,))
    model = scene.gaussians(2000)
    means = model.means.double().numpy()
    assert np.abs(scene.distance(means)).max() < 1e-6
    w, x, y, z = model.quats.double().numpy().T
    normal = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    assert (scene.distance(means + 1e-3 * normal) > 5e-4).mean() > 0.99
    assert 1500 < len(model) < 3500


def test_rooms_equal_the_exact_distances_where_they_are_small() -> None:
    scene, arm = tabletop(), RobotSpheres(panda())
    q = without_self_collision(arm, panda().random(300, np.random.default_rng(0)))
    moving = arm.spheres.link > 0
    exact = scene.distance(arm.centers(q)[:, moving].reshape(-1, 3)).reshape(len(q), -1) - arm.spheres.radii[moving]
    rooms, least = Truth(scene, 0.1).clearances(arm, q), exact.min(axis=1)
    np.testing.assert_allclose(rooms[least < 0.01], least[least < 0.01], atol=1e-12)
    assert (rooms[least >= 0.01] >= 0.01 - 1e-9).all()
    assert (rooms <= least + 1e-6).all()


def test_both_errors_are_separate() -> None:
    found = score(np.array([True, False, True, False]), np.array([0.02, -0.005, -0.1, 0.3]))
    assert (found.false_free, found.deepest_m) == (1, 0.005)
    assert (found.false_hit_percent, found.largest_m) == (25.0, 0.02)
