"""Tests of splatbot.report.annotations."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.report.annotations import CONSTANTS, _apart, fitting, legend_size, with_legend, with_numbers, with_scale

CAMERA = Camera(600.0, 600.0, 319.5, 239.5, 640, 480)


def grey() -> NDArray[np.float32]:
    return np.full((480, 640, 3), 0.4, np.float32)


def test_crowded_numbers_move_apart_and_stay_in_the_picture() -> None:
    rng = np.random.default_rng(0)
    places = {k: np.array([300.0, 200.0]) + rng.normal(0, 6, 2) for k in range(40)}
    places[40] = np.array([1.0, 479.0])
    found = _apart(places, np.array([640, 480]), np.array([290, 300]))
    at = np.array(list(found.values()))
    away = np.abs(at[:, None] - at)
    clear = (away >= np.array(CONSTANTS.badge) - 1e-9).any(axis=2)
    assert (clear | np.eye(len(at), dtype=bool)).all()
    assert ((at > 0) & (at < [640, 480])).all()
    assert ((at >= [290, 300]).any(axis=1)).all()  # none below the legend


def test_a_number_outside_of_the_picture_is_left_out() -> None:
    assert _apart({0: np.array([-5.0, 10.0])}, np.array([640, 480]), np.zeros(2)) == {}
    image = with_numbers(grey(), {0: np.array([-5.0, 10.0])}, {0: (1.0, 0.0, 0.0)})
    np.testing.assert_allclose(image, grey(), atol=2e-3)


@pytest.mark.parametrize(("depth", "length"), [(0.5, 0.1), (2.0, 0.2), (40.0, 1.0), (1000.0, 1.0)])
def test_a_scale_bar_is_as_long_as_its_length_at_the_depth(depth: float, length: float) -> None:
    image = with_scale(grey(), CAMERA, depth, "at the target")
    bar = (image[480 - 18] > 0.9).all(axis=1).sum()
    assert bar == pytest.approx(CAMERA.fx * length / depth, abs=3)


def test_a_legend_that_does_not_fit_says_how_many_are_left_out() -> None:
    rows = [(f"object {k}", (1.0, 0.5, 0.0)) for k in range(100)]
    image = with_legend(grey(), rows)
    assert image.shape == grey().shape
    np.testing.assert_allclose(image[:, 400:], grey()[:, 400:], atol=2e-3)
    kept = fitting(rows, 480, last=[("7 pieces are only in the list", (0.5, 0.5, 0.5))])
    assert legend_size(kept)[1] <= 480
    *named, (more, _), (pieces, _) = kept
    assert more == f"and {100 - len(named)} more"
    assert pieces == "7 pieces are only in the list"
    few = with_legend(grey(), rows[:2])
    np.testing.assert_allclose(few[80:], grey()[80:], atol=2e-3)
    assert not np.allclose(few[:58], grey()[:58])
