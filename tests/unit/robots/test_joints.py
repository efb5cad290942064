"""Joint values in degrees."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.robots.joints import suspect_degrees_in_rows
from splatbot.robots.store import load_robot


def test_the_row_in_degrees_is_named_with_its_values_in_radians() -> None:
    chain = load_robot("ur5e").chain
    q = np.array([[0, -1.57, 1.57, -1.57, -1.57, 0], [0, -90, 90, -90, -90, 0.0]])
    suspect_degrees_in_rows(q[:1], chain, "q")
    with pytest.raises(InputError, match=r"q\[1\]: joint 1 is -90.*degrees\?.*give radians: 0 -1\.571 1\.571"):
        suspect_degrees_in_rows(q, chain, "q")


def test_a_whole_turn_of_a_joint_is_no_degree() -> None:
    chain = load_robot("ur5e").chain
    suspect_degrees_in_rows(np.full((3, 6), 2 * np.pi), chain, "q")
    suspect_degrees_in_rows(np.array([[0, -1.57, 1.57, -1.57, -1.57, 7.0]]), chain, "q")
