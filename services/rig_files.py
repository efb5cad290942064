"""Files of several cameras that clients name: small, plain, and with recordings under the log roots alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import yaml

from splatbot.errors import LogError
from splatbot.layouts import is_camera, log_kind
from splatbot.logs.listed import local_address
from splatbot.logs.presets import PRESETS
from splatbot.logs.rig import rig_entries
from splatbot.services.problems import TooLargeError

SUFFIXES = (".yaml", ".yml")
_MAX_BYTES = 1 << 16
_MAX_DEPTH = 8  # of mappings and lists in each other
_ELSEWHERE = "name recordings and camera files under the service's log roots (SPLATBOT_LOG_ROOTS)"


def check_rig(
    file: Path,
    roots: Sequence[Path],
    *,
    is_recording: Callable[[Path], bool],
    check_camera: Callable[[Path], None],
) -> None:
    """Check the file of a rig before its recordings are opened.

    Args:
        file: the file, which is under a root.
        roots: folders that may be read, links resolved.
        is_recording: returns whether a place under a root is a recording; raises LogError if it leads out.
        check_camera: checks a file of intrinsics.

    Raises:
        TooLargeError: it has more than 64 KiB.
        LogError: it is damaged, or names a camera, another rig, or a file elsewhere, whether or not it exists.
        CameraError: a file of intrinsics is damaged.
    """
    _check_text(file)
    if log_kind(file) != "rig":  # the readers of other kinds take places that are not checked here
        raise LogError("is no rig.", file=file, field="log", hint="write `cameras: {NAME: {log: FOLDER}}`")
    for name, values in _entries(file).items():
        where = f"cameras.{name}"
        if is_camera(values["log"]):
            hint = "name recordings; `splatbot map RIG` maps live cameras"
            raise LogError("is a camera, not a recording.", file=file, field=f"{where}.log", hint=hint)
        if not _is_allowed(file, values["log"], roots, is_recording):
            raise LogError("is no recording that may be mapped.", file=file, field=f"{where}.log", hint=_ELSEWHERE)
        camera = values.get("camera")
        if camera and (camera not in PRESETS or (file.parent / camera).exists()):
            if "?" in camera or not _is_allowed(file, camera, roots, Path.is_file):
                hint = f"{_ELSEWHERE}, or a preset: {', '.join(PRESETS)}"
                raise LogError("is no camera file that may be read.", file=file, field=f"{where}.camera", hint=hint)
            check_camera(Path(local_address(file, camera)))


def _entries(file: Path) -> dict[str, Any]:
    try:
        return dict(rig_entries(file))
    except LogError:
        raise
    except ValueError as error:  # Python prints no integer of more than 4,300 digits
        raise LogError("has a number of too many digits.", file=file, field="log", hint="correct the file") from error


def _check_text(file: Path) -> None:
    """Refuse a file that is large, or that takes more work than its length before its values are checked."""
    with file.open("rb") as opened:
        data = opened.read(_MAX_BYTES + 1)
    if len(data) > _MAX_BYTES:
        hint = "list at most eight cameras, and leave out comments"
        raise TooLargeError(f"{file.name} has more than {_MAX_BYTES} bytes.", field="log", hint=hint)
    depth = 0
    try:
        for event in yaml.parse(data.decode(), Loader=yaml.SafeLoader):
            if isinstance(event, yaml.AliasEvent):
                hint = "write the values of each camera in full"
                raise LogError(f"has an alias{_line_of(event.start_mark)}.", file=file, field="log", hint=hint)
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > _MAX_DEPTH:
                hint = "write `cameras: {NAME: {log: FOLDER}}`"
                raise LogError(f"has more than {_MAX_DEPTH} levels.", file=file, field="log", hint=hint)
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        line = _line_of(getattr(error, "problem_mark", None))
        raise LogError(f"is no YAML{line}.", file=file, field="log", hint="correct the file") from error


def _line_of(mark: Any) -> str:
    """Return the words that name the line of a mark of YAML; the text there is not for clients."""
    return "" if mark is None else f" in line {mark.line + 1}"


def _is_allowed(file: Path, address: str, roots: Sequence[Path], fits: Callable[[Path], bool]) -> bool:
    """Return whether the places that an address may mean, with and without options, are under a root and fit."""
    if "\x00" in address:
        return False
    try:
        found = local_address(file, address)
        places = [place.resolve() for place in (Path(found), Path(found.partition("?")[0])) if place.exists()]
        inside = all(any(place.is_relative_to(root) for root in roots) for place in places)
        return bool(places) and inside and all(fits(place) for place in places)
    except OSError:  # a name is too long, or links are a loop
        return False
