"""Depth differences on images whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.evaluation import depth_error


def test_mean_median_and_coverage_ignore_missing_pixels() -> None:
    reference = np.array([[1.0, 1.0, 2.0, 0.0], [1.0, np.nan, 3.0, 4.0]])
    rendered = np.array([[1.1, 1.3, 2.0, 9.0], [0.0, 1.0, np.inf, 5.0]])
    error = depth_error(rendered, reference)
    assert error.l1 == pytest.approx((0.1 + 0.3 + 0.0 + 1.0) / 4)
    assert error.median == pytest.approx(0.2)
    assert error.coverage == pytest.approx(4 / 6)


def test_without_common_pixels_there_is_no_number() -> None:
    error = depth_error(np.zeros((3, 3)), np.ones((3, 3)))
    assert (error.l1, error.median, error.coverage) == (None, None, 0.0)
    error = depth_error(np.ones((3, 3)), np.full((3, 3), np.nan))
    assert (error.l1, error.median, error.coverage) == (None, None, None)


def test_sizes_must_agree() -> None:
    with pytest.raises(InputError, match="one size"):
        depth_error(np.ones((3, 3)), np.ones((3, 4)))
