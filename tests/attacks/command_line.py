"""Arguments and exit code that the commands of random attacks share."""

from __future__ import annotations

import argparse
from collections.abc import Sequence


def seeded_parser(doc: str | None, count: int) -> argparse.ArgumentParser:
    """Return a parser of ``--count``, the number of attacks, and ``--seed``."""
    parser = argparse.ArgumentParser(description=doc)
    parser.add_argument("--count", type=int, default=count)
    parser.add_argument("--seed", type=int, default=0)
    return parser


def exit_code(failures: Sequence[str]) -> int:
    """Print the first 20 failures; return 1 if there is one, else 0."""
    for line in failures[:20]:
        print(" ", line)
    return 1 if failures else 0
