"""Checkpoints: saving a run while it continues, and loading a saved run."""

from __future__ import annotations

import time
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot import __version__
from splatbot.config import Config, config_from_yaml
from splatbot.errors import ConfigError, DeprecatedNameWarning, FormatError, LogError
from splatbot.frame import Frame
from splatbot.logs import Log
from splatbot.run.state.container import read_container, write_container
from splatbot.run.state.journal import Entry, Journal, read_entry
from splatbot.run.state.schema import FORMAT_VERSION, upgrade_version_1, upgrade_version_2
from splatbot.run.state.tree import Decoder, Encoder
from splatbot.slam import Slam

FOLDER, FILE = "state", "run.state"
_DEPRECATED = "the run was saved by splatbot 0.1; resume it once with --save-every to write the current format"


@dataclass(frozen=True)
class LogPlace:
    """The log of a run, the progress in it, and a fingerprint that detects another log.

    Args:
        name, uri, frames: of the log.
        camera: camera file that the log was opened with.
        next_index: index of the first frame that has not been processed.
        last_index, last_stamp, last_checksum: index, time [s] and CRC-32 of the last processed frame; None before the
            first.
        robot: robot that is masked in the frames.
    """

    name: str
    uri: str
    frames: int
    camera: str | None
    next_index: int
    last_index: int | None = None
    last_stamp: float | None = None
    last_checksum: int | None = None
    robot: str | None = None

    def check(self, log: Log) -> None:
        """Check that a log begins with the processed frames.

        Raises:
            LogError: The log is another one.
        """
        hint = "give the log that the run was begun with, or map this one into a folder of its own"
        if len(log) < self.next_index:
            raise LogError(
                f"has {len(log)} frames, {self.next_index} were mapped.", file=log.uri, field="frames", hint=hint
            )
        if self.last_index is None:
            return
        frame = log[self.last_index]
        if frame.stamp != self.last_stamp:
            was = f"is at {frame.stamp:.9g} s, was at {self.last_stamp:.9g} s when it was mapped."
            raise LogError(was, file=log.uri, field=f"frame {self.last_index}", hint=hint)
        if checksum(frame) != self.last_checksum:
            raise LogError(
                "differs from the frame that was mapped.",
                file=log.uri,
                field=f"frame {self.last_index}",
                hint=hint,
            )


def checksum(frame: Frame) -> int:
    """Compute the CRC-32 of a frame's color and depth."""
    return zlib.crc32(np.ascontiguousarray(frame.depth).data, zlib.crc32(np.ascontiguousarray(frame.rgb).data))


class Checkpoint:
    """Saves a run into ``run/state``; the previous save stays valid until the new one is complete.

    Images, features and sampled pixels of a keyframe are appended once to a journal. The map, the poses and all other
    state go into a new file at each save, which replaces the previous one by renaming.

    Args:
        run: folder of the run.
        every_s: least time between two saves [s].
    """

    def __init__(self, run: Path, every_s: float) -> None:
        self.folder = run / FOLDER
        self.every_s = every_s
        self.saves = 0
        self.seconds = 0.0
        self._journal = Journal(self.folder, _unused_number(self.folder))
        self._saved_at = time.perf_counter()

    @property
    def due(self) -> bool:
        """True once the interval has passed since the last save."""
        return time.perf_counter() - self._saved_at >= self.every_s

    def save(
        self,
        slam: Slam,
        loop: Mapping[str, Any],
        place: LogPlace,
        config: Config,
        on_progress: Callable[[int, int], None] | None = None,
    ) -> None:
        """Save a run between two frames.

        Args:
            slam, loop, place, config: state of the run.
            on_progress: called with the number of arrays of keyframes that are saved, and of all.

        Raises:
            OSError: the disk is full or not available; the previous save remains, and the next one may succeed.
        """
        start = time.perf_counter()
        self._saved_at = start
        with slam.paused():
            self._save(slam, loop, place, config, on_progress or (lambda _done, _total: None))
        self._saved_at = time.perf_counter()
        self.saves += 1
        self.seconds += self._saved_at - start

    def _save(
        self,
        slam: Slam,
        loop: Mapping[str, Any],
        place: LogPlace,
        config: Config,
        on_progress: Callable[[int, int], None],
    ) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        self._journal.begin()
        constant = {id(owner) for owner in _constant_arrays(slam)}

        kept = count(1)

        def keep(owner: object, array: NDArray[Any]) -> Entry | None:
            if id(owner) not in constant:
                return None
            on_progress(next(kept), len(constant))
            return self._journal.put(owner, array)

        encoder = Encoder(config, keep)
        header = {
            "tree": encoder.encode({"slam": slam, "loop": dict(loop)}),
            "format": FORMAT_VERSION,
            "splatbot": __version__,
            "config": config.to_yaml(),
            "log": {f.name: getattr(place, f.name) for f in fields(place)},
            "images": self._journal.path.name,
        }
        self._journal.sync()
        write_container(self.folder / FILE, header, encoder.arrays)
        self._journal.finish()


