"""Items of a batch: each input with each combination of options."""

from __future__ import annotations

import os
import re
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path

from splatbot.batch.item import BatchItem
from splatbot.errors import InputError

MOST_ITEMS = 10_000
_MOST_CHARACTERS = 120  # of a name
_NAMED = re.compile(r"([\w.-]+)=(.+)")
_RESERVED = ("batch.json", "batch.csv", "batch.lock")


def make_items(
    command: str, inputs: Sequence[str], options: Sequence[Sequence[str]], settings: Mapping[str, str]
) -> list[BatchItem]:
    """Return an item for each input and each combination of the values of the options.

    Args:
        command: command of splatbot.
        inputs: logs, scenes or folders, one an item; ``NAME=INPUT`` names the item. Without inputs, the options alone
            make the items.
        options: name of an option and its values; none for a flag. A value may have several words, as in a shell.
        settings: see :class:`splatbot.batch.item.BatchItem`.

    Raises:
        InputError: there are too many items, two have the same name, or a name cannot be one of a folder.
    """
    count = max(len(inputs), 1)
    for option in options:
        count *= max(len(option) - 1, 1)
    if count > MOST_ITEMS:
        raise InputError(f"{count:,} items.", field="batch", hint=f"at most {MOST_ITEMS:,} fit into one batch")
    named = [_named(text) for text in inputs] or [("", [])]
    choices = [_choices(option) for option in options]
    items = [
        BatchItem(
            _name([name, *(label for label, _ in chosen)]) or command,
            (command, *words, *(word for _, more in chosen for word in more)),
            settings,
        )
        for name, words in named
        for chosen in product(*choices)
    ]
    _check_names([item.name for item in items])
    return items


def _named(text: str) -> tuple[str, list[str]]:
    """Return the name of an input and its words; a path becomes absolute."""
    match = None if Path(text).exists() else _NAMED.fullmatch(text)
    given, text = match.groups() if match else ("", text)
    head, mark, options = (text, "", "") if os.path.exists(text) else text.partition("?")  # noqa: PTH110 - long options
    if not os.path.exists(head):  # noqa: PTH110
        return given or _slug(text.removeprefix("synthetic:")), [text]
    path = Path(head).absolute()
    return given or _slug(path.stem if path.is_file() else path.name), [f"{path}{mark}{options}"]


def _choices(option: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Return the label and the words of each value of an option; an option with one value adds nothing to names."""
    name, *values = option
    if len(values) < 2:
        return [("", [f"--{name}", *(word for value in values for word in shlex.split(value))])]
    return [(f"{name}-{_slug(value)}", [f"--{name}", *shlex.split(value)]) for value in values]


def _name(parts: Sequence[str]) -> str:
    return "-".join(filter(None, parts))


def _slug(text: str) -> str:
    return re.sub(r"[^\w.]+", "-", text).strip("-.")


def _check_names(names: Sequence[str]) -> None:
    for name, count in Counter(names).items():
        if count > 1:
            hint = "name them, as in: first=INPUT second=INPUT"
            raise InputError(f"{count} items have the name {name!r}.", field="INPUT", hint=hint)
        if len(name) > _MOST_CHARACTERS or name.startswith(".") or name in _RESERVED:
            raise InputError(f"the name {name!r} cannot be one of a folder.", field="INPUT", hint="write NAME=INPUT")
