"""Leases of arms."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import pytest

from splatbot.services.leases import LeaseError, Leases


@pytest.fixture
def let_pass(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Stops the clock of leases, and returns a function that advances it by a time [s]."""
    now = [100.0]
    monkeypatch.setattr("splatbot.services.leases.time", SimpleNamespace(monotonic=lambda: now[0]))

    def advance(seconds: float) -> None:
        now[0] += seconds

    return advance


def test_one_owner_at_a_time_and_the_next_after_the_lease_ends(let_pass: Callable[[float], None]) -> None:
    leases = Leases()
    first = leases.acquire("fake", "a", seconds=0.05)
    with pytest.raises(LeaseError, match="another client"):
        leases.acquire("fake", "b", seconds=1.0)
    let_pass(0.04)
    assert leases.holds(first.id)
    let_pass(0.02)
    assert not leases.holds(first.id)
    second = leases.acquire("fake", "b", seconds=1.0)
    with pytest.raises(LeaseError, match="has ended"):
        leases.check(first.id, "fake")
    assert leases.check(second.id, "fake").owner == "b"


def test_a_renewed_lease_lasts(let_pass: Callable[[float], None]) -> None:
    leases = Leases()
    lease = leases.acquire("fake", "a", seconds=0.1)
    for _ in range(5):
        let_pass(0.05)
        leases.renew(lease.id)
    assert leases.holds(lease.id)
    leases.release(lease.id)
    assert not leases.holds(lease.id)
    with pytest.raises(LeaseError):
        leases.renew(lease.id)


def test_the_owner_of_an_arm_at_rest_is_preempted_and_that_of_a_moving_arm_only_by_an_administrator() -> None:
    leases = Leases()
    first = leases.acquire("fake", "a", seconds=10)
    with pytest.raises(LeaseError, match="moves for another client"):
        leases.acquire("fake", "b", seconds=10, preempt=True, moving=True)
    assert leases.holds(first.id)
    second = leases.acquire("fake", "b", seconds=10, preempt=True)
    assert not leases.holds(first.id)
    third = leases.acquire("fake", "c", seconds=10, preempt=True, moving=True, admin=True)
    assert (leases.holds(second.id), leases.holds(third.id)) == (False, True)


def test_a_lease_is_of_one_arm() -> None:
    leases = Leases()
    lease = leases.acquire("fake", "a", seconds=10)
    with pytest.raises(LeaseError, match="of arm fake"):
        leases.check(lease.id, "twin")
    leases.acquire("twin", "b", seconds=10)
    assert leases.of("twin") is not None
    assert leases.of("other") is None
