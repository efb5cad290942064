"""Packages that `pip install splatbot` brings have licences with few conditions."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ALLOWED = {
    *("MIT", "MIT License", "MIT-CMU", "ISC", "ISC License (ISCL)", "Zlib", "CC0-1.0", "BSL-1.0", "0BSD"),
    *("BSD License", "BSD-2-Clause", "BSD-3-Clause"),
    *("Apache-2.0", "Apache 2.0", "Apache Software License", "Apache-2.0 WITH LLVM-exception"),
    *("PSF-2.0", "Python Software Foundation License"),
    *("MPL-2.0", "Mozilla Public License 2.0 (MPL 2.0)"),
}
"""Names that packages state: permissive licences, and the MPL, which binds changes of its own files alone."""

READ = {
    "apsw": "any-OSI",  # its licence of choice is one that the Open Source Initiative approved
    "xacro": "Copyright Robert Haschke",  # its field is the text of the BSD licence
}
"""Packages whose field names no licence, with the beginning of the field."""


def required() -> set[str]:
    """Return the names of splatbot's dependencies and their dependencies, without extras that none of them needs.

    The CUDA build of torch brings libraries under licences of NVIDIA; the image has the CPU build.
    """
    waiting, seen = [("splatbot", "")], set[tuple[str, str]]()
    while waiting:
        name, extra = waiting.pop()
        if (name, extra) in seen or re.match("nvidia-|cuda-", name):
            continue
        seen.add((name, extra))
        for need in map(Requirement, metadata.requires(name) or []):
            if need.marker is None or need.marker.evaluate({"extra": extra}):
                waiting += [(canonicalize_name(need.name), one) for one in ("", *need.extras)]
    return {name for name, _ in seen} - {"splatbot"}


def is_allowed(field: str) -> bool:
    """Return whether one of the alternatives of a licence field consists of allowed licences."""
    return any(set(alternative.split(" AND ")) <= ALLOWED for alternative in re.split("; | OR ", field))


def test_every_required_package_has_a_licence_of_the_list() -> None:
    names = required()
    assert {"torch", "fastapi", "numpy"} <= names
    program = Path(sys.executable).with_name("pip-licenses")
    words = [str(program), "--with-system", "--from=mixed", "--format=json", "--packages", *sorted(names)]
    found = json.loads(subprocess.run(words, capture_output=True, text=True, timeout=60, check=True).stdout)
    fields: dict[str, str] = {canonicalize_name(one["Name"]): one["License"] for one in found}
    assert set(fields) == names
    others = {name: field for name, field in fields.items() if not is_allowed(field)}
    for name, beginning in READ.items():
        assert others.pop(name).startswith(beginning)
    assert not others


def test_a_licence_counts_whole_and_one_of_several_is_enough() -> None:
    assert is_allowed("GPL-3.0 OR MIT")
    assert is_allowed("BSD License; GNU General Public License (GPL)")
    assert not is_allowed("MIT AND GPL-3.0")
    assert not is_allowed("UNKNOWN")
