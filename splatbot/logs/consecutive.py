"""Recordings of one place, one after the other, as one log: a YAML file lists them."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import replace
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import yaml

from splatbot.camera import Camera
from splatbot.errors import LogError
from splatbot.frame import Frame
from splatbot.logs.base import StampedLog
from splatbot.logs.calibration import Calibration
from splatbot.logs.listed import Opener, check_time_offset, local_address, stamps_of, truth_of
from splatbot.trajectory import Trajectory

MAX_RECORDINGS = 64
"""Largest number of recordings in one file."""

_KEYS = {"log", "camera", "time_offset"}
_HINT = "write `recordings: [{log: FOLDER}, {log: FOLDER, time_offset: 60.0}]`"


class ConsecutiveLog(StampedLog):
    """The frames of several recordings, one recording after the other; `splatbot merge` writes the file.

    Name, intrinsics, calibration and reference poses are those of the first recording.

    Args:
        path: YAML file with the list ``recordings``; each has ``log``, and may have ``camera`` (a file) and
            ``time_offset`` [s], which is added to its stamps. Paths are relative to the file.
        opener: opens one recording.
        uri: address that the log names as its own, if the file is moved there later. If None, it is the path.

    Raises:
        LogError: the file is damaged, the stamps do not increase from one recording to the next, or a recording does
            not exist or is damaged.
        CameraError: there are no usable intrinsics.
    """

    def __init__(self, path: str | Path, opener: Opener, *, uri: str | None = None) -> None:
        self.uri, self.name = uri or str(path), Path(path).stem
        self._file = Path(path)
        entries = _entries(self._file)
        cameras = [local_address(self._file, e["camera"]) if "camera" in e else None for e in entries]
        self._logs = [opener(local_address(self._file, e["log"]), c) for e, c in zip(entries, cameras, strict=True)]
        self._offsets = [float(entry.get("time_offset", 0.0)) for entry in entries]
        stamps = [[t + dt for t in stamps_of(log)] for log, dt in zip(self._logs, self._offsets, strict=True)]
        for number, (earlier, later) in enumerate(pairwise(stamps), 1):
            if not earlier or not later or later[0] <= earlier[-1]:
                hint = "give a larger time_offset [s], which is added to the stamps of the recording"
                raise self._wrong(f"recordings[{number}]", "does not begin after the one before.", hint)
        self.stamps = [stamp for part in stamps for stamp in part]
        self._begins = [0, *accumulate(len(part) for part in stamps)]

    @property
    def camera(self) -> Camera:
        """Camera of the first recording: undistorted."""
        return self._logs[0].camera

    @property
    def ground_truth(self) -> Trajectory | None:
        """Reference poses of the first recording, see :class:`splatbot.logs.Log`."""
        return truth_of(self._logs[0], self._offsets[0])

    @property
    def effects(self) -> list[dict[str, Any]]:
        """Records of the simulated effects of all recordings."""
        return [effect for log in self._logs for effect in log.effects]

    @property
    def cameras(self) -> Mapping[str, Mapping[str, Any]]:
        """Further cameras of the first recording, see :class:`splatbot.logs.Log`."""
        return self._logs[0].cameras

    @property
    def calibration(self) -> Calibration:
        """Calibration of the first recording."""
        return self._logs[0].calibration

    def _decode(self, index: int) -> Frame:
        number = bisect_right(self._begins, index) - 1
        frame = self._logs[number].read(index - self._begins[number])
        return replace(frame.shifted(self._offsets[number]), index=index)

    def _wrong(self, field: str, message: str, hint: str) -> LogError:
        return LogError(message, file=self._file, field=field, hint=hint)


def _entries(file: Path) -> list[dict[str, Any]]:
    """Return the values of each recording of a file."""
    try:
        found = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise LogError(f"is no YAML file: {error}.", file=file, hint=_HINT) from error
    entries = found.get("recordings") if isinstance(found, dict) else None
    if not isinstance(entries, list) or not 1 <= len(entries) <= MAX_RECORDINGS:
        raise LogError(
            f"lists no recordings, or more than {MAX_RECORDINGS}.", file=file, field="recordings", hint=_HINT
        )
    for number, entry in enumerate(entries):
        where = f"recordings[{number}]"
        if not isinstance(entry, dict) or not isinstance(entry.get("log"), str) or not entry.keys() <= _KEYS:
            raise LogError(f"needs log, and may have {', '.join(sorted(_KEYS))}.", file=file, field=where, hint=_HINT)
        check_time_offset(file, where, entry.get("time_offset", 0.0))
        if not isinstance(entry.get("camera", ""), str):
            raise LogError("is no text.", file=file, field=f"{where}.camera", hint="give a path")
    return entries
