"""Building blocks of HTML pages with all content inline."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence
from importlib import resources

from splatbot.report.theme import data_uri


def document(title: str, subtitle: str, parts: Iterable[str]) -> str:
    """Return a whole HTML page; ``parts`` are HTML, the titles are plain text."""
    css = resources.files("splatbot.report").joinpath("style.css").read_text(encoding="utf-8")
    name = html.escape(title)
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{name} · splatbot</title>\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<style>\n{css}</style></head>\n'
        f'<body><main>\n<h1>{name}</h1>\n<p class="sub">{html.escape(subtitle)}</p>\n'
        f"{''.join(parts)}</main></body></html>\n"
    )


def section(title: str, *parts: str) -> str:
    """Return a titled section, or an empty string if its body is empty."""
    body = "".join(parts)
    return f"<section><h2>{title}</h2>\n{body}</section>\n" if body else ""


def details(title: str, body: str) -> str:
    """Return a section that is collapsed until the reader opens it."""
    return f"<section><details><summary>{title}</summary>{body}</details></section>\n"


def note(text: str) -> str:
    """Return a remark; ``text`` is HTML."""
    return f'<p class="note">{text}</p>'


def image(data: bytes | None, text: str) -> str:
    """Return an inline PNG with its description, or an empty string if there is no image."""
    return f'<img alt="{html.escape(text)}" src="{data_uri(data)}">' if data is not None else ""


def pictures(images: Iterable[tuple[bytes, str]]) -> str:
    """Return captioned PNGs side by side."""
    figures = "".join(
        f"<figure>{image(data, text)}<figcaption>{html.escape(text)}</figcaption></figure>" for data, text in images
    )
    return f'<div class="view">{figures}</div>\n'


def tiles(values: Iterable[tuple[str, str]]) -> str:
    """Return figures (value, label) in large letters."""
    cells = "".join(f'<div class="tile"><b>{value}</b><span>{label}</span></div>' for value, label in values)
    return f'<div class="tiles">{cells}</div>\n'


def table(head: Iterable[str], rows: Sequence[Iterable[str]]) -> str:
    """Return a table of plain text, or an empty string if there are no rows."""
    if not rows:
        return ""
    lines = ["".join(f"<th>{html.escape(cell)}</th>" for cell in head)]
    lines += ["".join(f"<td>{html.escape(cell)}</td>" for cell in row) for row in rows]
    return '<div class="scroll"><table>' + "".join(f"<tr>{line}</tr>" for line in lines) + "</table></div>"
