"""Options of commands that place a robot in a map: poses, base and margin."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from splatbot.results.folder import RunFolder

Pose = tuple[float, float, float, float, float, float, float]


def checked_pose(pose: Pose, flag: str) -> NDArray[np.float64]:
    """Return the pose (4, 4) of a position and a quaternion wxyz.

    Raises:
        InputError: the quaternion is no rotation.
    """
    import numpy as np

    from splatbot.errors import InputError
    from splatbot.geometry import pose_from_quat

    try:
        return np.asarray(pose_from_quat(pose[:3], pose[3:]))
    except ValueError as error:
        raise InputError(f"{error}.", field=flag, hint="QW QX QY QZ of no rotation are 1 0 0 0") from error


def base_pose(pose: Pose | None, map_: Path) -> NDArray[np.float64]:
    """Return T_world_base (4, 4): the given one, or that of the scene.yaml next to the map.

    Raises:
        InputError: it is not known.
    """
    from splatbot.errors import InputError
    from splatbot.workspace import find_workspace

    if pose is not None:
        return checked_pose(pose, "--base")
    known = find_workspace(map_)
    if known is None or known.T_world_base is None:
        hint = "give --base, or write a scene.yaml: splatbot info MAP --fit-plane estimates one"
        raise InputError("is not known.", file=map_, field="base", hint=hint)
    return known.T_world_base


def base_words(pose: Pose | None) -> str:
    """Return the option that gives the same base to the next command, with a space before it; empty for the default."""
    return "" if pose is None else f" --base {' '.join(str(value) for value in pose)}"


def pose_values(T: NDArray[np.float64]) -> dict[str, list[float]]:
    """Return a pose (4, 4) as JSON values: translation [m] and quaternion_wxyz."""
    from splatbot.geometry import rotation_to_quat

    return {"translation": T[:3, 3].tolist(), "quaternion_wxyz": rotation_to_quat(T[:3, :3]).tolist()}


def run_folder(map_: Path, flag: str) -> RunFolder:
    """Return the run folder that a flag requires.

    Raises:
        InputError: the map is a file.
    """
    from splatbot.errors import InputError
    from splatbot.results.folder import RunFolder

    if not map_.is_dir():
        raise InputError("needs a run folder.", field=flag, hint="give the folder that `splatbot map` wrote")
    return RunFolder(map_)


def margin_value(text: str) -> float:
    """Parse a margin [m].

    Raises:
        InputError: it is no number, or below 0.
    """
    import math

    from splatbot.errors import InputError

    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < math.inf:
        raise InputError(f"is {text!r}.", field="--margin", hint='give metres, 0 or more, or "auto"')
    return value
