"""Topics to and from nodes of ROS 2 that use rmw_zenoh (extra `ros2`).

Keys, liveliness tokens and attachments as ros2/rmw_zenoh's docs/design.md describes them.
"""

from __future__ import annotations

import json
import logging
import secrets
import threading
from typing import Any

from splatbot.errors import ConfigError, SplatbotError
from splatbot.logs.mcap import COLOR, DEPTH, INFO, JOINTS
from splatbot.logs.ros_types import from_cdr, full_name, typestore
from splatbot.services.ros.graph import RosGraph
from splatbot.services.ros.robot_topics import TYPES_OF_ROBOT
from splatbot.services.ros.subscribers import DEPTH_INFO
from splatbot.services.ros.wire import RosMessage
from splatbot.services.threads import join_started

HEARD = (COLOR, DEPTH, INFO, DEPTH_INFO, JOINTS, *TYPES_OF_ROBOT)  # of the topics that others publish
_CLIENT = -1  # identity in the graph
_NODE, _WAITING = "splatbot", 256
_VOLATILE, _LATCHED = "::,10:,:,:,,", ":1:,1:,:,:,,"  # quality of service: differences from ROS' defaults
_NONE = "%"  # neither enclave nor namespace

_log = logging.getLogger(__name__)


class ZenohBridge:
    """A thread that publishes a graph's topics as a node of ROS 2, and gives the graph the frames and joints of others.

    Args:
        graph: topics.
        router: where the nodes meet, e.g. ``tcp/localhost:7447``; it may come later.
        domain: ROS_DOMAIN_ID.

    Raises:
        ConfigError: the extra `ros2` is not installed, or the router's address is malformed.
    """

    def __init__(self, graph: RosGraph, router: str, *, domain: int = 0) -> None:
        try:
            import zenoh
        except ImportError as error:
            hint = "pip install 'splatbot[ros2]'"
            raise ConfigError("needs the package eclipse-zenoh.", field="zenoh_router", hint=hint) from error
        settings = {
            "mode": "peer",
            "connect": {"endpoints": [router], "timeout_ms": 0, "exit_on_failure": False},
            "listen": {"endpoints": ["tcp/127.0.0.1:0"]},
            "scouting": {"multicast": {"enabled": False}},
            "timestamping": {"enabled": True},  # caches of latched topics need it
        }
        try:
            self._session = zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
        except zenoh.ZError as error:
            hint = "write it like tcp/localhost:7447"
            raise ConfigError(f"is {router!r} ({error}).", field="zenoh_router", hint=hint) from error
        self._graph, self._domain, self._zid = graph, domain, str(self._session.info.zid())
        self._publishers: dict[str, _Publisher] = {}
        self._tokens: list[Any] = []
        self._entities = 0
        self._news = graph.subscribe(capacity=_WAITING)
        self._thread = threading.Thread(target=self._run, name="zenoh", daemon=True)

    def start(self) -> None:
        """Begin; topics that are latched by now go out at once."""
        import zenoh
        from zenoh import ext

        self._token("NN", "")
        latched = ext.HistoryConfig(detect_late_publishers=True)  # /tf_static comes once
        for topic in HEARD:
            key = f"{self._domain}{topic}/*/*"
            ext.declare_advanced_subscriber(
                self._session, key, self._hear, history=latched, allowed_origin=zenoh.Locality.REMOTE
            )
        for topic in self._graph.topics:
            if (known := self._graph.latched(topic)) is not None:
                self._forward(topic, known)
        self._thread.start()

    def stop(self, timeout_s: float = 5.0) -> None:
        """End, and leave the nodes' graph."""
        self._news.close()
        join_started([self._thread], timeout_s)
        self._session.close()

    def _run(self) -> None:
        for news in self._news:
            if news.value.client != _CLIENT:
                self._forward(news.topic, news.value)

    def _forward(self, topic: str, message: RosMessage) -> None:
        try:
            if topic not in self._publishers:
                self._publishers[topic] = self._advertise(topic, message)
            self._publishers[topic].put(message)
        except Exception:  # one odd message must not end the others
            _log.exception("%s could not be sent to Zenoh", topic)

    def _advertise(self, topic: str, message: RosMessage) -> _Publisher:
        from zenoh import ext

        kind = f"{_dds(message.type)}/{typestore().hash_rihs01(message.type)}"
        self._token("MP", f"/{topic.replace('/', '%')}/{kind}/{_LATCHED if message.latched else _VOLATILE}")
        cache = ext.CacheConfig(1) if message.latched else None
        key = f"{self._domain}{topic}/{kind}"
        return _Publisher(ext.declare_advanced_publisher(self._session, key, cache=cache))

    def _token(self, what: str, rest: str) -> None:
        """Return the liveliness token that announces a topic to other nodes (`ros2 topic list`)."""
        number = self._entities
        self._entities += 1
        key = f"@ros2_lv/{self._domain}/{self._zid}/0/{number}/{what}/{_NONE}/{_NONE}/{_NODE}{rest}"
        self._tokens.append(self._session.liveliness().declare_token(key))

    def _hear(self, sample: Any) -> None:
        _, *names, dds, _ = str(sample.key_expr).split("/")
        topic = "/" + "/".join(names)
        try:
            kind = full_name(dds.replace("::", "/").replace("dds_/", "").removesuffix("_"))
            self._graph.publish(topic, from_cdr(bytes(sample.payload), kind), client=_CLIENT)
        except SplatbotError as error:
            _log.warning("%s from Zenoh: %s", topic, error)
        except Exception:  # bytes of anybody's
            _log.warning("%s from Zenoh is no %s", topic, dds, exc_info=True)


class _Publisher:
    """Counts messages: the numbers show readers which ones they have missed."""

    def __init__(self, publisher: Any) -> None:
        self._publisher, self._number, self._gid = publisher, 0, secrets.token_bytes(16)

    def put(self, message: RosMessage) -> None:
        from zenoh import ext

        self._number += 1
        stamp = ext.Int64(round(message.stamp * 1e9))
        self._publisher.put(message.cdr, attachment=ext.z_serialize((ext.Int64(self._number), stamp, self._gid)))


def _dds(kind: str) -> str:
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_"
