"""One rosbridge client: its operations and the answers to them. Knows nothing of WebSockets."""

from __future__ import annotations

import asyncio
import inspect
import itertools
import json
import logging
import re
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, cast

from splatbot.errors import InputError, SplatbotError
from splatbot.logs.ros_types import build, full_name
from splatbot.services.bounds import INLINE_BYTES
from splatbot.services.keys import Scope
from splatbot.services.ros.emergency import EMERGENCY_STOP
from splatbot.services.ros.graph import Handler, RosGraph, Service, resolve
from splatbot.services.ros.requests import read_json_object
from splatbot.services.ros.rosbridge.actions import Actions
from splatbot.services.ros.rosbridge.packing import (
    Fragments,
    check_compression,
    check_fragment_size,
    pack,
    split,
    unpack_png,
)
from splatbot.services.ros.rosbridge.subscriptions import Send, Subscriptions
from splatbot.services.scopes import ScopeError

_LEVELS = ("none", "error", "warning", "info")
_CALLS = 16  # services that one client may have called without an answer
_ANSWER_S = 60.0  # [s] that a client may take to serve a call
_CALL_THREADS = ThreadPoolExecutor(8, "ros-calls")  # of all clients; other threads pack messages
_numbers = itertools.count(1)
_READING = frozenset({"subscribe", "unsubscribe", "fragment", "png", "set_level", "status", "auth", "call_service"})
_PUBLISHING = frozenset({"advertise", "unadvertise", "publish"})
_SERVING = frozenset({"advertise_service", "unadvertise_service", "service_response"})
_COMMANDS = re.compile(r"/\w+_controller/.*|.*/(goal|cancel)")

_log = logging.getLogger(__name__)


