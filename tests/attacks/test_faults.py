"""Short runs of the fault injection: kills between any two writes, and damaged files."""

from __future__ import annotations

import pytest

from tests.attacks import bit_flips, crash_points


@pytest.mark.parametrize("kind", ["serve", "record"])
def test_a_killed_process_leaves_the_old_or_the_new_state(kind: str) -> None:
    tally = crash_points.run(20, 1, (kind,))
    assert tally.wrong == []
    assert sum(tally.killed.values()) >= 10
    assert tally.slowest_s < 5


@pytest.mark.long
def test_a_killed_run_leaves_the_old_or_the_new_state() -> None:
    tally = crash_points.run(10, 1, ("map",))
    assert tally.wrong == []
    assert sum(tally.killed.values()) >= 3


@pytest.mark.long
def test_every_damage_of_a_stored_file_is_detected_and_reported() -> None:
    assert bit_flips.run(100, 1).missed == []
