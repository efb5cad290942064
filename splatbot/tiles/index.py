"""The index of a tiled map: a tree of tiles with their bounds, as one JSON file."""

from __future__ import annotations

import hashlib
import json
import stat
from itertools import accumulate
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from splatbot.errors import FormatError
from splatbot.formats.checks import MAX_GAUSSIANS
from splatbot.layouts import TILES_NAME

DATA_NAME = "tiles.bin"
MAX_TILES = 100_000
MAX_INDEX_BYTES = 64 * 2**20

WRITE_AGAIN = "write the tiled map again: splatbot tile MAP --out FOLDER --overwrite"
GIVE_TILES = "give a folder that `splatbot tile` wrote"
_Length = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
_Point = tuple[
    Annotated[float, Field(allow_inf_nan=False)],
    Annotated[float, Field(allow_inf_nan=False)],
    Annotated[float, Field(allow_inf_nan=False)],
]


class Tile(BaseModel):
    """A node of the tree.

    Args:
        children: numbers of the tiles that it coarsens; none for a leaf, which has Gaussians of the map.
        count: number of Gaussians.
        low, high: box of the means [m]; it encloses those of the children.
        scale: largest standard deviation [m]; that of a child is no larger.
        error: edge of the cells in which Gaussians were merged [m], 0 for a leaf.
        sha256: digest of its bytes.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    children: tuple[Annotated[int, Field(ge=0)], ...] = Field(fail_fast=True)
    count: int = Field(ge=1, le=MAX_GAUSSIANS)
    low: _Point
    high: _Point
    scale: _Length
    error: _Length
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")


class TileIndex(BaseModel):
    """The tree of a tiled map.

    Args:
        format: name and version of the layout.
        source: the map file that was tiled, for display.
        gaussians: number of Gaussians of the map.
        sh_degree: degree of the spherical harmonics.
        tiles: children before their parent, so the root is last; empty for an empty map.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: Literal["splatbot tiles 1"] = "splatbot tiles 1"
    source: str
    gaussians: int = Field(ge=0, le=MAX_GAUSSIANS)
    sh_degree: int = Field(ge=0, le=4)
    tiles: tuple[Tile, ...] = Field(max_length=MAX_TILES, fail_fast=True)

    @property
    def sh_terms(self) -> int:
        """Number of coefficients of harmonics a channel."""
        return (self.sh_degree + 1) ** 2

    @property
    def starts(self) -> list[int]:
        """First Gaussian of each tile in the data, and the number of all."""
        return list(accumulate((tile.count for tile in self.tiles), initial=0))

    def to_json(self) -> str:
        """Return the text of the file; its ``sha256`` is the digest of all other fields."""
        body = self.model_dump(mode="json")
        return json.dumps(body | {"sha256": _digest(body)}, indent=1) + "\n"


def read_index(folder: Path) -> TileIndex:
    """Read the index of a tiled map.

    Raises:
        FormatError: it is missing, damaged, too large, or no tree.
    """
    file = folder / TILES_NAME
    try:
        found = file.stat()
        if not stat.S_ISREG(found.st_mode):
            raise FormatError("is no file.", file=file, hint=WRITE_AGAIN)
        if found.st_size > MAX_INDEX_BYTES:
            raise FormatError(f"has more than {MAX_INDEX_BYTES:,} bytes.", file=file, hint=WRITE_AGAIN)
        body = json.loads(file.read_bytes())
        if not isinstance(body, dict):
            raise ValueError("no object")
        if body.pop("sha256", None) != _digest(body):
            raise FormatError("is damaged: its checksum does not fit.", file=file, field="sha256", hint=WRITE_AGAIN)
        index = TileIndex.model_validate(body)
    except OSError as error:
        raise FormatError(f"cannot be read ({error.strerror}).", file=file, hint=GIVE_TILES) from error
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"])
        raise FormatError(f"is damaged: {first['msg']}.", file=file, field=field, hint=WRITE_AGAIN) from error
    except (ValueError, RecursionError) as error:
        raise FormatError("is damaged: it is no JSON object.", file=file, hint=WRITE_AGAIN) from error
    _check_tree(file, index)
    return index


def _check_tree(file: Path, index: TileIndex) -> None:
    """Check that each tile but the last has one later parent, and that the leaves have all Gaussians.

    Raises:
        FormatError: they do not.
    """
    parents = [-1] * len(index.tiles)
    for number, tile in enumerate(index.tiles):
        if any(low > high for low, high in zip(tile.low, tile.high, strict=True)):
            raise FormatError("is above high.", file=file, field=f"tiles.{number}.low", hint=WRITE_AGAIN)
        if not tile.children and tile.error > 0:
            raise FormatError("is not 0 for a leaf.", file=file, field=f"tiles.{number}.error", hint=WRITE_AGAIN)
        for child in tile.children:
            if child >= number or parents[child] >= 0:
                field = f"tiles.{number}.children"
                raise FormatError(f"has {child}, so the tiles are no tree.", file=file, field=field, hint=WRITE_AGAIN)
            parents[child] = number
    if -1 in parents[:-1]:
        field = f"tiles.{parents.index(-1)}"
        raise FormatError("has no parent, so the tiles are no tree.", file=file, field=field, hint=WRITE_AGAIN)
    if sum(tile.count for tile in index.tiles if not tile.children) != index.gaussians:
        raise FormatError("is not the number in the leaves.", file=file, field="gaussians", hint=WRITE_AGAIN)


def _digest(body: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(body, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