class RosbridgeSession:
    """Operations of one client.

    A failed operation is answered by a `status` of level error, which `set_level` none turns off. A failed call is
    answered by a `service_response` whose result is false. Compression and fragments are used only on request.

    Args:
        graph: topics and services.
        send: takes text or bytes for the client; one at a time, and may wait.
        most_bytes: of one message.
        scopes: rights of the client. Reading includes calls of the service's own services, which change nothing.
    """

    def __init__(self, graph: RosGraph, send: Send, *, most_bytes: int, scopes: frozenset[Scope] = frozenset()) -> None:
        self.number = next(_numbers)
        self._graph, self._most_bytes, self._scopes = graph, most_bytes, scopes
        graph.join(self.number)
        self._to_client = send
        self._sending = asyncio.Lock()
        self._subscriptions = Subscriptions(graph, self._send, self.number)
        self._actions = Actions(graph, lambda values: self._send(pack(values, "none")), self.number)
        self._fragments = Fragments(most_bytes)
        self._advertised: dict[str, str] = {}
        self._served: set[str] = set()
        self._calls: set[asyncio.Task[None]] = set()
        self._answers: dict[str, asyncio.Future[dict[str, Any]]] = {}
        self._level = _LEVELS.index("error")
        self._long = False  # the message in work is not one for the event loop
        self._operations: dict[str, Callable[[dict[str, Any]], Awaitable[None] | None]] = {
            "advertise": self._advertise,
            "unadvertise": self._unadvertise,
            "publish": self._publish,
            "subscribe": self._subscriptions.add,
            "unsubscribe": self._subscriptions.remove,
            "call_service": self._call_service,
            "advertise_service": self._advertise_service,
            "unadvertise_service": self._unadvertise_service,
            "service_response": self._service_response,
            "send_action_goal": self._actions.send_goal,
            "cancel_action_goal": self._actions.cancel_goal,
            "fragment": self._fragment,
            "png": self._png,
            "set_level": self._set_level,
            "status": lambda _: None,
            "auth": lambda _: None,  # keys are looked at when the connection is made
        }

    async def receive(self, text: str | bytes) -> None:
        """Handle a client's message; a wrong message never raises."""
        operation: dict[str, Any] = {}
        try:
            operation = await read_json_object(text, self._most_bytes)
            self._long = len(text) > INLINE_BYTES
            operate = self._operation(operation.get("op"))
            self._check_scope(operation)
            done = operate(operation)
            if inspect.isawaitable(done):
                await done
        except SplatbotError as error:
            await self._status("error", str(error), operation.get("id"))
        except Exception:
            if not isinstance(text, str):
                text = repr(text[:80])
            _log.exception("a rosbridge operation failed: %.200s", text)
            await self._status("error", "the service failed on this message; its log says why", operation.get("id"))

    async def close(self) -> None:
        """Forget the client."""
        await self._subscriptions.close()
        await self._actions.close()
        self._graph.leave(self.number)
        for name in self._served:
            self._graph.withdraw(name, self.number)
        for answer in list(self._answers.values()):
            if not answer.done():
                answer.set_result({"result": False, "values": "its server has gone"})
        for call in list(self._calls):
            call.cancel()

    def _operation(self, name: Any) -> Callable[[dict[str, Any]], Awaitable[None] | None]:
        if not isinstance(name, str) or name not in self._operations:
            known = ", ".join(self._operations)
            raise InputError("is not a known operation.", field="op", hint=f"the operations are {known}")
        return self._operations[name]

    def _check_scope(self, operation: Mapping[str, Any]) -> None:
        """Check that the client may do an operation.

        Raises:
            ScopeError: it lacks the scope.
        """
        name, scope = operation["op"], cast(Scope, "move")
        topic = operation.get("topic")
        if name in _READING or (name == "publish" and topic is not None and resolve(topic) == EMERGENCY_STOP):
            scope = "read"  # a stop adds no danger
        elif name in _SERVING or (name in _PUBLISHING and not _COMMANDS.fullmatch(resolve(operation.get("topic")))):
            scope = "map"
        self._require(scope, str(name))

    def _require(self, scope: Scope, what: str) -> None:
        if scope not in self._scopes:
            hint = "connect with ?api_key=KEY; splatbot serve names the file of its key at the start"
            raise ScopeError(f"{what} needs a key with the scope {scope!r}.", field="op", hint=hint)

    async def _send(self, data: str | bytes) -> None:
        async with self._sending:
            await self._to_client(data)

    async def _status(self, level: str, text: str, name: Any) -> None:
        if _LEVELS.index(level) <= self._level:
            status = {"op": "status", "level": level, "msg": text} | ({} if name is None else {"id": str(name)[:256]})
            await self._send(json.dumps(status))

    def _set_level(self, operation: dict[str, Any]) -> None:
        if operation.get("level") not in _LEVELS:
            raise InputError("is unknown.", field="level", hint=f"use {', '.join(_LEVELS)}")
        self._level = _LEVELS.index(operation["level"])

    def _advertise(self, operation: dict[str, Any]) -> None:
        kind = full_name(str(operation.get("type", "")))
        topic = self._graph.advertise(resolve(operation.get("topic")), kind, client=self.number)
        self._advertised[topic] = kind

    def _unadvertise(self, operation: dict[str, Any]) -> None:
        if self._advertised.pop(resolve(operation.get("topic")), None) is not None:
            self._graph.unadvertise(resolve(operation.get("topic")), self.number)

    async def _publish(self, operation: dict[str, Any]) -> None:
        topic = resolve(operation.get("topic"))
        values = operation.get("msg", {})
        if not isinstance(values, Mapping):
            raise InputError("is no object.", field="msg", hint="give the fields of the message")
        kind = self._advertised.get(topic) or self._graph.kind_of(topic, values)
        if kind is None:
            raise InputError(f"{topic} is of no known type.", field="topic", hint="advertise it first")
        message = await asyncio.to_thread(build, kind, values) if self._long else build(kind, values)
        self._graph.publish(topic, message, latched=bool(operation.get("latch")), client=self.number)

    async def _fragment(self, operation: dict[str, Any]) -> None:
        if (whole := self._fragments.add(operation)) is not None:
            await self.receive(whole)

    async def _png(self, operation: dict[str, Any]) -> None:
        text = await asyncio.to_thread(unpack_png, operation.get("data"), self._most_bytes)
        if '"png"' in text[:16]:  # images nested without end
            raise InputError("holds another.", field="png", hint="pack once")
        await self.receive(text.rstrip("\n"))

    async def _call_service(self, operation: dict[str, Any]) -> None:
        if len(self._calls) >= _CALLS:
            await self._respond(operation, f"{_CALLS} calls have no answer yet", result=False)
            return
        task = asyncio.get_running_loop().create_task(self._call(operation))
        self._calls.add(task)
        task.add_done_callback(self._calls.discard)

    async def _call(self, operation: dict[str, Any]) -> None:
        try:
            check_compression(operation.get("compression") or "none")
            check_fragment_size(operation.get("fragment_size"))
            name, args = str(operation.get("service")), operation.get("args") or {}
            if not isinstance(args, Mapping):
                raise InputError("is no object.", field="args", hint="name the request's fields")
            service = self._graph.service(name)
            if service.client:  # it is another client's, and may do anything
                self._require("map", f"a call of {name}")
            if inspect.iscoroutinefunction(service.call):
                values = await service.call(args)
            else:
                loop = asyncio.get_running_loop()
                values = await loop.run_in_executor(None if service.quick else _CALL_THREADS, service.call, args)
        except SplatbotError as error:
            await self._respond(operation, str(error), result=False)
        except Exception:
            _log.exception("service %.80s failed", operation.get("service"))
            await self._respond(operation, "the service failed on this request; its log says why", result=False)
        else:
            await self._respond(operation, values, result=True)

    async def _respond(self, operation: dict[str, Any], values: Any, *, result: bool) -> None:
        answer = {"op": "service_response", "service": operation.get("service"), "values": values, "result": result}
        if operation.get("id") is not None:
            answer["id"] = operation["id"]
        try:
            compression = check_compression(operation.get("compression") or "none")
            size = check_fragment_size(operation.get("fragment_size"))
        except InputError:
            compression, size = "none", None
        packed = await asyncio.to_thread(pack, answer, compression)
        for part in [packed] if isinstance(packed, bytes) else split(packed, size, str(operation.get("id"))):
            await self._send(part)

    def _advertise_service(self, operation: dict[str, Any]) -> None:
        name = resolve(operation.get("service"))

        async def relay(args: Mapping[str, Any]) -> dict[str, Any]:
            return await self._ask_client(name, args)

        self._graph.serve(name, Service(str(operation.get("type", "")), cast(Handler, relay), self.number))
        self._served.add(name)

    def _unadvertise_service(self, operation: dict[str, Any]) -> None:
        name = resolve(operation.get("service"))
        self._graph.withdraw(name, self.number)
        self._served.discard(name)

    async def _ask_client(self, name: str, args: Mapping[str, Any]) -> dict[str, Any]:
        ticket = f"{name}:{next(_numbers)}"
        answer = self._answers[ticket] = asyncio.get_running_loop().create_future()
        call = {"op": "call_service", "id": ticket, "service": name, "args": dict(args)}
        try:
            await self._send(pack(call, "none"))
            done = await asyncio.wait_for(answer, _ANSWER_S)
        except TimeoutError as error:
            raise InputError(f"{name}: its server does not answer.", field="service", hint="try again") from error
        finally:
            self._answers.pop(ticket, None)
        if not done.get("result", True):
            raise InputError(f"{name}: {str(done.get('values'))[:400]}", field="service")
        values = done.get("values")
        return values if isinstance(values, dict) else {}

    def _service_response(self, operation: dict[str, Any]) -> None:
        answer = self._answers.get(str(operation.get("id")))
        if answer is not None and not answer.done():
            answer.set_result(operation)
