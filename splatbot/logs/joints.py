"""Joint positions over time: `joints.txt` of the TUM layout, and the joint states of several publishers."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import InputError, LogError

NAME = "joints.txt"
_HEADER = "# stamp"
HOLD = 0.02  # [s] from a line, in which an arm at 1 m/s moves by 2 cm
MAX_GAP = 0.1  # [s] to the neighbouring lines beyond which joint positions are not interpolated


class JointRecord:
    """Joint positions over time with linear interpolation: ``stamps`` (N,) [s] and ``joints`` (N, J) [rad].

    Lines are `stamp q1 q2 ...`. A line `# stamp NAME NAME ...` gives the joints' ``names``; without it they are
    empty, and the positions are in the robot's order.

    Args:
        path: the file.

    Raises:
        LogError: the file cannot be read, a line is malformed or of another length, or the stamps do not increase.
    """

    def __init__(self, path: Path) -> None:
        try:
            lines = path.read_text(encoding="utf-8-sig").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise LogError(f"cannot be read ({error}).", file=path, hint="write lines `stamp q1 q2 ...`") from error
        rows: list[list[float]] = []
        for number, line in enumerate(lines, 1):
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            try:
                row = [float(word) for word in line.split()]
            except ValueError:
                row = []
            if len(row) < 2 or not np.isfinite(row).all() or (rows and len(row) != len(rows[0])):
                problem = f"{line.strip()[:80]!r} is malformed"
                hint = "write `stamp q1 q2 ...` (seconds, radians), as many joints in every line"
                raise LogError(f"{problem}.", file=path, field=f"line {number}", hint=hint)
            if rows and row[0] <= rows[-1][0]:
                problem = f"stamp {row[0]:.6f} is not after {rows[-1][0]:.6f}"
                raise LogError(f"{problem}.", file=path, field=f"line {number}", hint="sort the lines and drop doubles")
            rows.append(row)
        if not rows:
            raise LogError("is empty.", file=path, hint="write lines `stamp q1 q2 ...`, or remove it")
        table = np.array(rows)
        self.stamps, self.joints = table[:, 0], table[:, 1:]
        self.names = _names(path, lines, self.joints.shape[1])

    def at(self, stamp: float) -> NDArray[np.float64] | None:
        """Interpolate the positions (J,) [rad] at a stamp [s] between lines that are at most 0.1 s away.

        Within 0.02 s of a line without such a neighbour, its positions hold. Otherwise they are not known: None.
        """
        return interpolate_joints(self.stamps, self.joints, stamp)

    def ordered(self, wanted: Sequence[str]) -> NDArray[np.float64]:
        """Return all positions (N, J) of the ``wanted`` joints; see :func:`select_joints`.

        Raises:
            InputError: a joint is missing.
        """
        columns = select_joints(self.names, np.arange(self.joints.shape[1], dtype=np.float64), wanted)
        return self.joints[:, columns.astype(int)]


def joint_header(names: Iterable[str]) -> str:
    """Return the first line of a `joints.txt` whose columns have names."""
    return " ".join((_HEADER, *names))


def _names(path: Path, lines: list[str], count: int) -> tuple[str, ...]:
    """Return the names of a line `# stamp NAME ...`, or none without such a line.

    Raises:
        LogError: there is another number of names than of columns.
    """
    header = next((line for line in lines if line.startswith(f"{_HEADER} ")), _HEADER)
    found = tuple(header.removeprefix(_HEADER).split())
    if len(found) not in (0, count):
        hint = "name each joint after `# stamp`, or begin the comment with another word"
        raise LogError(f"names {len(found)} of {count} columns.", file=path, field="# stamp", hint=hint)
    return found


class JointStates:
    """Joint positions of any number of publishers, each with its own joints and rate.

    Args:
        states: stamp [s], names and positions [rad or m] of each message, in any order. Messages without positions,
            with values that are not finite or with another number of names are left out; names may be empty.
    """

    def __init__(self, states: Iterable[tuple[float, Sequence[str], NDArray[np.float64]]]) -> None:
        rows: dict[tuple[tuple[str, ...], int], dict[float, NDArray[np.float64]]] = {}
        for stamp, names, positions in states:
            if len(positions) and len(names) in (0, len(positions)) and np.isfinite(positions).all():
                rows.setdefault((tuple(names), len(positions)), {})[stamp] = positions
        self._publishers = []
        for (names, _), found in rows.items():
            stamps = sorted(found)
            self._publishers.append((names, np.array(stamps), np.stack([found[stamp] for stamp in stamps])))

    def at(self, stamp: float) -> tuple[tuple[str, ...], NDArray[np.float64]] | None:
        """Interpolate all joints that are known at a stamp [s]: names, and positions (J,) [rad or m]; see JointRecord.

        If several publishers have a joint, the message nearest in time counts. Joints without names are only those of
        the first publisher without names, and only if no joint has a name.
        """
        named: dict[str, tuple[float, float]] = {}  # time [s] to the nearest message, and position
        unnamed: NDArray[np.float64] | None = None
        for names, stamps, joints in self._publishers:
            positions = interpolate_joints(stamps, joints, stamp)
            if positions is None:
                continue
            if not names:
                unnamed = positions if unnamed is None else unnamed
            gap = float(np.abs(stamps - stamp).min())
            for name, q in zip(names, positions.tolist(), strict=False):
                if name not in named or gap < named[name][0]:
                    named[name] = gap, q
        if named:
            return tuple(named), np.array([q for _, q in named.values()])
        return None if unnamed is None else ((), unnamed)

    def of(self, names: Sequence[str], stamp: float) -> NDArray[np.float64] | None:
        """Interpolate the joints with given names at a stamp [s]: positions (J,), NaN where one is not known.

        Returns:
            None if no joint is known, or others than those without names are.
        """
        found = self.at(stamp)
        if found is None or bool(found[0]) != bool(names):
            return None
        known = dict(zip(found[0], found[1].tolist(), strict=True)) if names else {}
        return np.array([known.get(name, np.nan) for name in names]) if names else found[1]


def select_joints(names: Sequence[str], positions: NDArray[np.float64], wanted: Sequence[str]) -> NDArray[np.float64]:
    """Return the positions (J,) of the ``wanted`` joints, in their order.

    Positions without names are in the order of the robot already, and those of a gripper may follow. So are positions
    whose names are consecutive numbers (joint1, joint2, ... or q0, q1, ...).

    Raises:
        InputError: a joint is missing.
    """
    if len(names) not in (0, len(positions)):
        hint = "give one position for each name"
        raise InputError(f"has {len(positions)} positions and {len(names)} names.", field="joints", hint=hint)
    generic = not set(names) & set(wanted) and _are_numbers(names)
    if not len(names) or generic:
        if len(positions) < len(wanted):
            raise InputError(
                f"has {len(positions)} joints.", field="joints", hint=f"give {len(wanted)}: {', '.join(wanted)}"
            )
        return np.asarray(positions[: len(wanted)], np.float64)
    known = dict(zip(names, np.asarray(positions, np.float64).tolist(), strict=True))
    missing = [name for name in wanted if name not in known]
    if missing:
        raise InputError(
            f"has no joint {', '.join(missing)}.",
            field="joints",
            hint=f"its joints are {', '.join(names)}; list those of the robot as joint_names in scene.yaml",
        )
    return np.array([known[name] for name in wanted])


def _are_numbers(names: Sequence[str]) -> bool:
    """Return whether names are consecutive numbers from 0 or 1 after one of the usual words."""
    found = [re.fullmatch(r"(q|j|joint)_?(\d{1,3})", name) for name in names]
    numbers = [int(match[2]) for match in found if match is not None]
    return len(numbers) == len(names) > 0 and numbers in (list(range(len(names))), list(range(1, len(names) + 1)))


def interpolate_joints(
    stamps: NDArray[np.float64], joints: NDArray[np.float64], stamp: float, *, hold: float = HOLD
) -> NDArray[np.float64] | None:
    """Interpolate joint positions (N, J) [rad] at stamps (N,) [s] to one stamp; see :meth:`JointRecord.at`.

    Args:
        stamps, joints: the lines.
        stamp: the time [s].
        hold: [s] distance from a line within which its positions hold, where two lines are not near enough.
    """
    after = int(np.searchsorted(stamps, stamp))
    near = slice(max(after - 1, 0), after + 1)
    gaps = np.abs(stamps[near] - stamp)
    if len(gaps) == 2 and gaps.max() <= MAX_GAP:
        return np.array([np.interp(stamp, stamps[near], column) for column in joints[near].T])
    return joints[near][int(gaps.argmin())].copy() if gaps.min() <= hold else None


def find_joints(folder: Path) -> JointRecord | None:
    """Read `joints.txt` of a log's folder; None without the file.

    Raises:
        LogError: `joints.txt` is damaged.
    """
    return JointRecord(folder / NAME) if (folder / NAME).exists() else None
