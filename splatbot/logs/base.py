"""What every log is: a finite sequence of frames that are decoded when asked for."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Protocol

from splatbot.camera import Camera
from splatbot.frame import Frame
from splatbot.trajectory import Trajectory


class Log(Protocol):
    """A recorded or generated RGB-D stream.

    A log never hides a bad frame: reading it raises LogError, the other frames stay readable, and what to do about it
    (stop, skip) is the caller's choice. Iterating is ``read(0), read(1), ...``.
    """

    @property
    def name(self) -> str:
        """Short name, for titles and folders."""
        ...

    @property
    def uri(self) -> str:
        """What :func:`splatbot.logs.open_log` opens it by."""
        ...

    @property
    def camera(self) -> Camera:
        """Camera of the delivered frames: undistorted."""
        ...

    @property
    def ground_truth(self) -> Trajectory | None:
        """Reference poses as recorded, at their own stamps; None where there are none.

        Raises:
            FormatError: the file that holds them is damaged.
        """
        ...

    @property
    def effects(self) -> list[dict[str, Any]]:
        """The account of the simulated sensor effects that the frames go through; empty for a real sensor."""
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
    """The sequence protocol on top of ``__len__`` and ``_decode``; frames are a real sensor's unless told otherwise."""

    @property
    def effects(self) -> list[dict[str, Any]]:
        """None; see :class:`Log`."""
        return []

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