@dataclass(frozen=True)
class SavedRun:
    """A run in the state of its last save.

    Args:
        folder: of the run.
        config: configuration of the run.
        place: its log and the progress in it.
        slam: its SLAM, ready for the next frame.
        loop: counters of the loop over the frames, by name.
    """

    folder: Path
    config: Config
    place: LogPlace
    slam: Slam
    loop: dict[str, Any]

    @classmethod
    def load(cls, run: str | Path) -> SavedRun:
        """Load the state of a run's folder.

        Raises:
            FormatError: The state is missing, damaged or of another version.
        """
        folder = Path(run)
        path = folder / FOLDER / FILE
        header, arrays = read_container(path)
        try:
            config = _config(header)
            place = LogPlace(**header["log"])
            kept = partial(read_entry, path.parent / header["images"])
            slam, loop = _decode(header, config, arrays, kept)
        except (KeyError, TypeError, ValueError, IndexError, AttributeError, ConfigError) as error:
            why = f"does not fit this version of splatbot ({error})."
            by = header.get("splatbot", "another version")
            hint = f"open it with splatbot {by}, or map the log again"
            raise FormatError(why, file=path, hint=hint) from error
        return cls(folder, config, place, slam, loop)


def _unused_number(folder: Path) -> int:
    """Return a number for a new journal; an earlier state needs the existing ones until the first save is complete."""
    used = [path.stem.partition("-")[2] for path in folder.glob("images-*.bin")]
    return 1 + max((int(number) for number in used if number.isdigit()), default=-1)


def _constant_arrays(slam: Slam) -> Iterator[object]:
    """Yield the arrays of keyframes that never change in place: images, features, sampled pixels."""
    for keyframe in slam.keyframes:
        yield from (keyframe.rgb, keyframe.depth, *vars(keyframe.features).values())
        for level in keyframe.reference.levels:
            yield from vars(level).values()


def _config(header: Mapping[str, Any]) -> Config:
    """Return the configuration of a state; version 1 names its keys differently, which :func:`_decode` reports once."""
    with warnings.catch_warnings():
        if "format" not in header:
            warnings.simplefilter("ignore", DeprecatedNameWarning)
        return config_from_yaml(header["config"])


def _decode(
    header: Mapping[str, Any], config: Config, arrays: list[NDArray[Any]], kept: Callable[[Entry], NDArray[Any]]
) -> tuple[Slam, dict[str, Any]]:
    """Decode the objects of a state; version 1 has no version number in its header."""
    version = header.get("format", 1)
    if version not in range(1, FORMAT_VERSION + 1):
        raise ValueError(f"it has version {version} of the format, this splatbot reads 1 to {FORMAT_VERSION}")
    decoder = Decoder(config, arrays, kept, version)
    values = decoder.decode(header["tree"])
    if version == 1:
        warnings.warn(_DEPRECATED, DeprecatedNameWarning, stacklevel=3)
        upgrade_version_1(values["slam"], decoder.unused)
    if version < 3:
        upgrade_version_2(values["slam"])
    return values["slam"], values["loop"]
