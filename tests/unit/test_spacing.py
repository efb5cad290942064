"""Even choices of few items from many."""

from __future__ import annotations

import pytest

from splatbot.spacing import evenly_spaced


@pytest.mark.parametrize(("count", "most", "expected"), [(5, 10, [0, 1, 2, 3, 4]), (5, 3, [0, 2, 4]), (0, 3, [])])
def test_the_items_are_evenly_spaced_with_both_ends(count: int, most: int, expected: list[int]) -> None:
    assert evenly_spaced(range(count), most) == expected
