"""Records any topics of a graph into an MCAP file."""

from __future__ import annotations

import logging
import threading
from pathlib import Path

from splatbot.errors import InputError
from splatbot.logs.mcap import McapFile
from splatbot.services.ros.graph import RosGraph
from splatbot.services.ros.wire import RosMessage

_WAITING = 256  # messages that may wait for the disk

_log = logging.getLogger(__name__)


class McapRecorder:
    """A thread that writes topics to a file as they come; a slow disk loses messages, which ``lost`` counts.

    The file bears its name once :meth:`stop` has returned. A full disk ends the recording: ``error``
    holds the reason, and the part before it is kept if possible.

    Args:
        graph: source of the topics.
        path: the file; must not exist.
        topics: names to record; an empty list records all topics, present and future.

    Raises:
        LogError: the file exists, or its folder cannot be written to.
        InputError: a topic's name is malformed.
    """

    def __init__(self, graph: RosGraph, path: str | Path, *topics: str) -> None:
        self._news = graph.subscribe(*topics, capacity=_WAITING)
        try:
            self._file = McapFile(path)
        except InputError:
            self._news.close()
            raise
        self.messages = 0
        self.error: str | None = None
        self._stopping = threading.Event()
        for topic in topics or tuple(graph.topics):
            if (known := graph.latched(topic)) is not None:
                self._write(topic, known)
        self._thread = threading.Thread(target=self._run, name=f"recorder-{Path(path).name}", daemon=True)
        self._thread.start()

    @property
    def lost(self) -> int:
        """Messages that the disk was too slow for."""
        return sum(self._news.dropped.values())

    def stop(self) -> Path:
        """Write the waiting messages, close the file and return its path."""
        self._stopping.set()
        self._thread.join()
        self._news.close()
        try:
            self._file.close()
        except OSError as error:
            self._fail(error)
        return self._file.path

    def _run(self) -> None:
        while self.error is None:
            news = self._news.get(0.0 if self._stopping.is_set() else 0.1)
            if news is not None:
                self._write(news.topic, news.value)
                continue
            try:
                self._file.flush_due()
            except OSError as error:
                self._fail(error)
            if self._stopping.is_set():
                return

    def _write(self, topic: str, message: RosMessage) -> None:
        try:
            self._file.write(topic, message.message, round(message.stamp * 1e9))
            self.messages += 1
        except OSError as error:
            self._fail(error)
        except Exception:  # one odd message must not end the recording
            _log.exception("%s could not be recorded", topic)

    def _fail(self, error: OSError) -> None:
        self.error = f"cannot be written ({error.strerror})"
        _log.error("%s %s", self._file.path, self.error)
