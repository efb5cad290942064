"""Quotas of clients: several robots share a process, and none takes the places of the others."""

from __future__ import annotations

from splatbot.services.jobs import Jobs
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore, QuotaError
from splatbot.services.versions import Versions


class Quotas:
    """Counts the maps, jobs and bytes of each client.

    A map counts for the client that made it, also if others use it. Maps of the service itself have no owner and count
    for no client. The store and the jobs check their numbers themselves, each within its lock.

    Args:
        settings: limits of one client.
        store: the maps.
        jobs: the jobs.
        versions: on disk; None if the service keeps none.
    """

    def __init__(self, settings: ServiceSettings, store: MapStore, jobs: Jobs, versions: Versions | None) -> None:
        self._settings, self._store, self._jobs, self._versions = settings, store, jobs, versions

    def maps_of(self, client: str) -> int:
        """Return the number of maps of a client."""
        return sum(served.owner == client for served in self._store.list())

    def jobs_of(self, client: str) -> int:
        """Return the number of jobs of a client that wait or run."""
        return self._jobs.count(client)

    def bytes_of(self, client: str) -> int:
        """Return the size of the Gaussians of a client's maps and of its versions on disk [bytes]."""
        maps = sum(served.nbytes for served in self._store.list() if served.owner == client)
        return maps + (self._versions.bytes_of(client) if self._versions is not None else 0)

    def check_bytes(self, client: str, more: int = 1) -> None:
        """Check that a client may have ``more`` bytes.

        Raises:
            QuotaError: it may not.
        """
        used, most = self.bytes_of(client), self._settings.max_client_bytes
        if client and used + more > most:
            hint = "delete maps or versions, or raise SPLATBOT_MAX_CLIENT_BYTES"
            raise QuotaError(f"this client's maps have {used} of {most} bytes.", field="bytes", hint=hint)
