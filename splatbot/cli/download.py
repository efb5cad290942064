"""`splatbot download`: public recordings from their official addresses."""

from __future__ import annotations

import os
import shlex
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from splatbot.cli.messages import print_message
from splatbot.cli.paths import check_output
from splatbot.cli.progress import CONSTANTS, shares
from splatbot.cli.tables import print_columns, print_command, print_text
from splatbot.errors import InputError

if TYPE_CHECKING:
    from splatbot.downloads import Downloaded, PublicRecording, Step


def download(
    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")] = "",
    /,
    *,
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    url_base: Annotated[str | None, tyro.conf.arg(metavar="URL")] = None,
    list_: Annotated[bool, tyro.conf.arg(name="list")] = False,
    quiet: bool = False,
) -> None:
    """Fetch a public RGB-D recording from its official address, check it, and unpack it.

    An interrupted download continues when the command is repeated. The folder appears only when it is whole; a whole
    folder is not fetched again. Proxies are those of HTTPS_PROXY and NO_PROXY.

    Examples:
        splatbot download --list
        splatbot download tum/fr1_desk
        splatbot download replica/nice-slam --out /data/replica
        splatbot download tum/fr1_desk --url-base https://mirror.example.org/datasets

    Args:
        name: the recording; --list prints all names.
        out: folder to write; recordings/NAME by default.
        url_base: mirror, which replaces scheme and host of the official address; or SPLATBOT_DOWNLOAD_URL_BASE.
        list_: print the recordings with their sizes and terms, and leave.
        quiet: no progress, no summary, only errors.
    """
    from splatbot.downloads import catalogue, find_recording
    from splatbot.downloads import download as fetch

    if list_:
        _print_list(list(catalogue().values()))
        return
    if not name:
        raise InputError("is missing.", field="NAME", hint="splatbot download --list prints all names")
    recording = find_recording(name)
    folder = out or Path("recordings") / recording.name
    check_output(folder)
    try:
        with _steps(quiet) as step:
            found = fetch(
                recording,
                folder,
                url_base=url_base or os.environ.get("SPLATBOT_DOWNLOAD_URL_BASE") or None,
                step=step,
                notice=lambda sentence: print_message("warning", sentence),
            )
    except KeyboardInterrupt:
        print_message("warning", "the received part is kept; the same command continues")
        raise
    if not quiet:
        _report(recording, found)


def _report(recording: PublicRecording, found: Downloaded) -> None:
    if not found.fresh:
        print_text(f"{found.folder}: complete since an earlier download")
    elif found.pin is None:
        print_text(f"{found.folder}: complete; the archive has the sha256 of the catalogue")
    else:
        print_text(f"{found.folder}: complete; the catalogue has no sha256 of this archive, so that it was not checked")
        print_text(f"{found.pin}: the sha256 that later downloads must equal")
    print(f"sha256 {found.sha256}")
    if found.log != found.folder:
        print_text(f"recordings in it: {', '.join(sorted(p.name for p in found.folder.iterdir() if p.is_dir()))}")
    print_text(recording.terms)
    camera = f" --camera {recording.camera}" if recording.camera else ""
    print_command(f"splatbot map {shlex.quote(str(found.log))}{camera}")


def _print_list(recordings: list[PublicRecording]) -> None:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for header in ("name", "size", "sha256", "camera"):
        table.add_column(header)
    for recording in recordings:
        size = f"{recording.size / 1e6:,.0f} MB" if recording.size else "unknown"
        known = "known" if recording.sha256 else "pinned by the first download"
        table.add_row(recording.name, size, known, recording.camera or "its own")
    print_columns(table)
    for terms in dict.fromkeys(recording.terms for recording in recordings):
        names = [recording.name for recording in recordings if recording.terms == terms]
        print_text(f"{names[0].partition('/')[0]}: {terms}")


@contextmanager
def _steps(quiet: bool) -> Iterator[Step]:
    """Yield a callback that shows progress: a bar on a terminal, a line every two seconds elsewhere."""
    if not quiet and not sys.stderr.isatty():
        yield PlainSteps()
        return
    with shares(quiet) as show:
        yield lambda name, done, total: show(describe(name, done, total), done / total if total else 0.0)


class PlainSteps:
    """Prints a line when a step begins and when two seconds have passed."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._due, self._step = 0.0, ""

    def __call__(self, name: str, done: int, total: int | None) -> None:
        """Show the progress of a step, if it is due."""
        if name != self._step or self._clock() >= self._due:
            self._step, self._due = name, self._clock() + CONSTANTS.plain_period
            print(describe(name, done, total), file=sys.stderr, flush=True)


def describe(name: str, done: int, total: int | None) -> str:
    """Return one line on the progress of a step."""
    return f"{name} {done / 1e6:.0f}/{total / 1e6:.0f} MB" if total else f"{name} {done / 1e6:.0f} MB"
