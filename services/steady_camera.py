"""A camera that is opened again after its device was gone."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator

from splatbot.errors import DeviceError
from splatbot.frame import Frame
from splatbot.protocols import FrameSource

_RETRY_S = 0.5

_log = logging.getLogger(__name__)


class SteadyCamera:
    """The frames of a camera over the losses of its device.

    Args:
        camera: the camera; each iteration opens it.
        wait_s: how long a lost device is opened again [s].
        report: called with the problem while the device is gone, and with None when frames come again.

    Raises:
        DeviceError: when iterating: the device stayed away for longer than ``wait_s``.
    """

    def __init__(self, camera: FrameSource, wait_s: float, report: Callable[[str | None], None]) -> None:
        self.name, self.uri = camera.name, camera.uri
        self._camera, self._wait_s, self._report = camera, wait_s, report
        self._closed = threading.Event()

    @property
    def dropped(self) -> int:
        """Return the number of frames that the camera lost."""
        return self._camera.dropped

    def __iter__(self) -> Iterator[Frame]:
        gone_at: float | None = None
        while not self._closed.is_set():
            try:
                for frame in self._camera:
                    if gone_at is not None:
                        _log.warning("%s is back", self.uri)
                        gone_at = None
                        self._report(None)
                    yield frame
                return
            except DeviceError as error:
                if gone_at is None:
                    gone_at = time.monotonic()
                    _log.warning("%s. It is opened again for %g s", str(error).rstrip("."), self._wait_s)
                    self._report(f"The camera {error.message} It is opened again for {self._wait_s:g} s.")
                if time.monotonic() - gone_at >= self._wait_s:
                    raise
                self._closed.wait(_RETRY_S)

    def close(self) -> None:
        """End the stream."""
        self._closed.set()
        self._camera.close()
