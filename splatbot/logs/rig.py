"""Several recordings of one scene, each by a camera of its own, as one log: a YAML file lists them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from splatbot.camera import Camera
from splatbot.errors import LogError
from splatbot.frame import Frame
from splatbot.layouts import is_camera, log_kind
from splatbot.logs.base import Log, StampedLog
from splatbot.logs.calibration import Calibration
from splatbot.logs.listed import Opener, check_time_offset, local_address, stamps_of, truth_of
from splatbot.trajectory import Trajectory

MAX_CAMERAS = 8
"""Largest number of cameras of a rig."""

_NAME = re.compile(r"[A-Za-z0-9_-]{1,32}")
_FIRST_KEYS = {"log", "camera", "time_offset"}
_HINT = "write `cameras: {wrist: {log: FOLDER}, table: {log: FOLDER, T_world_camera: {...}}}`"


@dataclass(frozen=True)
class RigCamera:
    """One camera of a rig.

    Args:
        name: its name in the file.
        log: its recording.
        time_offset: time [s] that is added to the stamps of its frames.
    """

    name: str
    log: Log
    time_offset: float

    @property
    def stamps(self) -> list[float]:
        """Stamps of the frames [s]; a recording that does not know them is decoded."""
        return [stamp + self.time_offset for stamp in stamps_of(self.log)]


class RigLog(StampedLog):
    """The frames of several cameras in the order of their stamps; the first camera of the file defines the world.

    Frames of the first camera have no ``camera_name``; the others have the name of their camera. Name, intrinsics,
    calibration and reference poses of the log are those of the first camera.

    Attributes:
        parts: the cameras with their recordings, the first one first.

    Args:
        path: YAML file with the mapping ``cameras`` from names to ``log``, ``camera``, ``time_offset`` and the keys of
            the section ``cameras`` of the configuration. Paths are relative to the file.
        opener: opens one recording.

    Raises:
        LogError: the file is damaged, or names a recording that does not exist or is damaged.
        CameraError: there are no usable intrinsics.
    """

    def __init__(self, path: str | Path, opener: Opener) -> None:
        self.uri, self.name = str(path), Path(path).stem
        self._file = Path(path)
        entries = rig_entries(self._file)
        self.parts = [self._part(name, values, opener) for name, values in entries.items()]
        self._cameras = {
            part.name: further_settings(entries[part.name], part.log.calibration.sensor) for part in self.parts[1:]
        }
        ordered = sorted((t, k, i) for k, part in enumerate(self.parts) for i, t in enumerate(part.stamps))
        self.stamps = [stamp for stamp, _, _ in ordered]
        self._check_overlap()
        self._places = [(part, index) for _, part, index in ordered]

    @property
    def camera(self) -> Camera:
        """Camera of the frames of the first camera: undistorted."""
        return self.parts[0].log.camera

    @property
    def ground_truth(self) -> Trajectory | None:
        """Reference poses of the first camera, see :class:`splatbot.logs.Log`."""
        return truth_of(self.parts[0].log, self.parts[0].time_offset)

    @property
    def effects(self) -> list[dict[str, Any]]:
        """Records of the simulated effects of the first camera."""
        return self.parts[0].log.effects

    @property
    def cameras(self) -> Mapping[str, Mapping[str, Any]]:
        """Further cameras by their name, in the order of the file; see :class:`splatbot.logs.Log`."""
        return self._cameras

    @property
    def calibration(self) -> Calibration:
        """Calibration of the first camera."""
        return self.parts[0].log.calibration

    def _decode(self, index: int) -> Frame:
        number, at = self._places[index]
        part = self.parts[number]
        frame = part.log.read(at)
        name = part.name if number else ""
        return replace(frame.shifted(part.time_offset), index=index, camera_name=name)

    def _part(self, name: str, values: Mapping[str, Any], opener: Opener) -> RigCamera:
        camera, address = values.get("camera"), local_address(self._file, values["log"])
        if is_camera(address):
            hint = "name recordings only, or cameras only"
            raise self._wrong(f"cameras.{name}.log", "is a camera, but others are recordings.", hint)
        if log_kind(address) == "rig":
            raise self._wrong(f"cameras.{name}.log", "is a rig itself.", "name the recordings of its cameras")
        opened = opener(address, local_address(self._file, camera) if camera else None)
        return RigCamera(name, opened, float(values.get("time_offset", 0.0)))

    def _check_overlap(self) -> None:
        """Refuse a camera that has no frame during the recording of the first one."""
        begin, end = self.parts[0].stamps[0], self.parts[0].stamps[-1]
        for part in self.parts[1:]:
            first, last = part.stamps[0], part.stamps[-1]
            if last < begin or first > end:
                spans = f"from {first:.3f} to {last:.3f} s, the first camera from {begin:.3f} to {end:.3f} s."
                hint = "give time_offset [s], which is added to its stamps"
                raise self._wrong(f"cameras.{part.name}", f"has frames {spans}", hint)

    def _wrong(self, field: str, message: str, hint: str) -> LogError:
        return LogError(message, file=self._file, field=field, hint=hint)


class _UniqueKeys(yaml.SafeLoader):
    """Refuses a mapping with a repeated key, of which YAML keeps the last one only."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return the mapping of a node.

        Raises:
            yaml.YAMLError: a key is repeated.
        """
        known: set[str] = set()
        for key in (str(key.value) for key, _ in node.value):
            if key in known:
                raise yaml.constructor.ConstructorError(None, None, f"the key {key!r:.40} is repeated", node.start_mark)
            known.add(key)
        return super().construct_mapping(node, deep)


def rig_entries(file: Path) -> dict[str, dict[str, Any]]:
    """Return the values of each camera of a file, the first one first.

    Raises:
        LogError: the file is damaged, or a camera has no ``log`` or a wrong ``time_offset``.
    """
    try:
        found = yaml.load(file.read_text(encoding="utf-8"), Loader=_UniqueKeys)
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:  # ValueError: no UTF-8, or no date
        raise LogError(f"is no YAML file: {error}.", file=file, hint=_HINT) from error
    cameras = found.get("cameras") if isinstance(found, dict) else None
    if not isinstance(cameras, dict) or not 1 <= len(cameras) <= MAX_CAMERAS:
        raise LogError(f"lists no cameras, or more than {MAX_CAMERAS}.", file=file, field="cameras", hint=_HINT)
    for number, (name, values) in enumerate(cameras.items()):
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            hint = "use letters, digits, - and _"
            raise LogError(f"has the name {name!r:.40}.", file=file, field="cameras", hint=hint)
        if not isinstance(values, dict):
            raise LogError("is no mapping.", file=file, field=f"cameras.{name}", hint=_HINT)
        if number == 0 and not values.keys() <= _FIRST_KEYS:
            key = min(values.keys() - _FIRST_KEYS, key=str)
            hint = "the first camera defines the world; its sensor is the section `sensor` of --config or of its log"
            raise LogError("is not for the first camera.", file=file, field=f"cameras.{name}.{key}", hint=hint)
        _check_entry(file, f"cameras.{name}", values)
    return cameras


def _check_entry(file: Path, where: str, values: Mapping[str, Any]) -> None:
    check_time_offset(file, where, values.get("time_offset", 0.0))
    for key in ("log", "camera"):
        if not isinstance(values.get(key, ""), str):
            raise LogError("is no text.", file=file, field=f"{where}.{key}", hint="give a path")
    if not values.get("log"):
        raise LogError("is missing.", file=file, field=f"{where}.log", hint=_HINT)


def lists_cameras(uri: str) -> bool:
    """Return whether a file lists live cameras instead of recordings.

    Raises:
        LogError: the file is damaged.
    """
    if log_kind(uri) != "rig":
        return False
    return is_camera(str(next(iter(rig_entries(Path(uri)).values()))["log"]))


def further_settings(values: Mapping[str, Any], calibrated: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a further camera: those of the file, and its calibrated sensor."""
    own = {key: value for key, value in values.items() if key not in _FIRST_KEYS}
    sensor = own.get("sensor") or {}
    return own | ({"sensor": {**calibrated, **sensor}} if isinstance(sensor, dict) else {})
