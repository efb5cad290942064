"""Bodies of requests and answers about versions, merges and comparisons of maps."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, Field, StringConstraints

from splatbot.services.schemas import Request

_TEXT = r"^[^\x00-\x1f\x7f-\x9f]*$"  # no control characters
Label = Annotated[str, StringConstraints(min_length=1, max_length=64, pattern=_TEXT)]
Note = Annotated[str, StringConstraints(max_length=500, pattern=_TEXT)]
VersionNumber = Annotated[int, Field(ge=1, le=2**31 - 1)]


class VersionRequest(Request):
    """A version to be saved."""

    label: Label | None = Field(None, description="its name; versions without one make room for later ones")
    note: Note | None = Field(None, description="a text to it")


class VersionInfo(BaseModel):
    """A saved version of a map."""

    number: int = Field(description="name in URLs; it is not used again")
    map_version: int = Field(description="of the state that it holds")
    created: float = Field(description="Unix time [s]")
    label: str | None = Field(description="its name")
    note: str | None = Field(description="a text to it")
    gaussians: int = Field(description="number of Gaussians")
    keyframes: int = Field(description="number of keyframes, which merge and diff need; 0: none are kept")
    bytes: int = Field(description="size of its files; versions of one state share them")
    checksum: str = Field(description="SHA-256 over the checksums of its files, which each use verifies")
    parent: int | None = Field(description="version before it; null: it is the first")
    restored_from: int | None = Field(description="version that it repeats; null: it was saved")
    in_use: bool = Field(description="the map answers from this state; the version cannot be deleted")
    restorable: bool = Field(description="false: it is of an earlier map of this name, in another world")


class VersionList(BaseModel):
    """The versions of a map."""

    map_version: int = Field(description="of the state that the map answers from")
    versions: list[VersionInfo] = Field(description="all versions by number")


class TwoStates(Request):
    """Two states of maps; the other one is later."""

    other: str = Field(max_length=64, description="name of the later map")
    version: VersionNumber | None = Field(None, description="version of this map; null: as it is now")
    other_version: VersionNumber | None = Field(None, description="version of the later map; null: as it is now")


class MergeRequest(TwoStates):
    """Two maps to be merged; both stay as they are."""

    id: str = Field(description="name of the new map in URLs: a-z, 0-9, - and _")


class DiffRequest(TwoStates):
    """Two states to be compared."""

    aligned: bool | None = Field(
        None, description="whether both have one world; null: if they are of one map. If not, the other is located"
    )
