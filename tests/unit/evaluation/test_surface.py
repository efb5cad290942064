"""Distances of surfaces against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.evaluation.surface import points_on, score_mesh
from splatbot.logs.shapes import TriangleMesh, box


def _surface(mesh: TriangleMesh) -> tuple[np.ndarray, np.ndarray]:
    return mesh.vertices, mesh.triangles


def test_a_plate_above_another_is_away_by_its_height_and_one_of_half_the_size_is_accurate_but_incomplete(
    rng: np.random.Generator,
) -> None:
    plate, half = _surface(box([1.0, 1.0, 0.0])), _surface(box([0.5, 1.0, 0.0]))
    seen = np.column_stack([rng.uniform(-0.5, 0.5, (20_000, 2)), np.zeros(20_000)])
    above = score_mesh((plate[0] + [0.0, 0.0, 0.01], plate[1]), plate, seen, tolerance=0.02)
    assert above.accuracy_m == pytest.approx(0.01, rel=1e-4)
    assert above.completeness_m == pytest.approx(0.01, rel=1e-4)
    assert above.f_score == 1.0
    missing = score_mesh(half, plate, seen, tolerance=0.02)
    assert missing.accuracy_m < 1e-6
    assert missing.completeness_m == pytest.approx(0.0625, rel=0.03)  # |x| is 0.25 to 0.5: half of them, 0.125 away
    assert missing.recall == pytest.approx(0.54, abs=0.02)
    assert missing.f_score == pytest.approx(2 * missing.recall / (1 + missing.recall))
    apart = score_mesh((plate[0] + [0.0, 0.0, 1.0], plate[1]), plate, seen, tolerance=0.02)
    assert apart.f_score == 0.0


def test_points_are_uniform_on_the_surface(rng: np.random.Generator) -> None:
    vertices = np.array(
        [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [3.0, 0.0, 1.0], [6.0, 0.0, 1.0], [3.0, 1.0, 1.0]]
    )
    points = points_on((vertices, np.array([[0, 1, 2], [3, 4, 5]])), 40_000, rng)
    assert (points[:, 2] == 0).mean() == pytest.approx(0.25, abs=0.01)  # the areas are 0.5 and 1.5
    np.testing.assert_allclose(points[points[:, 2] == 0].mean(axis=0), [1 / 3, 1 / 3, 0.0], atol=0.01)


def test_a_surface_without_area_and_no_points_are_refused() -> None:
    plate = _surface(box([1.0, 1.0, 0.0]))
    flat = np.zeros((3, 3)), np.array([[0, 1, 2]])
    for found, seen, field in ((flat, np.zeros((1, 3)), "found"), (plate, np.zeros((0, 3)), "seen")):
        with pytest.raises(InputError, match=field):
            score_mesh(found, plate, seen, tolerance=0.01)
