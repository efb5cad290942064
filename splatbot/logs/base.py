"""Interface of logs: finite sequences of frames that are decoded on access."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Protocol, cast

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.logs.calibration import Calibration
from splatbot.trajectory import Trajectory

MILLIMETRES = 1000.0  # [units/m] of integer depth images without a unit of their own


class Log(Protocol):
    """A recorded or generated RGB-D stream.

    Reading a damaged frame raises LogError; the other frames stay readable, and the caller decides whether to stop or
    to skip the frame. Iteration yields ``read(0), read(1), ...``.
    """

    @property
    def name(self) -> str:
        """Short name, for titles and folders."""
        ...

    @property
    def uri(self) -> str:
        """Address with which :func:`splatbot.logs.open_log` opens the log."""
        ...

    @property
    def camera(self) -> Camera:
        """Camera of the delivered frames: undistorted."""
        ...

    @property
    def ground_truth(self) -> Trajectory | None:
        """Reference poses T_world_camera at their own stamps, or None without a reference.

        Raises:
            FormatError: the file of reference poses is damaged.
        """
        ...

    @property
    def effects(self) -> list[dict[str, Any]]:
        """Records of the simulated sensor effects that are applied to the frames; empty for a real sensor."""
        ...

    @property
    def calibration(self) -> Calibration:
        """Calibration of the recorded images, with the sensor's values of the configuration if they are known."""
        ...

    @property
    def cameras(self) -> Mapping[str, Mapping[str, Any]]:
        """Values of the section `cameras` of the configuration: further cameras, empty for a single one.

        Their frames have the key as ``camera_name``.
        """
        ...

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Frame]: ...

    def __getitem__(self, index: int) -> Frame: ...

    def read(self, index: int) -> Frame:
        """Decode frame ``index`` (negative ones count from the end).

        Raises:
            LogError: the frame is damaged or incomplete.
            IndexError: there is no such frame.
        """
        ...


class LogBase:
    """Implements the sequence protocol with ``__len__`` and ``_decode``; subclasses may report simulated effects."""

    @property
    def effects(self) -> list[dict[str, Any]]:
        """Empty list; see :class:`Log`."""
        return []

    @property
    def calibration(self) -> Calibration:
        """The camera of the delivered frames, and millimetres; see :class:`Log`."""
        return Calibration(cast(Log, self).camera, MILLIMETRES)

    @property
    def cameras(self) -> Mapping[str, Mapping[str, Any]]:
        """No further cameras; see :class:`Log`."""
        return {}

    def __len__(self) -> int:
        raise NotImplementedError

    def _decode(self, index: int) -> Frame:
        raise NotImplementedError

    def __iter__(self) -> Iterator[Frame]:
        return (self._decode(i) for i in range(len(self)))

    def __getitem__(self, index: int) -> Frame:
        return self.read(index)

    def read(self, index: int) -> Frame:
        """Decode frame ``index``; see :class:`Log`."""
        return self._decode(range(len(self))[index])


class StampedLog(LogBase):
    """A log that knows the stamps of its frames before it decodes them."""

    stamps: list[float]
    """Times of the frames [s]."""

    def __len__(self) -> int:
        return len(self.stamps)


class DerivedLog(LogBase):
    """A log whose frames are those of another one, changed by the ``_decode`` of a subclass.

    Args:
        log: the other log.
    """

    def __init__(self, log: Log) -> None:
        self._log = log
        self.name, self.uri = log.name, log.uri

    @property
    def camera(self) -> Camera:
        """As of the other log."""
        return self._log.camera

    @property
    def ground_truth(self) -> Trajectory | None:
        """As of the other log."""
        return self._log.ground_truth

    @property
    def effects(self) -> list[dict[str, Any]]:
        """As of the other log."""
        return self._log.effects

    @property
    def calibration(self) -> Calibration:
        """As of the other log."""
        return self._log.calibration

    @property
    def cameras(self) -> Mapping[str, Mapping[str, Any]]:
        """As of the other log."""
        return self._log.cameras

    def __len__(self) -> int:
        return len(self._log)


class LogPart(DerivedLog):
    """Consecutive frames of a log.

    Args:
        log: the whole log.
        first: index of the first frame.
        count: largest number of frames; None for all.

    Raises:
        InputError: the log has no such frame.
    """

    def __init__(self, log: Log, first: int, count: int | None) -> None:
        super().__init__(log)
        self._frames = frames_from(log, first, count)

    def __len__(self) -> int:
        return len(self._frames)

    def _decode(self, index: int) -> Frame:
        return self._log.read(self._frames[index])


def frames_from(log: Log, first: int, count: int | None) -> range:
    """Return the indices of at most ``count`` frames of a log from the frame ``first`` on.

    Raises:
        InputError: the log has no such frame.
    """
    if first and not 0 <= first < len(log):
        hint = f"the frames of the log have the numbers 0 to {len(log) - 1}"
        raise InputError(f"is {first}.", file=log.uri, field="--first-frame", hint=hint)
    return range(len(log))[first : None if count is None else first + count]
