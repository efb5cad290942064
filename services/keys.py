"""API keys: random, kept as hashes, compared in constant time."""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
from collections.abc import Sequence

_PREFIX = "sha256:"


def new_key() -> str:
    """Create a key of 256 random bits.

    Keys are as hard to guess as their hashes, so that a fast hash keeps them (no password is ever one).
    """
    return "spb_" + secrets.token_urlsafe(32)


def hash_key(key: str) -> str:
    """Return the hash of a key; the service stores nothing else of it."""
    return _PREFIX + hashlib.sha256(key.encode()).hexdigest()


def check_hash(text: str) -> None:
    """Check that ``text`` has the form that :func:`hash_key` returns; raise ValueError if not."""
    if not re.fullmatch(r"sha256:[0-9a-f]{64}", text):
        raise ValueError("no hash of a key; `splatbot serve --new-key` prints a key and its hash")


def known_key(key: str, hashes: Sequence[str]) -> str | None:
    """Return the hash of ``key`` if it is known, else None, in time that does not depend on the hashes."""
    given, found = hash_key(key), None
    for known in hashes:
        if hmac.compare_digest(given, known):
            found = known
    return found
