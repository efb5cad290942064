"""The page of `splatbot train --viewer`."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from splatbot.errors import InputError

if TYPE_CHECKING:
    from splatbot.services.live_training.server import LivePage
    from splatbot.training.session import StepObserver, TrainingSession


def viewer_port(given: tuple[int, ...] | None) -> int | None:
    """Return the port of --viewer [PORT]; None without the option."""
    if given is None:
        return None
    from splatbot.services.live_training.server import DEFAULT_PORT

    if len(given) > 1 or not all(0 <= port <= 65535 for port in given):
        raise InputError(f"is {' '.join(map(str, given))}.", field="--viewer", hint="give one port from 0 to 65535")
    return given[0] if given else DEFAULT_PORT


@contextmanager
def served_page(port: int | None) -> Iterator[LivePage | None]:
    """Yield the page of --viewer, which is served during the block, and print its address; None without a port."""
    if port is None:
        yield None
        return
    from splatbot.services.live_training.server import HOST, LivePage
    from splatbot.services.viewer.door import opening_address

    with LivePage(port) as page:
        address = opening_address(page.access, HOST, page.port, to_terminal=sys.stdout.isatty())
        print(f"{address} shows the training", flush=True)
        yield page


@contextmanager
def shown_on_page(session: TrainingSession, page: LivePage | None, name: str, *, quiet: bool) -> Iterator[StepObserver]:
    """Yield the observer that shows a training on a page, and print its share of the time after the block."""
    if page is None:
        yield lambda loss: None
        return
    from splatbot.services.live_training.viewer import LiveTraining

    live = LiveTraining(session, page, name)
    try:
        yield live
    finally:
        live.end()
    if not quiet:
        print(f"the viewer took {100 * live.budget.used:.1f} % of the time", flush=True)
