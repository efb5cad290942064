"""Leases of arms."""

from __future__ import annotations

import time

import pytest

from splatbot.services.leases import LeaseError, Leases


def test_one_owner_at_a_time_and_the_next_after_the_lease_ends() -> None:
    leases = Leases()
    first = leases.acquire("fake", "a", seconds=0.05)
    with pytest.raises(LeaseError, match="another client"):
        leases.acquire("fake", "b", seconds=1.0)
    assert leases.holds(first.id)
    time.sleep(0.06)
    assert not leases.holds(first.id)
    second = leases.acquire("fake", "b", seconds=1.0)
    with pytest.raises(LeaseError, match="has ended"):
        leases.check(first.id, "fake")
    assert leases.check(second.id, "fake").owner == "b"


def test_a_renewed_lease_lasts() -> None:
    leases = Leases()
    lease = leases.acquire("fake", "a", seconds=0.1)
    for _ in range(5):
        time.sleep(0.05)
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
