"""Short runs of the load and of the soak; the long ones are programs of their own."""

from __future__ import annotations

import pytest

from tests.attacks.mixed_clients import measure
from tests.attacks.soak import NAMES, soak


@pytest.mark.long
@pytest.mark.alone
def test_mixed_clients_get_answers_while_a_log_is_mapped() -> None:
    times = measure(8.0, 20)
    times.statuses.pop("503, asked again", None)
    assert len(times.seconds) > 50
    assert not times.statuses
    assert times.frames


@pytest.mark.long
@pytest.mark.alone
def test_maps_and_clients_that_come_and_go_leave_nothing() -> None:
    _, found = soak(30.0)
    assert len(found) > 2
    later = found[len(found) // 2 :]
    for name, first, last in zip(NAMES[1:], later[0, 1:], later[-1, 1:], strict=True):
        assert last <= first + 6, name
