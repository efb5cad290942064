"""Composition of two images by the depth of each pixel, with soft edges."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.sim.view import TwinView, composite


def _flat(alpha: float, depth: float, color: float, bodies: float) -> TwinView:
    full = np.ones((2, 3), np.float32)
    return TwinView(np.full((2, 3, 3), alpha * color, np.float32), alpha * full, depth * full, bodies * full)


def test_what_is_nearer_covers_what_is_farther_whichever_is_given_first() -> None:
    near, far = _flat(1.0, 1.0, 0.9, 1.0), _flat(1.0, 2.0, 0.2, 0.0)
    for both in (composite(near, far), composite(far, near)):
        assert (both.rgb() == 230).all()
        assert (both.depth == 1.0).all()
        assert (both.bodies == 1.0).all()


def test_a_half_covered_pixel_shows_both_halves_and_the_nearer_depth() -> None:
    both = composite(_flat(0.5, 1.0, 1.0, 0.5), _flat(1.0, 2.0, 0.4, 0.0))
    np.testing.assert_allclose(both.color, 0.5 * 1.0 + 0.5 * 0.4)
    np.testing.assert_allclose(both.bodies, 0.5)
    assert (both.measured(5.0) == 1.0).all()


def test_haze_in_front_dims_but_does_not_take_the_depth() -> None:
    both = composite(_flat(0.2, 1.0, 0.0, 0.0), _flat(1.0, 2.0, 0.5, 1.0))
    np.testing.assert_allclose(both.color, 0.8 * 0.5)
    assert (both.measured(5.0) == 2.0).all()


@pytest.mark.parametrize(("alpha", "depth"), [(0.0, np.inf), (0.3, 1.0), (1.0, 30.0)])
def test_what_is_mostly_empty_or_out_of_reach_has_no_depth(alpha: float, depth: float) -> None:
    nothing = _flat(0.0, np.inf, 0.0, 0.0)
    assert (composite(_flat(alpha, depth, 0.5, 0.0), nothing).measured(20.0) == 0.0).all()
