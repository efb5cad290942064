"""Elements of PLY files as structured arrays: ASCII, and binary in both byte orders.

Source: Greg Turk, The PLY Polygon File Format, 1994, with the type names of later writers (int8 to float64). A header
lists elements, and for each its number of rows and its properties. The rows follow in the order of the header.

Elements are read up to the last one that the caller names, and none of them may have a list. So the vertices of a mesh
are read, and its faces, which follow and have lists, are not.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from splatbot.atomic import atomic_write
from splatbot.errors import FormatError
from splatbot.formats.checks import MAX_GAUSSIANS, damaged

Rows = NDArray[np.void]

_MAX_HEADER = 2**20  # bytes
_MAX_ELEMENTS, _MAX_PROPERTIES = 64, 4096  # of an element
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_TYPES |= {"float": "f4", "double": "f8"}
_NAMES = {code: name for name, code in _TYPES.items()}
_TYPES |= {f"{kind}{8 * size}": f"{kind[0]}{size}" for kind in ("int", "uint") for size in (1, 2, 4)}
_TYPES |= {"float32": "f4", "float64": "f8"}


@dataclass(frozen=True)
class PlyElement:
    """An element of a header.

    Args:
        name: such as "vertex".
        count: number of rows.
        types: numpy type code by property; of a list, that of its length.
        lists: names of the properties that are lists.
    """

    name: str
    count: int
    types: dict[str, str] = field(default_factory=dict)
    lists: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class PlyHeader:
    """A header whose counts fit the size of the file.

    Args:
        order: byte order of the rows, "<" or ">"; empty for ASCII.
        elements: in the order of the file.
        size: [bytes] of the header.
    """

    order: str
    elements: list[PlyElement]
    size: int


def read_ply_header(path: str | Path) -> PlyHeader:
    """Read the header of a PLY file.

    Raises:
        FormatError: the file cannot be read, the header is damaged, or the file is too small for the claimed rows.
    """
    try:
        with Path(path).open("rb") as file:
            return _read_header(path, file)
    except OSError as error:
        raise _unreadable(path, error) from error


def read_ply(path: str | Path, names: Collection[str]) -> dict[str, Rows]:
    """Read the named elements, as far as a PLY file has them, with the numbers in their types of the file.

    Raises:
        FormatError: the file cannot be read, is damaged or truncated, or one of the elements up to the last named one
            has a list.
    """
    try:
        with Path(path).open("rb") as file:
            header = _read_header(path, file)
            file.seek(header.size)
            present = [element.name for element in header.elements]
            last = max((present.index(name) for name in names if name in present), default=-1)
            rows = [_read_rows(path, file, header.order, element) for element in header.elements[: last + 1]]
    except OSError as error:
        raise _unreadable(path, error) from error
    return {name: values for name, values in zip(present, rows, strict=False) if name in names}


def write_ply(path: str | Path, elements: Mapping[str, Rows]) -> None:
    """Write a binary PLY file; ``path`` is replaced only once the file is complete.

    Args:
        path: the file.
        elements: rows by name; their numbers are little-endian.
    """
    header = ["ply", "format binary_little_endian 1.0"]
    for name, rows in elements.items():
        header.append(f"element {name} {len(rows)}")
        header += [f"property {_NAMES[rows.dtype[key].str[1:]]} {key}" for key in rows.dtype.names or ()]
    with atomic_write(path) as file:
        file.write(("\n".join(header) + "\nend_header\n").encode())
        for rows in elements.values():
            file.write(np.ascontiguousarray(rows).view(np.uint8).data)


def _read_header(path: str | Path, file: BinaryIO) -> PlyHeader:
    start = file.read(_MAX_HEADER)
    newline = b"\r\n" if start.startswith(b"ply\r\n") else b"\n"
    text, end, _ = start.partition(newline + b"end_header" + newline)
    if not (start.startswith(b"ply" + newline) and end):
        raise damaged(path, "vertex", "the header has no first line `ply`, or no last line `end_header`")
    formats: list[str] = []
    elements: list[PlyElement] = []
    for line in text.decode("latin-1").split(newline.decode())[1:]:
        try:
            _read_line(line.split(), formats, elements)
        except (LookupError, ValueError) as error:
            name = elements[-1].name if elements else "vertex"
            raise damaged(path, name, f"the line `{line[:60]}` of the header is wrong: {error}") from error
    if not formats:
        raise damaged(path, "format", "the header has no line `format`")
    size = os.fstat(file.fileno()).st_size
    for element in elements:
        least = sum(int(code[1:]) if formats[0] else 1 for code in element.types.values())
        if not 0 <= element.count <= MAX_GAUSSIANS or element.count * least > size:
            raise damaged(path, element.name, f"the header claims {element.count:,} rows")
    return PlyHeader(formats[0], elements, len(text) + len(end))


def _read_line(words: list[str], formats: list[str], elements: list[PlyElement]) -> None:
    """Add a line of a header to the formats or the elements."""
    match words:
        case [] | ["comment" | "obj_info", *_]:
            pass
        case ["format", name, "1.0"] if not formats:
            formats.append(_ORDERS[name])
        case ["element", *_] if len(elements) == _MAX_ELEMENTS:
            raise ValueError(f"more than {_MAX_ELEMENTS} elements")
        case ["property", *_] if len(elements[-1].types) == _MAX_PROPERTIES:
            raise ValueError(f"more than {_MAX_PROPERTIES} properties")
        case ["element", name, count] if name not in (element.name for element in elements):
            elements.append(PlyElement(name, int(count)))
        case ["property", "list", length, kind, name] if kind in _TYPES and name not in elements[-1].types:
            elements[-1].types[name] = _TYPES[length]
            elements[-1].lists.append(name)
        case ["property", kind, name] if name not in elements[-1].types:
            elements[-1].types[name] = _TYPES[kind]
        case _:
            raise ValueError("unknown, or a repetition")


def _read_rows(path: str | Path, file: BinaryIO, order: str, element: PlyElement) -> Rows:
    """Read the rows of an element, which begin at the position of the file."""
    if element.lists:
        hint = "write the vertices first, without lists"
        raise FormatError(f"is the list {element.lists[0]}.", file=path, field=element.name, hint=hint)
    dtype = np.dtype([(name, (order or "<") + code) for name, code in element.types.items()])
    if not (element.count and element.types):
        return np.zeros(element.count, dtype)
    return _read_binary(path, file, dtype, element) if order else _read_text(path, file, dtype, element)


def _read_binary(path: str | Path, file: BinaryIO, dtype: np.dtype[np.void], element: PlyElement) -> Rows:
    rows = np.fromfile(file, dtype, element.count)
    if len(rows) < element.count:
        raise damaged(path, element.name, f"{len(rows):,} of {element.count:,} rows")
    return rows


def _read_text(path: str | Path, file: BinaryIO, dtype: np.dtype[np.void], element: PlyElement) -> Rows:
    lines = [line for line in islice(file, element.count) if line.strip()]
    if len(lines) < element.count:
        raise damaged(path, element.name, f"{len(lines):,} of {element.count:,} rows")
    try:
        return np.loadtxt(lines, dtype, comments=None, encoding="latin-1", ndmin=1)
    except ValueError as error:
        raise damaged(path, element.name, error) from error


def _unreadable(path: str | Path, error: OSError) -> FormatError:
    return FormatError(f"cannot be read ({error.strerror}).", file=path, hint="give a PLY file")
