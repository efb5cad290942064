"""Rights of requests: names, origins, and keys with their scopes."""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass

from splatbot.service_key import key_file, make_key, read_key
from splatbot.services.keys import SCOPES, Scope, hash_key, known_key, new_key, scopes_of
from splatbot.services.settings import ServiceSettings

_HOST = re.compile(r"(?:\[([0-9A-Fa-f:.]+)\]|([A-Za-z0-9._-]+))(?::[0-9]{1,5})?")
_IDENTITY = len("sha256:") + 12  # characters of a key's hash that name its client


@dataclass(frozen=True)
class Grant:
    """A client and its rights.

    Args:
        client: name for rate limits and messages.
        scopes: that it has.
    """

    client: str
    scopes: frozenset[Scope]


class Access:
    """Checks of names, origins and keys.

    On loopback without ``api_keys``, reading needs no key, and all else needs the key of
    :func:`splatbot.service_key.key_file`, which is made if it is missing.

    Args:
        settings: host, keys and allowed names.

    Raises:
        ConfigError: the file of the key cannot be made, or is open to other users.
    """

    def __init__(self, settings: ServiceSettings) -> None:
        self._settings = settings
        self._reading_is_open = settings.loopback and not settings.api_keys
        self._entries = settings.api_keys
        if self.uses_key_file:
            self._entries = (hash_key(make_key(key_file(), new_key()), SCOPES),)

    @property
    def uses_key_file(self) -> bool:
        """True if the key of this user's file is the one that is needed."""
        return self._reading_is_open and not self._settings.insecure_no_auth

    @property
    def is_open(self) -> bool:
        """True if every client that can connect has all scopes."""
        return self._settings.insecure_no_auth

    @property
    def key_hint(self) -> str:
        """Advice to a client without a valid key."""
        hint = "send Authorization: Bearer KEY"
        return hint + (
            ", with the KEY that the service names at its start; or none, to read" if self._reading_is_open else ""
        )

    def holds_key(self, key: str) -> bool:
        """Return whether a key is known."""
        return known_key(key, self._entries) is not None

    def shown_key(self, *, to_terminal: bool) -> str | None:
        """Return the key of the file for a terminal; None elsewhere, where output is kept as a log."""
        return read_key(key_file()) if to_terminal and self.uses_key_file else None

    def host_allowed(self, host: str) -> bool:
        """Return whether a Host header names this service.

        A page whose name is rebound to this machine sends that name. An address cannot be rebound, so a service that
        other machines reach takes every address.
        """
        found = _HOST.fullmatch(host)
        if found is None:
            return False
        name = (found[1] or found[2]).lower().removesuffix(".")
        if name in {"localhost", self._settings.host.lower(), *map(str.lower, self._settings.allowed_hosts)}:
            return True
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return False
        return address.is_loopback or not (self._settings.loopback or address.is_unspecified)

    def origin_allowed(self, origin: str | None, scheme: str, host: str) -> bool:
        """Return whether pages of an origin may ask at ``scheme://host``; without an origin, it is no page."""
        allowed = self._settings.cors_origins
        own = f"{scheme.replace('ws', 'http')}://{host}"
        return origin is None or origin.lower() == own.lower() or origin in allowed or "*" in allowed

    def grant(self, key: str | None, address: str) -> Grant | None:
        """Return the rights of a client with a key, or with none; None if it has no rights.

        Args:
            key: that the client presents.
            address: of the client, its name if it has no key.
        """
        if self._settings.insecure_no_auth:
            return Grant(address, SCOPES)
        if not key:
            return Grant(address, frozenset({"read"})) if self._reading_is_open else None
        entry = known_key(key, self._entries)
        return Grant(entry[:_IDENTITY], scopes_of(entry)) if entry is not None else None
