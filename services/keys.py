"""API keys: random, kept as hashes, compared in constant time; each grants scopes."""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
from collections.abc import Iterable, Sequence
from typing import Literal, get_args

Scope = Literal["read", "map", "move", "admin"]
SCOPES: frozenset[Scope] = frozenset(get_args(Scope))

_PREFIX = "sha256:"
_ENTRY = re.compile(r"(sha256:[0-9a-f]{64})(?::([a-z+]+))?")
_DEFAULT: frozenset[Scope] = frozenset({"read", "map", "move"})


def new_key() -> str:
    """Create a key of 256 random bits.

    Keys are as hard to guess as their hashes, so that a fast hash keeps them (no password is ever one).
    """
    return "spb_" + secrets.token_urlsafe(32)


def hash_key(key: str, scopes: Iterable[Scope] | None = None) -> str:
    """Return the hash of a key; the service stores nothing else of it.

    Args:
        key: as :func:`new_key` returns it.
        scopes: that the key grants, appended as ``:read+map``. If None, they are read, map and move.
    """
    entry = _PREFIX + hashlib.sha256(key.encode()).hexdigest()
    return entry if scopes is None else f"{entry}:{'+'.join(scope for scope in get_args(Scope) if scope in scopes)}"


def check_hash(text: str) -> None:
    """Check that ``text`` has the form that :func:`hash_key` returns; raise ValueError if not."""
    if not (found := _ENTRY.fullmatch(text)):
        raise ValueError("no hash of a key; `splatbot serve --new-key` prints a key and its hash")
    if found[2]:
        check_scopes(found[2].split("+"))


def check_scopes(words: Sequence[str]) -> tuple[Scope, ...]:
    """Check scopes by name; "read" is always one of them. Raise ValueError at an unknown name."""
    wrong = set(words) - SCOPES
    if wrong:
        raise ValueError(f"no scope {sorted(wrong)[0][:40]!r}; the scopes are {', '.join(get_args(Scope))}")
    return tuple(scope for scope in get_args(Scope) if scope in words or scope == "read")


def scopes_of(entry: str) -> frozenset[Scope]:
    """Return the scopes of an entry of ``api_keys``."""
    _, _, words = entry.removeprefix(_PREFIX).partition(":")
    return frozenset(check_scopes(words.split("+"))) if words else _DEFAULT


def known_key(key: str, entries: Sequence[str]) -> str | None:
    """Return the entry of ``key`` if it is known, else None, in time that does not depend on the entries."""
    given, found = hash_key(key), None
    for known in entries:
        if hmac.compare_digest(given, known[: len(given)]):
            found = known
    return found
