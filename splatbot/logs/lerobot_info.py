"""Description of LeRobot datasets of version 3: `meta/info.json` and `meta/episodes` (LeRobot 0.6, DatasetInfo)."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import LogError
from splatbot.logs.lerobot_tables import read_columns
from splatbot.logs.lerobot_video import DepthCodes

INFO = "meta/info.json"
EPISODES = "meta/episodes"
UNITS = {"m": 1.0, "mm": 1000.0}  # per metre, by `depth_unit`
_MAX_INFO = 2**24  # bytes
_MAX_EPISODES = 2**20
_MAX_FRAMES = 2**20  # of an episode
_MAX_DEPTH = 1e4  # [m] of codes
_INDICES = ("chunk_index", "file_index")  # of a file
_HOLE = re.compile(r"\{(\w+)(?::0([1-9])d)?\}", re.ASCII)  # of a template of paths; str.format would obey any format
_DEPTH_KEYS = (("info", "is_depth_map"), ("info", "video.is_depth_map"), ("video_info", "video.is_depth_map"))
_AGAIN = "copy or download the dataset again"


@dataclass(frozen=True)
class DatasetInfo:
    """The description of a dataset.

    Args:
        folder: of the dataset.
        values: object of `meta/info.json`.
        features: its columns and cameras, by key.
        fps: frames per second.
    """

    folder: Path
    values: dict[str, Any]
    features: dict[str, dict[str, Any]]
    fps: float

    def cameras(self, *, depth: bool) -> list[str]:
        """Return the keys of the depth or of the colour images."""
        images = {key: f for key, f in self.features.items() if f.get("dtype") in ("image", "video")}
        return sorted(key for key, feature in images.items() if _is_depth(feature) == depth)

    def choose_cameras(self, color: str | None, depth: str | None) -> tuple[str, str]:
        """Return the keys of colour and depth; without a choice `NAME` belongs to `NAME_depth`.

        Raises:
            LogError: there is no depth, no such camera, or there are several.
        """
        colors, depths = self.cameras(depth=False), self.cameras(depth=True)
        if not depths:
            hint = "record with a depth camera (use_depth), which marks its feature by is_depth_map"
            raise self.bad("features", "has no depth", hint)
        pairs = [(c, d) for c in colors for d in depths if color in (None, c) and depth in (None, d)]
        found = pairs if len(pairs) == 1 else [(c, d) for c, d in pairs if d == f"{c}_depth"]
        if len(found) == 1:
            return found[0]
        problem = f"has colour {', '.join(colors) or 'of no camera'} and depth {', '.join(depths)}"
        raise self.bad("features", problem, f"choose a camera: {self.folder.name}?color=KEY&depth=KEY")

    def path(self, field: str, **values: str | int) -> Path:
        """Return a path of the dataset from the template of a field.

        Raises:
            LogError: it is no template, or leaves the folder.
        """
        template = self.values.get(field)

        def fill(match: re.Match[str]) -> str:
            value = values.get(match[1], match[0])
            return f"{value:0{match[2]}d}" if match[2] and isinstance(value, int) else str(value)

        name = _HOLE.sub(fill, template) if isinstance(template, str) else ""
        parts = PurePosixPath(name)
        if not name or "{" in name or "\0" in name or parts.is_absolute() or ".." in parts.parts:
            raise self.bad(field, f"is {template!r:.120}", "write the template of paths in the folder of the dataset")
        return self.folder / parts

    def depth_units(self, key: str) -> float | None:
        """Return the units per metre of depth images, or None if the dataset does not state them.

        Raises:
            LogError: the unit is unknown.
        """
        unit = _details(self.features[key]).get("depth_unit")
        if unit is None:
            return None
        if not isinstance(unit, str) or unit not in UNITS:
            raise self.bad(f"features.{key}.info.depth_unit", f"is {unit!r:.40}", 'write "m" or "mm"')
        return UNITS[unit]

    def depth_codes(self, key: str) -> DepthCodes:
        """Return the quantization of the depth video of a camera.

        Raises:
            LogError: its numbers are no quantization.
        """
        given = {k.removeprefix("video."): v for k, v in _details(self.features[key]).items() if v is not None}
        try:
            numbers = {name: float(given[name]) for name in ("depth_min", "depth_max", "shift") if name in given}
            codes = DepthCodes(**numbers, use_log=given.get("use_log", True) is True)
        except (TypeError, ValueError, OverflowError):
            codes = DepthCodes(depth_max=np.nan)
        if 0 <= codes.depth_min < codes.depth_max <= _MAX_DEPTH and 0 < codes.depth_min + codes.shift <= _MAX_DEPTH:
            return codes
        raise self.bad(f"features.{key}.info", "has no valid depth_min, depth_max and shift", _AGAIN)

    def bad(self, field: str, problem: str, hint: str) -> LogError:
        """Return an error about a field of the description."""
        return LogError(f"{problem}.", file=self.folder / INFO, field=field, hint=hint)


@dataclass(frozen=True)
class Episode:
    """Place of an episode.

    Args:
        length: number of frames.
        first: index of its first frame in the dataset.
        data: parquet file of its rows.
        videos: file of each video, and the time [s] in it at which the episode begins.
    """

    length: int
    first: int
    data: Path
    videos: dict[str, tuple[Path, float]]


def read_info(folder: Path) -> DatasetInfo:
    """Read `meta/info.json`.

    Raises:
        LogError: it is missing, damaged, or of another version.
    """
    blank = DatasetInfo(folder, {}, {}, 0.0)
    try:
        with (folder / INFO).open("rb") as file:
            values = json.loads(file.read(_MAX_INFO))
    except OSError as error:
        raise blank.bad("file", f"cannot be read ({error.strerror})", _AGAIN) from error
    except (ValueError, RecursionError) as error:
        raise blank.bad("file", f"is not JSON ({error})", _AGAIN) from error
    version = values.get("codebase_version") if isinstance(values, dict) else None
    if not str(version).startswith("v3."):
        hint = "convert it by `python -m lerobot.scripts.convert_dataset_v21_to_v30` of the package lerobot"
        raise blank.bad("codebase_version", f"is {version!r:.40}, supported is v3", hint)
    features = values.get("features")
    if not isinstance(features, dict) or not all(isinstance(feature, dict) for feature in features.values()):
        raise blank.bad("features", "is no object of objects", _AGAIN)
    fps = values.get("fps")
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not 1e-3 < fps < 1e6:
        raise blank.bad("fps", f"is {fps!r:.40}", "write the frames per second")
    return DatasetInfo(folder, values, features, float(fps))


def read_episode(info: DatasetInfo, number: int, videos: Iterable[str]) -> Episode:
    """Read the place of an episode, and of its parts of ``videos``.

    Raises:
        LogError: there is no such episode, a table is damaged, or the episode shares frames with another one.
    """
    keys, place = list(videos), info.folder / EPISODES
    table = _episode_table(place, keys)
    own = _own_row(place, table["episode_index"], number)
    row = {name: column[own].item() for name, column in table.items()}
    if not 0 < row["length"] == row["dataset_to_index"] - row["dataset_from_index"] <= _MAX_FRAMES:
        problem = f"is {row['length']} for frames {row['dataset_from_index']} to {row['dataset_to_index']}."
        raise LogError(problem, file=place, field=f"length of episode {number}", hint=_AGAIN)
    _check_alone(place, "dataset_from_index", table["dataset_from_index"], table["dataset_to_index"], own, 0.0)
    found: dict[str, tuple[Path, float]] = {}
    for key in keys:
        part = f"videos/{key}"
        same = [table[f"{part}/{name}"] == row[f"{part}/{name}"] for name in _INDICES]
        shared = np.flatnonzero(same[0] & same[1])  # episodes in the same file
        spans = [table[f"{part}/{name}"][shared] for name in ("from_timestamp", "to_timestamp")]
        at = int(np.searchsorted(shared, own))
        _check_alone(place, f"{part}/from_timestamp", spans[0], spans[1], at, 0.5 / info.fps)
        path = info.path("video_path", video_key=key, **{name: row[f"{part}/{name}"] for name in _INDICES})
        found[key] = path, row[f"{part}/from_timestamp"]
    data = info.path("data_path", **{name: row[f"data/{name}"] for name in _INDICES})
    return Episode(row["length"], row["dataset_from_index"], data, found)


def _episode_table(place: Path, keys: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return the columns of all episodes that place the data, and the videos of ``keys``."""
    videos = [f"videos/{key}" for key in keys]
    integers = ["episode_index", "length", "dataset_from_index", "dataset_to_index"]
    integers += [f"{part}/{name}" for part in ("data", *videos) for name in _INDICES]
    numbers = [f"{part}/{name}" for part in videos for name in ("from_timestamp", "to_timestamp")]
    tables: list[dict[str, NDArray[Any]]] = []
    for file in sorted(place.glob("*/*.parquet")):
        tables.append(read_columns(file, integers=integers, numbers=numbers))
        if sum(len(table["length"]) for table in tables) > _MAX_EPISODES:
            raise LogError(f"holds over {_MAX_EPISODES} episodes.", file=place, field="files", hint=_AGAIN)
    if not tables:
        raise LogError("holds no episodes.", file=place, field="files", hint=_AGAIN)
    return {name: np.concatenate([table[name] for table in tables]) for name in (*integers, *numbers)}


