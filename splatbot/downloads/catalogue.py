"""The public recordings that `splatbot download` knows."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from urllib.parse import urlsplit

import yaml

from splatbot.errors import InputError

_FILE = Path(__file__).with_name("catalogue.yaml")


@dataclass(frozen=True)
class PublicRecording:
    """An archive of recordings at its official address.

    Args:
        name: name in the catalogue, as ``collection/sequence``.
        url: address of the archive.
        root: folder of the archive that is kept.
        terms: licence, and the publication to cite.
        log: folder of the recording below ``root``.
        camera: preset for ``--camera``. If None, the recording has its own intrinsics.
        size: size of the archive [bytes]. If None, it is unknown.
        sha256: digest of the archive, in hexadecimal digits. If None, it is unknown.
    """

    name: str
    url: str
    root: str
    terms: str
    log: str = "."
    camera: str | None = None
    size: int | None = None
    sha256: str | None = None

    @property
    def archive(self) -> str:
        """The name of the archive's file."""
        return PurePosixPath(urlsplit(self.url).path).name


@cache
def catalogue() -> MappingProxyType[str, PublicRecording]:
    """Return all public recordings by name."""
    content = yaml.safe_load(_FILE.read_text(encoding="utf-8"))
    terms = content["terms"]
    return MappingProxyType(
        {
            name: PublicRecording(name, **(values | {"terms": terms[values["terms"]]}))
            for name, values in content["datasets"].items()
        }
    )


def find_recording(name: str) -> PublicRecording:
    """Return a public recording by its name.

    Raises:
        InputError: there is no such recording; the message lists near names.
    """
    known = catalogue()
    if name in known:
        return known[name]
    last = {full.partition("/")[2]: full for full in known}
    near = [*difflib.get_close_matches(name, known), *(last[n] for n in difflib.get_close_matches(name, last))]
    hint = f"did you mean {', '.join(dict.fromkeys(near))}?" if near else "splatbot download --list prints all names"
    raise InputError(f"there is no {name[:80]!r} in the catalogue.", field="NAME", hint=hint)
