"""`splatbot batch`."""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from splatbot.cli.messages import print_message
from splatbot.cli.paths import check_output
from splatbot.errors import InputError
from splatbot.layouts import is_camera, log_kind

if TYPE_CHECKING:
    from splatbot.batch.item import BatchItem, ItemRecord

_OF_LOGS = ("map", "sim2real")  # commands whose input is a log
_OF_PATHS = ("train", "export")  # commands whose input is a path
_NEED_INPUT = ("map", "simulate", "pick", *_OF_PATHS)


def batch(
    command: Annotated[
        Literal["map", "train", "trials", "simulate", "export", "sim2real", "plan", "plan-pick", "grasp", "pick"],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="COMMAND"),
    ],
    inputs: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="INPUT ...")] = (),
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")],
    options: Annotated[
        tuple[tuple[str, ...], ...],
        tyro.conf.arg(name="with", metavar="OPTION [VALUE ...]"),
        tyro.conf.UseAppendAction,
    ] = (),
    workers: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    ray: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None,
    threads: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    quiet: bool = False,
) -> int:
    """Run a command for many logs, scenes or options, in parallel processes or on a Ray cluster.

    COMMAND is map, train, trials, simulate, export, sim2real, plan, plan-pick, grasp or pick. It runs once for each
    INPUT, and writes to DIR/INPUT. With several values of an option it runs once for each value too.

    DIR/INPUT/item.json records the end of an item, its time and its error; item.log is the text that it printed. The
    same command again computes only items that are not finished. Ctrl-C keeps the finished ones. Writes batch.json and
    batch.csv: time, error, trajectory error, PSNR and Gaussians of each item.

    Examples:
        splatbot batch map recordings/* --out runs/all --workers 4
        splatbot batch map recordings/* --out runs/all --with no-report --with camera tum_fr1
        splatbot batch map desk=a/log lab=b/log --out runs/sizes --with set mapping.max_gaussians={20000,50000}
        splatbot batch train scenes/* --out runs/trained --with iterations 7000 30000
        splatbot batch trials --out runs/picks --with scenes bin shelf --with first 0 50 --with trials 50
        splatbot batch map /shared/logs/* --out /shared/runs --ray head:6379

    Args:
        command: command that runs for each item.
        inputs: log, scene, photographs or run of each item; NAME=INPUT names the item.
        out: folder of the batch. With Ray, it and the inputs are on a file system that all nodes see at this path.
        options: option of the command, without its dashes. Several values make an item of each; quote a value of
            several words. Repeatable.
        workers: number of processes at a time; one for each core by default.
        ray: run on a Ray cluster: its HOST:PORT, auto for the one of this machine, local for a new one here. Needs
            splatbot[cluster] on all nodes.
        threads: threads of each item; the cores divided by the workers by default, one with Ray.
        quiet: print only errors.
    """
    _check(command, inputs, options, out, workers, ray, threads)

    from splatbot.batch.report import batch_rows, write_report
    from splatbot.batch.run import reserved, run_batch, unfinished
    from splatbot.batch.sweep import make_items
    from splatbot.batch.workers import local_workers, ray_workers, usable_cores
    from splatbot.cli.progress import shares

    items = make_items(command, inputs, options, _settings(os.environ))
    _check_items(command, inputs, items)
    folder = out.absolute()
    with reserved(folder):
        pending = unfinished(items, folder)
        if ray is not None:
            pool = ray_workers(ray, folder, threads or 1)
        else:
            count = min(workers or usable_cores(), len(pending)) or 1
            pool = local_workers(count, folder, threads or max(1, usable_cores() // count))
        states = Counter(finished=len(items) - len(pending))
        with shares(quiet) as tell:

            def show_state() -> None:
                tell(f"{states.total()} of {len(items)} items", states.total() / len(items))

            def show(item: BatchItem, record: ItemRecord) -> None:
                states["finished" if record.finished else "failed"] += 1
                show_state()
                if not quiet:
                    print_message(item.name, record.error or f"finished, {record.seconds:.1f} s")

            show_state()
            interrupted = bool(pending) and run_batch(pending, folder, pool, on_end=show)
        rows = batch_rows(items, folder)
        write_report(rows, folder, interrupted=interrupted)
    if not quiet:
        _print(rows, folder)
    if interrupted:
        print("interrupted; the same command continues", file=sys.stderr)
    return 130 if interrupted else int(states["finished"] < len(items))


def _check(
    command: str,
    inputs: Sequence[str],
    options: Sequence[Sequence[str]],
    out: Path,
    workers: int | None,
    ray: str | None,
    threads: int | None,
) -> None:
    """Refuse wrong words before the libraries load."""
    check_output(out)
    if not inputs and (command in _NEED_INPUT or not options):
        raise InputError("is missing.", field="INPUT", hint=f"name inputs, as in: splatbot batch {command} INPUT INPUT")
    for option in options:
        if not option or option[0] == "out":
            hint = "write --with OPTION [VALUE ...]; each item has its own --out"
            raise InputError(f"is {' '.join(option)!r}.", field="--with", hint=hint)
    if workers is not None and ray is not None:
        raise InputError("excludes --ray.", field="--workers", hint="Ray starts a worker for each --threads cores")
    for flag, number in (("--workers", workers), ("--threads", threads)):
        if number is not None and number < 1:
            raise InputError(f"is {number}.", field=flag, hint="give at least 1")


def _check_items(command: str, inputs: Sequence[str], items: Sequence[BatchItem]) -> None:
    """Refuse inputs that do not exist, and options that the command does not know, before an item runs."""
    combinations = len(items) // max(len(inputs), 1)
    for item in items[::combinations] if inputs else ():
        _check_input(command, item.words[1])
    for item in items[:combinations]:
        _check_options(item.words)


def _check_input(command: str, text: str) -> None:
    if command in _OF_LOGS:
        if is_camera(text):
            raise InputError("is a camera.", field=text, hint="name recordings; splatbot map records and maps a camera")
        if log_kind(text) == "synthetic":
            _check_scene(text)
    elif command == "simulate":
        _check_scene(f"synthetic:{text}")
    elif command in _OF_PATHS and not Path(text).exists():
        raise InputError("does not exist.", file=text, field="INPUT", hint="check the path")


def _check_scene(uri: str) -> None:
    from splatbot.logs.synthetic import SyntheticLog

    SyntheticLog(uri)  # refuses an unknown scene; no frame is rendered


def _check_options(words: Sequence[str]) -> None:
    """Let the parser of the command read its words, without running it; it prints its errors and exits."""
    import functools
    import importlib

    from splatbot.cli import COMMANDS
    from splatbot.cli.help import parsed

    name, *rest = words
    command = COMMANDS[name]
    function = getattr(importlib.import_module(command.module), command.function)
    parse = functools.wraps(function)(lambda *_, **__: None)
    parsed(parse, f"splatbot {name}", [*rest, "--out", "DIR"])


def _settings(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the variables that results depend on, which workers on other machines need too."""
    from splatbot.config.layout import known_sections

    sections = {*known_sections(), "isa"}
    parts = {name: name.removeprefix("SPLATBOT_").lower().split("__")[0] for name in environment}
    return {
        name: environment[name]
        for name, section in sorted(parts.items())
        if name.startswith("SPLATBOT_") and section in sections
    }


def _print(rows: Sequence[Mapping[str, Any]], folder: Path) -> None:
    from rich.table import Table
    from rich.text import Text

    from splatbot.cli.tables import print_columns
    from splatbot.results.units import count, decibels, metres, number, percent

    columns: dict[str, tuple[str, Callable[[Any], str]]] = {
        "name": ("item", str),
        "state": ("state", str),
        "seconds": ("seconds", lambda value: number(value, 1)),
        "ate_rmse_m": ("ATE RMSE", metres),
        "psnr_db": ("PSNR", decibels),
        "ssim": ("SSIM", lambda value: number(value, 3)),
        "gaussians": ("Gaussians", count),
        **{key: (key.replace("_", " "), percent) for row in rows for key in row if key.startswith("success_")},
        "error": ("error", str),
    }
    shown = {key: column for key, column in columns.items() if any(row.get(key) not in (None, "") for row in rows)}
    table = Table(*(title for title, _ in shown.values()))
    for row in rows:
        table.add_row(
            *(Text(text(row.get(key))) if row.get(key) is not None else "" for key, (_, text) in shown.items())
        )
    print_columns(table)
    print(f"written to {folder / 'batch.json'} and batch.csv")
