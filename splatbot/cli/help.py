"""Help of commands: whole paragraphs, defaults in words, and no line beyond the terminal."""

from __future__ import annotations

import inspect
import io
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from itertools import takewhile
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import tyro

from splatbot.errors import InputError

_COLUMNS = 120  # widest text of a help
_BLANK_ROW, _ESCAPES = re.compile(r"│\s+│"), re.compile(r"\x1b\[[0-9;]*m")
_HELP = {"-h", "--help"}
_LARGE = 1e6  # defaults from here on have exponents
_ON = "(on by default; this option turns it off)"


def parsed(documented: Callable[..., Any], program: str, words: Sequence[str]) -> Any:
    """Call a command, or make a dataclass, with the options of a command line; print the help and exit on --help.

    Raises:
        InputError: an option of several numbers, as a pose, has too few or too many of them.
    """
    if not _HELP & set(words):
        _check_numbers(documented, words)
    with fitted_help(words):
        return tyro.cli(
            explained(documented),
            prog=program,
            description=description(documented),
            args=list(words),
            config=(tyro.conf.FlagCreatePairsOff,),
        )


def _check_numbers(documented: Callable[..., Any], words: Sequence[str]) -> None:
    """Check the options of several numbers, of which tyro prints the names of its types.

    Raises:
        InputError: one has another number of values, or values that are no numbers.
    """
    for name, hint in get_type_hints(documented, include_extras=True).items():
        count, flag = _count_of(hint), f"--{name.replace('_', '-')}"
        if count == 0 or flag not in words:
            continue
        following = words[words.index(flag) + 1 :]
        if len(list(takewhile(_is_number, following))) == count:  # other words may follow, as the map
            continue
        values = list(takewhile(lambda word: _is_number(word) or not word.startswith("-"), following))
        wrong = next((value for value in values if not _is_number(value)), None)
        metavar = next((found for part in hint.__metadata__ if (found := getattr(part, "metavar", None))), "")
        examples = re.findall(rf"{flag}((?: [-+.\deE]+){{{count}}})(?= |$)", documented.__doc__ or "", re.MULTILINE)
        example = f", as in {flag}{examples[0]}" if examples else ""
        has = (
            f"has {len(values)} values, not {count}." if len(values) != count else f"has {wrong!r}, which is no number."
        )
        raise InputError(has, field=flag, hint=f"give {count} numbers, {metavar}{example}")


def _count_of(hint: Any) -> int:
    """Return the count of numbers of an option whose type is a tuple of that many floats, else 0."""
    if get_origin(hint) is not Annotated:
        return 0
    (declared, *_) = get_args(hint)
    for part in (declared, *get_args(declared)):
        kinds = get_args(part) if get_origin(part) is tuple else ()
        if kinds and set(kinds) == {float}:
            return len(kinds)
    return 0


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def explained(documented: Callable[..., Any]) -> Callable[..., Any]:
    """Return a command whose options have their whole explanation of the docstring, and a default in words.

    Tyro keeps the line breaks of the docstring, and prints "default: None" and "default: True".

    Args:
        documented: function, or dataclass with the options; the docstrings of its bases count too.
    """
    texts: dict[str, str] = {}
    for part in reversed(inspect.getmro(documented)) if inspect.isclass(documented) else (documented,):
        texts |= _explanations(part.__doc__ or "")
    signature, hints = inspect.signature(documented), get_type_hints(documented, include_extras=True)

    def command(*values: Any, **options: Any) -> Any:
        return documented(*values, **options)

    command.__signature__ = signature  # type: ignore[attr-defined]
    command.__annotations__ = {
        name: Annotated[hints[name], tyro.conf.arg(help=texts.get(name), help_behavior_hint=_hint(option.default))]
        for name, option in signature.parameters.items()
    }
    return command


def _hint(default: object) -> str | None:
    """Return the text after an explanation, or None for that of tyro, which prints the default."""
    if default is True:
        return _ON
    if isinstance(default, float) and abs(default) >= _LARGE:
        return f"(default: {default:g})".replace("e+0", "e")
    return "" if default is None or default is False or default == () else None


def _explanations(docstring: str) -> dict[str, str]:
    """Return the explanation of each name in the section "Args:" of a docstring."""
    section = re.split(r"\n(?=\S)", inspect.cleandoc(docstring).partition("\nArgs:\n")[2])[0]
    found: dict[str, str] = {}
    for entry in re.split(r"(?:^|\n) {4}(?=\S)", section)[1:]:
        names, _, text = entry.partition(":")
        found |= dict.fromkeys(names.split(", "), " ".join(text.split()))
    return found


def description(documented: object) -> str:
    """Return the docstring of a command up to its "Args:", wrapped to the terminal; tyro would drop the examples.

    An example that does not fit is continued on the next line, so that it can be copied. Tyro joins lines that begin
    with a letter, hence the indentation.
    """
    return wrapped(inspect.cleandoc(getattr(documented, "__doc__", None) or "").split("\nArgs:")[0].rstrip())


def wrapped(text: str) -> str:
    """Wrap paragraphs to the terminal, and continue indented lines with a backslash."""
    width = min(shutil.get_terminal_size().columns, _COLUMNS) - 2
    paragraphs = []
    for paragraph in text.split("\n\n"):
        lines = paragraph.splitlines()
        if any(line.startswith(" ") for line in lines):
            paragraphs.append("\n".join(_continued(line, width) for line in lines))
        else:
            paragraphs.append(textwrap.fill(" ".join(lines), width, subsequent_indent=" ", break_on_hyphens=False))
    return "\n\n".join(paragraphs)


def _continued(line: str, width: int) -> str:
    if len(line) <= width:
        return line
    indent = " " * (len(line) - len(line.lstrip()))
    parts = textwrap.wrap(line.strip(), width - len(indent) - 6, break_on_hyphens=False, break_long_words=False)
    return " \\\n".join([indent + parts[0], *(f"{indent}    {part}" for part in parts[1:])])


@contextmanager
def fitted_help(words: Sequence[str]) -> Iterator[None]:
    """Wrap the usage of a help, which tyro prints in one line, to the terminal."""
    if not _HELP & set(words):
        yield
        return
    text = _Held()
    try:
        with redirect_stdout(text):
            yield
    finally:
        print(_fitted(text.getvalue()), end="")


def _fitted(text: str) -> str:
    """Return a help of tyro with its usage wrapped, and without the marks and blank rows of its paragraphs."""
    usage, _, rest = text.partition("\n")
    usage = re.sub(r"\{[^}]*\}$", "COMMAND", _ESCAPES.sub("", usage).rstrip())
    columns = shutil.get_terminal_size().columns
    lines = textwrap.wrap(usage, columns, subsequent_indent="    ", break_on_hyphens=False)
    lines += [line.rstrip() for line in rest.split("\n") if not _BLANK_ROW.fullmatch(_ESCAPES.sub("", line))]
    return re.sub(r"\n{3,}", "\n\n", re.sub(r"\n (?=[^ ])", "\n", "\n".join(lines)))


class _Held(io.StringIO):
    """Text of a help, which has colours if the terminal has."""

    def isatty(self) -> bool:
        return sys.__stdout__ is not None and sys.__stdout__.isatty()

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return "utf-8" if sys.__stdout__ is None else sys.__stdout__.encoding