def _own_row(place: Path, episodes: NDArray[np.int64], number: int) -> int:
    rows = np.flatnonzero(episodes == number)
    if len(rows) == 1:
        return int(rows[0])
    held = np.unique(episodes).tolist()
    problem = f"has {len(rows)} rows of episode {number}."
    hint = f"its {len(held)} episodes are {', '.join(map(str, held[:8]))}{', ...' if len(held) > 8 else ''}"
    raise LogError(problem, file=place, field="episode_index", hint=hint)


def _check_alone(file: Path, field: str, starts: NDArray[Any], ends: NDArray[Any], own: int, tolerance: float) -> None:
    """Check that the range of row ``own`` is a range that no other row shares by more than the tolerance."""
    start, end = float(starts[own]), float(ends[own])
    if not (0 <= start < end < np.inf):
        raise LogError(f"is {start:g} to {end:g}.", file=file, field=field, hint=_AGAIN)
    shared = np.minimum(ends, end) - np.maximum(starts, start) > tolerance
    if shared.sum() > 1:
        problem = f"{start:g} to {end:g} is shared by {shared.sum()} episodes."
        raise LogError(problem, file=file, field=field, hint=_AGAIN)


def _details(feature: dict[str, Any]) -> dict[str, Any]:
    found = feature.get("info")
    return found if isinstance(found, dict) else {}


def _is_depth(feature: dict[str, Any]) -> bool:
    return any(isinstance(feature.get(a), dict) and feature[a].get(b) is True for a, b in _DEPTH_KEYS)
