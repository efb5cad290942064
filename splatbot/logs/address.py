"""Addresses of logs: a path, and options after a question mark."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from splatbot.errors import LogError

PAIR_WITHIN = "pair_within"
"""Option of logs whose images are paired by their stamps: the largest difference of a pair [s]."""

_MAX_PAIR_WITHIN_S = 10.0


def split_address(uri: str, known: Sequence[str]) -> tuple[Path, dict[str, str]]:
    """Split `PATH?key=value&key=value` into the path and the options. A path that exists has no options.

    Args:
        uri: the address.
        known: keys of the options.

    Raises:
        LogError: a key is unknown.
    """
    if Path(uri).exists():
        return Path(uri), {}
    path, _, query = uri.partition("?")
    given = {key: value for key, _, value in (pair.partition("=") for pair in query.split("&") if pair)}
    for key in given:
        if key not in known:
            hint = f"the options are {', '.join(known)}"
            raise LogError(f"has no option {key!r:.40}.", file=path, field="log", hint=hint)
    return Path(path), given


def join_address(path: Path, options: dict[str, str]) -> str:
    """Return `PATH?key=value&key=value`, or the path without options."""
    return str(path) + ("?" + "&".join(f"{key}={value}" for key, value in options.items()) if options else "")


def seconds_of_option(path: Path, options: dict[str, str], default: float) -> float:
    """Return the largest difference of the stamps of a pair [s] among the options.

    Raises:
        LogError: it is no number above 0 and up to 10 s.
    """
    text = options.get(PAIR_WITHIN)
    if text is None:
        return default
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0.0 < seconds <= _MAX_PAIR_WITHIN_S:
        hint = f"give seconds, above 0 and up to {_MAX_PAIR_WITHIN_S:g}: ?{PAIR_WITHIN}=0.05"
        raise LogError(f"is {text!r:.40}.", file=path, field=PAIR_WITHIN, hint=hint)
    return seconds
