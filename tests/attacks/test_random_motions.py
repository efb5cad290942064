"""Random motions against an independent check; `python -m tests.attacks.random_motions` runs 100,000."""

from __future__ import annotations

import pytest

from tests.attacks.random_motions import SPOILED, run


@pytest.mark.long
def test_no_motion_is_let_through_that_the_check_at_1_khz_rejects() -> None:
    tally = run(400, seed=1)
    assert tally.wrong == []
    assert tally.unexplained == 0
    assert tally.executed["valid"] > 50
    assert set(tally.refused) >= set(SPOILED)
