"""Leases of arms: one owner commands an arm at a time, for as long as the owner renews the lease."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace
from uuid import uuid4

from splatbot.errors import ControllerError

MAX_LEASE_S = 60.0  # [s] longest time without a renewal


class LeaseError(ControllerError):
    """An arm belongs to another owner, or a lease has ended."""


@dataclass(frozen=True)
class Lease:
    """Right of one owner to command an arm.

    Args:
        id: secret name of the lease; motions name it.
        arm: name of the arm.
        owner: client that holds it.
        seconds: time without a renewal after which the lease ends and the arm stops [s]; None for an owner whose
            connection is watched instead.
        expires: end on the clock of ``time.monotonic`` [s].
    """

    id: str
    arm: str
    owner: str
    seconds: float | None
    expires: float

    @property
    def valid(self) -> bool:
        """True until the lease expires."""
        return time.monotonic() < self.expires


class Leases:
    """At most one valid lease for each arm. All methods may be called from any thread.

    A client gets the lease of an arm without a valid lease. It may preempt the owner of an arm at rest. Only an
    administrator may preempt during a motion, which then stops. Clients that share a key are different owners.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._by_arm: dict[str, Lease] = {}

    def acquire(
        self,
        arm: str,
        owner: str,
        *,
        seconds: float | None,
        preempt: bool = False,
        moving: bool = False,
        admin: bool = False,
    ) -> Lease:
        """Take the lease of an arm.

        Args:
            arm: name of the arm.
            owner: name of the client, for messages.
            seconds: time within which the owner renews the lease [s]; None for a connection that is watched instead.
            preempt: take the lease from another owner.
            moving: the arm executes a motion of its owner.
            admin: the client may preempt during a motion.

        Raises:
            LeaseError: another owner holds it and is not preempted.
        """
        with self._lock:
            held = self._by_arm.get(arm)
            if held is not None and held.valid:
                if not preempt:
                    hint = "wait until it ends, or preempt it while the arm is at rest"
                    raise LeaseError("belongs to another client.", field=f"arm {arm}", hint=hint)
                if moving and not admin:
                    hint = "wait for the end of the motion, stop it, or use a key with the scope admin"
                    raise LeaseError("moves for another client.", field=f"arm {arm}", hint=hint)
            expires = time.monotonic() + (float("inf") if seconds is None else seconds)
            lease = Lease(uuid4().hex, arm, owner, seconds, expires)
            self._by_arm[arm] = lease
            return lease

    def renew(self, lease_id: str) -> Lease:
        """Extend a lease by its time.

        Raises:
            LeaseError: the lease has ended.
        """
        with self._lock:
            lease = self._find(lease_id)
            if lease.seconds is not None:
                lease = replace(lease, expires=time.monotonic() + lease.seconds)
                self._by_arm[lease.arm] = lease
            return lease

    def release(self, lease_id: str) -> None:
        """End a lease; nothing happens if it has ended."""
        with self._lock:
            for arm, lease in list(self._by_arm.items()):
                if lease.id == lease_id:
                    del self._by_arm[arm]

    def check(self, lease_id: str, arm: str) -> Lease:
        """Return a valid lease of an arm.

        Raises:
            LeaseError: the lease has ended, or is of another arm.
        """
        with self._lock:
            lease = self._find(lease_id)
        if lease.arm != arm:
            raise LeaseError(f"is of arm {lease.arm}.", field="lease", hint=f"take the lease of arm {arm}")
        return lease

    def holds(self, lease_id: str) -> bool:
        """Return whether a lease is valid."""
        with self._lock:
            return any(lease.id == lease_id and lease.valid for lease in self._by_arm.values())

    def of(self, arm: str) -> Lease | None:
        """Return the valid lease of an arm, or None."""
        with self._lock:
            lease = self._by_arm.get(arm)
            return lease if lease is not None and lease.valid else None

    def _find(self, lease_id: str) -> Lease:
        found = next((lease for lease in self._by_arm.values() if lease.id == lease_id and lease.valid), None)
        if found is None:
            hint = "take a new one: POST /v1/arms/{arm}/lease, and renew it in time"
            raise LeaseError("has ended.", field="lease", hint=hint)
        return found
