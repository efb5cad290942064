"""Actions of one rosbridge client, on the topics of actionlib."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from typing import Any

from splatbot.errors import InputError
from splatbot.logs.ros_types import build, to_plain
from splatbot.services.bus import Subscription
from splatbot.services.ros.graph import RosGraph, resolve

_GOALS = 16  # of one client at once
_WAITING = 256  # messages of one goal
_SUCCEEDED = 4  # of action_msgs/GoalStatus
_STATUS = {3: _SUCCEEDED, 2: 5, 8: 5}  # from actionlib_msgs/GoalStatus; the others are aborted
_ABORTED = 6


class Actions:
    """Goals that one client sent, each with the task that reports its feedback and its result.

    Args:
        graph: has the topics ``ACTION/goal``, ``cancel``, ``feedback`` and ``result``.
        send: sends an operation to the client.
        client: number of the client.
    """

    def __init__(self, graph: RosGraph, send: Callable[[dict[str, Any]], Awaitable[None]], client: int) -> None:
        self._graph, self._send, self._client = graph, send, client
        self._goals: dict[tuple[str, str], asyncio.Task[None]] = {}

    async def send_goal(self, operation: dict[str, Any]) -> None:
        """Take a `send_action_goal`; a goal that cannot be sent gets its `action_result` at once."""
        action, name = str(operation.get("action"))[:256], str(operation.get("id"))[:256]
        try:
            action, task = self._begin(operation, name)
        except InputError as error:
            await self._result(action, name, _ABORTED, str(error))
            return
        self._goals[action, name] = task
        task.add_done_callback(lambda _: self._goals.pop((action, name), None))

    def cancel_goal(self, operation: dict[str, Any]) -> None:
        """Take a `cancel_action_goal` of a goal of this client.

        Raises:
            InputError: the client has no such goal.
        """
        action, name = resolve(operation.get("action")), str(operation.get("id"))
        if (action, name) not in self._goals:
            raise InputError(f"no goal {name[:80]} of {action}.", field="id", hint="name a goal of this connection")
        cancel = build("actionlib_msgs/msg/GoalID", id=self._goal_id(name))
        self._graph.publish(f"{action}/cancel", cancel, client=self._client)

    async def close(self) -> None:
        """Report no goal any more; the arm stops when the client's lease ends."""
        tasks = list(self._goals.values())
        for task in tasks:
            task.cancel()
        for task in tasks:
            with suppress(asyncio.CancelledError, Exception):
                await task

    def _begin(self, operation: dict[str, Any], name: str) -> tuple[str, asyncio.Task[None]]:
        action, args = resolve(operation.get("action")), operation.get("args") or {}
        kind = self._graph.topics.get(f"{action}/goal")
        if kind is None:
            raise InputError(f"{action} is no action.", field="action", hint="/rosapi/action_servers lists them")
        if not isinstance(args, Mapping):
            raise InputError("is no object.", field="args", hint=f"give the fields of the goal of {kind}")
        if (action, name) in self._goals or len(self._goals) >= _GOALS:
            raise InputError(f"{name[:80]} is taken.", field="id", hint=f"give each of at most {_GOALS} goals its own")
        goal = build(kind, goal_id={"id": self._goal_id(name)}, goal=args)
        news = self._graph.subscribe(f"{action}/feedback", f"{action}/result", capacity=_WAITING)
        try:
            self._graph.publish(f"{action}/goal", goal, client=self._client)
        except BaseException:
            news.close()
            raise
        wants_feedback = bool(operation.get("feedback"))
        return action, asyncio.get_running_loop().create_task(self._report(action, name, news, wants_feedback))

    async def _report(self, action: str, name: str, news: Subscription, wants_feedback: bool) -> None:
        with news:
            async for item in news:
                values = to_plain(item.value.message)
                if values["status"]["goal_id"]["id"] != self._goal_id(name):
                    continue
                if item.topic.endswith("/result"):
                    status = _STATUS.get(int(values["status"]["status"]), _ABORTED)
                    await self._result(action, name, status, values["status"]["text"], values["result"])
                    return
                if wants_feedback:
                    told = {"op": "action_feedback", "action": action, "id": name, "values": values["feedback"]}
                    await self._send(told)

    async def _result(
        self, action: str, name: str, status: int, text: str, values: Mapping[str, Any] | None = None
    ) -> None:
        answer = {"op": "action_result", "action": action, "id": name, "status": status}
        await self._send(answer | {"result": status == _SUCCEEDED, "values": values or {"error_string": text}})

    def _goal_id(self, name: str) -> str:
        """Return an id that no other client's goal has."""
        return f"{self._client}:{name}"
