"""Samples of an inertial sensor: sorted, finite and distinct, and refused by name if the shapes do not fit."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.imu import ImuSamples


def test_samples_are_sorted_and_those_that_are_not_finite_or_repeat_a_stamp_are_left_out() -> None:
    gyroscope = [[0.3, 1, 0, 0], [0.1, 2, 0, 0], [0.2, np.nan, 0, 0], [np.inf, 3, 0, 0], [0.1, 9, 0, 0]]
    samples = ImuSamples.of(gyroscope, [[0.2, 0, 0, 9.81]])
    np.testing.assert_array_equal(samples.gyroscope, [[0.1, 2, 0, 0], [0.3, 1, 0, 0]])
    np.testing.assert_array_equal(samples.accelerometer, [[0.2, 0, 0, 9.81]])


def test_parts_of_an_interval_are_disjoint_and_join_to_the_whole() -> None:
    rows = np.column_stack([np.arange(10) / 10, np.arange(30).reshape(10, 3)])
    whole = ImuSamples.of(rows, rows[::3])
    parts = [whole.between(-1.0, 0.3), whole.between(0.3, 0.3), whole.between(0.3, 2.0)]
    assert [len(part.gyro_stamps) for part in parts] == [4, 0, 6]
    joined = parts[2].joined(parts[0]).joined(None)
    np.testing.assert_array_equal(joined.gyroscope, whole.gyroscope)
    np.testing.assert_array_equal(joined.accelerometer, whole.accelerometer)
    np.testing.assert_array_equal(whole.shifted(2.0).accelerometer, rows[::3] + np.array([2.0, 0, 0, 0]))


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ((np.zeros(2), np.zeros((3, 3)), np.zeros(0), np.zeros((0, 3))), "imu angular_rate"),
        ((np.zeros(0), np.zeros((0, 3)), np.zeros(1), np.zeros(3)), "imu specific_force"),
    ],
)
def test_shapes_that_do_not_fit_are_named(values: tuple[np.ndarray, ...], field: str) -> None:
    with pytest.raises(InputError) as caught:
        ImuSamples(*values)
    assert caught.value.field == field
    with pytest.raises(InputError, match="gyroscope"):
        ImuSamples.of([[1.0, 2.0, 3.0]])
