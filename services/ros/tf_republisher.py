"""Transforms between frames for web pages, thinned out, as tf2_web_republisher offers them to roslibjs' TFClient."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from splatbot.errors import InputError
from splatbot.geometry import inverse, pose_from_quat, so3_log
from splatbot.logs.ros_frames import header, pose_message
from splatbot.logs.ros_types import Message, build
from splatbot.protocols import Array
from splatbot.services.bus import Subscription
from splatbot.services.ros.graph import RosGraph, Service
from splatbot.services.ros.requests import entries, entry, number, seconds
from splatbot.services.threads import join_started

REPUBLISH = "/republish_tfs"

_ARRAY = "tf2_web_republisher/msg/TFArray"


@dataclass(frozen=True)
class TfRepublisherConstants:
    """Bounds of the republisher.

    Args:
        frames: frames of the tree, and source frames of one request.
        requests: topics at once.
        rates: [Hz] lowest and highest rate of a topic.
        timeout: [s] longest time that a topic stays without a reader.
    """

    frames: int = 256
    requests: int = 32
    rates: tuple[float, float] = (0.1, 30.0)
    timeout: float = 30.0


CONSTANTS = TfRepublisherConstants()


@dataclass
class _Republication:
    """One topic: ``sent`` has the T_target_source by source frame that its ``readers`` have received last."""

    topic: str
    target: str
    sources: tuple[str, ...]
    angle: float
    distance: float
    period: float
    timeout: float
    used: float
    due: float = 0.0
    sent: dict[str, Array] = field(default_factory=dict)
    readers: frozenset[Subscription] = frozenset()


class TfRepublisher:
    """The service /republish_tfs, and the thread that publishes the topics that it answers.

    Equal requests share one topic. A topic ends when it has had no reader for its timeout.

    Args:
        graph: has /tf and /tf_static.
    """

    def __init__(self, graph: RosGraph) -> None:
        self._graph = graph
        self._lock = threading.Lock()
        self._parents: dict[str, tuple[str, Array]] = {}
        self._topics: dict[tuple[Any, ...], _Republication] = {}
        self._count = 0
        self._transforms = graph.subscribe("/tf", "/tf_static", capacity=256)
        self._ended = threading.Event()
        self._threads = [threading.Thread(target=run, name="tf", daemon=True) for run in (self._listen, self._publish)]
        graph.serve(REPUBLISH, Service("tf2_web_republisher/srv/RepublishTFs", self.republish, quick=True))

    def start(self) -> None:
        """Begin."""
        for thread in self._threads:
            thread.start()

    def stop(self, timeout_s: float = 5.0) -> None:
        """End."""
        self._ended.set()
        self._transforms.close()
        join_started(self._threads, timeout_s)

    def republish(self, args: Mapping[str, Any]) -> dict[str, Any]:
        """Answer RepublishTFs: the name of a topic of TFArrays with the requested transforms.

        Raises:
            InputError: a frame is missing, or there are too many frames or topics.
        """
        sources = tuple(_frame(name, "source_frames") for name in entries(args, "source_frames"))
        if not 0 < len(sources) <= CONSTANTS.frames:
            raise InputError(f"are {len(sources)}.", field="source_frames", hint=f"give 1 to {CONSTANTS.frames}")
        target = _frame(entry(args, "target_frame"), "target_frame")
        limits = number(args, "angular_thres"), number(args, "trans_thres")
        rate = float(np.clip(number(args, "rate", 10.0), *CONSTANTS.rates))
        timeout = min(seconds(args, "timeout") or CONSTANTS.timeout, CONSTANTS.timeout)
        key = target, sources, limits, rate
        with self._lock:
            if key not in self._topics:
                if len(self._topics) >= CONSTANTS.requests:
                    hint = "subscribe to the topics that you have, and share them"
                    raise InputError(f"are {CONSTANTS.requests} already.", field="topics", hint=hint)
                self._count += 1
                topic = self._graph.advertise(f"/tf_repub_{self._count}", _ARRAY)
                now = time.monotonic()
                self._topics[key] = _Republication(topic, target, sources, *limits, 1.0 / rate, timeout, now)
            self._topics[key].used = time.monotonic()
            return {"topic_name": self._topics[key].topic}

    def _listen(self) -> None:
        for news in self._transforms:
            for stamped in getattr(news.value.message, "transforms", ()):
                self._take(stamped)

    def _take(self, stamped: Message) -> None:
        child, parent = stamped.child_frame_id.strip("/"), stamped.header.frame_id.strip("/")
        p, q = stamped.transform.translation, stamped.transform.rotation
        try:
            T = pose_from_quat((p.x, p.y, p.z), (q.w, q.x, q.y, q.z))
        except ValueError:
            return  # no rotation
        with self._lock:
            if child in self._parents or len(self._parents) < CONSTANTS.frames:
                self._parents[child] = parent, T

    def _publish(self) -> None:
        while not self._ended.wait(0.5 / CONSTANTS.rates[1]):
            now = time.monotonic()
            with self._lock:
                due = [(key, one) for key, one in self._topics.items() if one.due <= now]
                parents = dict(self._parents) if due else {}
            for key, one in due:
                one.due = now + one.period
                if self._graph.has_clients(one.topic):
                    one.used = now
                    self._send(one, parents)
                elif self._has_expired(key, one, now):
                    self._graph.remove_topics(one.topic)

    def _has_expired(self, key: tuple[Any, ...], one: _Republication, now: float) -> bool:
        """Return whether a topic has had no reader for its timeout; no later request gets its name then."""
        with self._lock:
            expired = now - one.used > one.timeout
            if expired:
                del self._topics[key]
        return expired

    def _send(self, one: _Republication, parents: Mapping[str, tuple[str, Array]]) -> None:
        readers, moved = self._graph.readers_of(one.topic), []
        if readers - one.readers:  # a new reader gets every transform
            one.sent.clear()
        one.readers = readers
        for source in one.sources:
            T = transform_between(parents, one.target, source)
            if T is not None and _has_moved(one, source, T):
                one.sent[source] = T
                pose = pose_message(T)
                transform = {"translation": {a: getattr(pose.position, a) for a in "xyz"}, "rotation": pose.orientation}
                stamped = {"header": header(time.time(), one.target), "child_frame_id": source, "transform": transform}
                moved.append(stamped)
        if moved:
            self._graph.publish(one.topic, build(_ARRAY, transforms=moved))


def transform_between(parents: Mapping[str, tuple[str, Array]], target: str, source: str) -> Array | None:
    """Return T_target_source (4, 4) [m], or None if no chain of transforms connects the frames.

    Args:
        parents: parent frame and T_parent_child (4, 4) by child frame.
        target, source: names of the frames.
    """
    (root, T_root_target), (other, T_root_source) = _to_root(parents, target), _to_root(parents, source)
    return None if root != other else np.asarray(inverse(T_root_target) @ T_root_source)


def _to_root(parents: Mapping[str, tuple[str, Array]], frame: str) -> tuple[str, Array]:
    """Return the root above a frame and T_root_frame; a loop ends where it closes."""
    T, seen = np.eye(4), {frame}
    while frame in parents and parents[frame][0] not in seen:
        frame, T_parent_child = parents[frame]
        T = T_parent_child @ T
        seen.add(frame)
    return frame, T


def _has_moved(one: _Republication, source: str, T: Array) -> bool:
    before = one.sent.get(source)
    if before is None:
        return True
    step = inverse(before) @ T
    turned, went = np.linalg.norm(so3_log(step[:3, :3])), np.linalg.norm(step[:3, 3])
    return bool(turned > one.angle or went > one.distance)


def _frame(name: Any, where: str) -> str:
    if not isinstance(name, str) or not 0 < len(name.strip("/")) <= 256:
        raise InputError(f"is {str(name)[:40]!r}.", field=where, hint="name a frame of /tf")
    return name.strip("/")
