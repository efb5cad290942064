"""/rosapi: names and types of topics and services, which clients query first."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, cast

from rosbags.interfaces import Nodetype

from splatbot.logs.ros_types import definition, full_name, typestore
from splatbot.services.ros.graph import RosGraph, Service, resolve

NODE = "/splatbot"

_NO_PARAMETERS = "this service has no parameters; its settings are in configs/service.yaml"


class RosApi:
    """The services of /rosapi on a graph.

    Args:
        graph: registers the services.
    """

    def __init__(self, graph: RosGraph) -> None:
        self._graph = graph
        calls: dict[str, tuple[str, Callable[[Mapping[str, Any]], dict[str, Any]]]] = {
            "topics": ("Topics", self._topics),
            "topics_and_raw_types": ("TopicsAndRawTypes", self._topics_and_raw_types),
            "topic_type": ("TopicType", self._topic_type),
            "topics_for_type": ("TopicsForType", self._topics_for_type),
            "services": ("Services", self._services),
            "service_type": ("ServiceType", self._service_type),
            "services_for_type": ("ServicesForType", self._services_for_type),
            "nodes": ("Nodes", lambda _: {"nodes": [NODE]}),
            "publishers": ("Publishers", lambda _: {"publishers": [NODE]}),
            "subscribers": ("Subscribers", lambda _: {"subscribers": [NODE]}),
            "get_time": ("GetTime", self._get_time),
            "get_ros_version": ("GetROSVersion", lambda _: {"version": 2, "distro": "jazzy"}),
            "node_details": ("NodeDetails", self._node_details),
            "service_node": ("ServiceNode", self._service_node),
            "service_providers": ("ServiceProviders", self._service_providers),
            "action_servers": ("GetActionServers", lambda _: {"action_servers": self._actions()}),
            "action_type": ("ActionType", self._action_type),
            "interfaces": ("Interfaces", lambda _: {"interfaces": sorted(typestore().fielddefs)}),
            # There are no parameters; an absent one has the default of the request.
            "get_param": ("GetParam", self._get_param),
            "get_param_names": ("GetParamNames", lambda _: {"names": []}),
            "has_param": ("HasParam", lambda _: {"exists": False}),
            "set_param": ("SetParam", lambda _: {"successful": False, "reason": _NO_PARAMETERS}),
            "delete_param": ("DeleteParam", lambda _: {"successful": False, "reason": _NO_PARAMETERS}),
            "message_details": ("MessageDetails", self._message_details),
        }
        for part in ("Goal", "Feedback", "Result"):
            calls[f"action_{part.lower()}_details"] = f"Action{part}Details", partial(self._action_details, part)
        for name, (kind, call) in calls.items():
            graph.serve(f"/rosapi/{name}", Service(f"rosapi_msgs/srv/{kind}", call, quick=True))

    def _topics(self, _: Mapping[str, Any]) -> dict[str, Any]:
        topics = self._graph.topics
        return {"topics": list(topics), "types": list(topics.values())}

    def _topics_and_raw_types(self, _: Mapping[str, Any]) -> dict[str, Any]:
        topics = self._graph.topics
        texts = [definition(kind) for kind in topics.values()]
        return {"topics": list(topics), "types": list(topics.values()), "typedefs_full_text": texts}

    def _topic_type(self, args: Mapping[str, Any]) -> dict[str, Any]:
        return {"type": self._graph.topics.get(resolve(args.get("topic")), "")}

    def _topics_for_type(self, args: Mapping[str, Any]) -> dict[str, Any]:
        kind = full_name(str(args.get("type", "")))
        return {"topics": [topic for topic, known in self._graph.topics.items() if known == kind]}

    def _services(self, _: Mapping[str, Any]) -> dict[str, Any]:
        return {"services": list(self._graph.services)}

    def _service_type(self, args: Mapping[str, Any]) -> dict[str, Any]:
        found = self._graph.services.get(resolve(args.get("service")))
        return {"type": found.type if found else ""}

    def _services_for_type(self, args: Mapping[str, Any]) -> dict[str, Any]:
        return {"services": [name for name, s in self._graph.services.items() if s.type == args.get("type")]}

    def _node_details(self, args: Mapping[str, Any]) -> dict[str, Any]:
        if args.get("node", NODE) not in (NODE, NODE[1:]):
            return {"subscribing": [], "publishing": [], "services": []}
        services = [name for name, service in self._graph.services.items() if not service.client]
        return {"subscribing": [], "publishing": list(self._graph.topics), "services": services}

    def _service_node(self, args: Mapping[str, Any]) -> dict[str, Any]:
        return {"node": NODE if resolve(args.get("service")) in self._graph.services else ""}

    def _service_providers(self, args: Mapping[str, Any]) -> dict[str, Any]:
        known = any(service.type == args.get("service") for service in self._graph.services.values())
        return {"providers": [NODE] if known else []}

    def _actions(self) -> list[str]:
        kinds = self._graph.topics
        return [topic.removesuffix("/goal") for topic, kind in kinds.items() if kind.endswith("ActionGoal")]

    def _action_type(self, args: Mapping[str, Any]) -> dict[str, Any]:
        kind = self._graph.topics.get(f"{resolve(args.get('action'))}/goal", "")
        return {"type": kind.replace("/msg/", "/action/").removesuffix("ActionGoal")}

    @staticmethod
    def _get_param(args: Mapping[str, Any]) -> dict[str, Any]:
        return {"value": str(args.get("default") or ""), "successful": False, "reason": _NO_PARAMETERS}

    @staticmethod
    def _get_time(_: Mapping[str, Any]) -> dict[str, Any]:
        sec, nanosec = divmod(time.time_ns(), 10**9)
        # Clients of ROS 1 read secs and nsecs, those of ROS 2 sec and nanosec.
        return {"time": {"sec": sec, "nanosec": nanosec, "secs": sec, "nsecs": nanosec}}

    @classmethod
    def _action_details(cls, part: str, args: Mapping[str, Any]) -> dict[str, Any]:
        return cls._message_details({"type": str(args.get("type", "")).replace("/action/", "/msg/") + part})

    @staticmethod
    def _message_details(args: Mapping[str, Any]) -> dict[str, Any]:
        todo, done = [full_name(str(args.get("type", "")))], {}
        while todo:
            kind = todo.pop(0)
            done[kind] = _type_definition(kind)
            todo += [t for t in done[kind]["fieldtypes"] if t in typestore().fielddefs and t not in done]
        return {"typedefs": list(done.values())}


def _type_definition(kind: str) -> dict[str, Any]:
    """Return a rosapi_msgs/TypeDef: array lengths are -1 for none, 0 for any."""
    constants, fields = typestore().fielddefs[kind]
    names, types, lengths = [], [], []
    for name, (node, what) in fields:
        many = node in (Nodetype.ARRAY, Nodetype.SEQUENCE)
        (inner, inner_what), length = cast(tuple[tuple[Any, Any], int], what) if many else ((node, what), -1)
        names.append(name)
        types.append(inner_what if inner is Nodetype.NAME else inner_what[0])
        lengths.append(length)  # of a sequence 0
    return {
        "type": kind,
        "fieldnames": names,
        "fieldtypes": types,
        "fieldarraylen": lengths,
        "examples": ["" for _ in names],
        "constnames": [name for name, _, _ in constants],
        "constvalues": [str(value) for _, _, value in constants],
    }
