"""A client of the HTTP service; needs nothing of the service's side.

>>> from splatbot.client import Client
>>> robot = Client("http://127.0.0.1:8000")
>>> robot.distance("default", [[0.1, 0.0, 0.8]]).inside  # doctest: +SKIP
"""

from __future__ import annotations

import http.client
import io
import json
import ssl
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self
from urllib.parse import quote, urlsplit

import msgpack
import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.errors import InputError, SplatbotError
from splatbot.frame import Frame

_MSGPACK = "application/msgpack"
_NPY = "application/x-npy"
_ENDED = ("succeeded", "failed", "cancelled")


class ServiceError(SplatbotError):
    """The service refused, or could not be reached.

    Args:
        message: the problem's detail.
        status: of HTTP; 0: no answer came.
        problem: the whole problem document.
    """

    def __init__(self, message: str, *, status: int = 0, problem: Mapping[str, Any] | None = None) -> None:
        self.status = status
        self.problem = dict(problem or {})
        self.code = int(self.problem.get("code", SplatbotError.code))
        super().__init__(message, field=self.problem.get("field"), hint=self.problem.get("hint"))


@dataclass(frozen=True, eq=False)
class Distances:
    """How far P points are from the map.

    Args:
        distance: (P,) float32, in standard deviations of the nearest Gaussian; infinity: the map is empty.
        index: (P,) that Gaussian's row; -1: the map is empty.
        inside: (P,) bool.
        map_version: the state that was asked.
    """

    distance: NDArray[np.float32]
    index: NDArray[np.int64]
    inside: NDArray[np.bool_]
    map_version: int


@dataclass(frozen=True, eq=False)
class Collisions:
    """Verdicts on C configurations.

    Args:
        in_collision: (C,) bool; False is certain.
        link: (C,) the link that touches, -1: none.
        other: (C,) the link that it touches, -1: the map.
        clearance: (C,) [m].
        gradient: (C, J) of the clearance; None unless asked for.
        map_version: the state that was asked.
    """

    in_collision: NDArray[np.bool_]
    link: NDArray[np.int32]
    other: NDArray[np.int32]
    clearance: NDArray[np.float64]
    gradient: NDArray[np.float64] | None
    map_version: int


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """What became of a pushed frame.

    Args:
        T_world_camera: (4, 4); None: lost.
        verdict: "ok", "degraded" or "lost".
        keyframe: whether it entered the map.
        gaussians: in the map afterwards.
        map_version: the latest state.
        stage_ms: what each stage of tracking and mapping took [ms].
    """

    T_world_camera: NDArray[np.float64] | None
    verdict: str
    keyframe: bool
    gaussians: int
    map_version: int
    stage_ms: dict[str, float]


class Client:
    """One connection to a service; for use by one thread at a time.

    Args:
        url: of the service, "http://host:port" or "https://...".
        key: API key, where the service wants one.
        timeout_s: how long an answer may take [s].
        retries: how often it asks again when it is told "later" (429, 503).
        tls: for https; None trusts what the system trusts.

    Raises:
        InputError: the URL is none.
    """

    def __init__(
        self,
        url: str,
        *,
        key: str | None = None,
        timeout_s: float = 60.0,
        retries: int = 3,
        tls: ssl.SSLContext | None = None,
    ) -> None:
        parts = urlsplit(url)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise InputError(f"is {url!r}.", field="url", hint="give http://host:port")
        self._headers = {"Authorization": f"Bearer {key}"} if key else {}
        self._retries = retries
        self._connection: http.client.HTTPConnection
        if parts.scheme == "https":
            self._connection = http.client.HTTPSConnection(
                parts.hostname, parts.port, timeout=timeout_s, context=tls or ssl.create_default_context()
            )
        else:
            self._connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=timeout_s)

    def maps(self) -> list[dict[str, Any]]:
        """All maps."""
        found: list[dict[str, Any]] = self._json("GET", "/v1/maps")["maps"]
        return found

    def map(self, map_id: str) -> dict[str, Any]:
        """One map: id, map_version, state, gaussians, bounds, ..."""
        return self._json("GET", f"/v1/maps/{quote(map_id, safe='')}")

    def create_map(self, map_id: str, log: str | None = None, *, key: str | None = None, **more: Any) -> dict[str, Any]:
        """A map of a recording: its job; or, without ``log``, an empty one for :meth:`push`: its description.

        Args:
            map_id: its name.
            log: synthetic:SCENE?..., or a folder under the service's log roots.
            key: Idempotency-Key: asked again with it, the same job is returned.
            more: camera, max_frames, robot_base.
        """
        body = {"id": map_id, **({"log": log} if log is not None else {}), **more}
        return self._json("POST", "/v1/maps", body, {"Idempotency-Key": key} if key else {})

    def delete_map(self, map_id: str) -> None:
        """Forget a map."""
        self.request("DELETE", f"/v1/maps/{quote(map_id, safe='')}")

    def push(self, map_id: str, frame: Frame) -> TrackedFrame:
        """Have a frame tracked and mapped; waits while the service has too many frames in work."""
        c = frame.camera
        body = {
            "stamp": frame.stamp,
            "camera": {n: getattr(c, n) for n in ("fx", "fy", "cx", "cy", "width", "height")},
            "rgb": frame.rgb,
            "depth": frame.depth,
            "joints": None if frame.joints is None else frame.joints.tolist(),
        }
        told = self._packed("POST", f"/v1/maps/{quote(map_id, safe='')}/frames", body)
        return TrackedFrame(
            T_world_camera=told["T_world_camera"],
            verdict=told["verdict"],
            keyframe=told["keyframe"],
            gaussians=told["gaussians"],
            map_version=told["map_version"],
            stage_ms=told["stage_ms"],
        )

    def end(self, map_id: str) -> None:
        """No more frames will be pushed."""
        self.request("POST", f"/v1/maps/{quote(map_id, safe='')}/end")

    def distance(self, map_id: str, points: ArrayLike, *, n_sigma: float = 2.0) -> Distances:
        """How far points (P, 3) [m] are from the map."""
        body = {"points": np.asarray(points, dtype=np.float64).reshape(-1, 3), "n_sigma": n_sigma}
        told = self._packed("POST", f"/v1/maps/{quote(map_id, safe='')}/distance", body)
        return Distances(told["distance"], told["index"], told["inside"], told["map_version"])

    def distance_npy(self, map_id: str, points: ArrayLike) -> NDArray[np.float32]:
        """The distances (P,) alone, of points (P, 3) [m]: the least that can be sent either way."""
        sent = io.BytesIO()
        np.save(sent, np.asarray(points), allow_pickle=False)
        path = f"/v1/maps/{quote(map_id, safe='')}/distance"
        data, _ = self.request("POST", path, sent.getvalue(), {"Content-Type": _NPY, "Accept": _NPY})
        return np.asarray(np.load(io.BytesIO(data), allow_pickle=False), dtype=np.float32)

    def collisions(self, map_id: str, q: ArrayLike, *, gradient: bool = False, **more: Any) -> Collisions:
        """Whether configurations (C, J) touch the map or the arm itself, and how much room they have.

        Args:
            map_id: the map.
            q: (C, J) [rad or m].
            gradient: also the clearance's.
            more: robot, base, margin, opening.
        """
        body = {"q": np.atleast_2d(np.asarray(q, dtype=np.float64)), "gradient": gradient, **more}
        told = self._packed("POST", f"/v1/maps/{quote(map_id, safe='')}/collisions", body)
        return Collisions(
            in_collision=told["in_collision"],
            link=told["link"],
            other=told["other"],
            clearance=told["clearance"],
            gradient=told.get("gradient"),
            map_version=told["map_version"],
        )

    def views(
        self, map_id: str, views: Sequence[Mapping[str, Any]], modes: Sequence[str] = ("rgb",)
    ) -> list[dict[str, NDArray[Any]]]:
        """Images by mode for each of ``views`` ({"camera": {...}, "pose": {...}}): rgb uint8, depth float32 [m]."""
        body = {"views": list(views), "modes": list(modes)}
        drawn: list[dict[str, NDArray[Any]]] = self._packed("POST", f"/v1/maps/{quote(map_id, safe='')}/views", body)[
            "views"
        ]
        return drawn

    def plan(self, map_id: str, **asked: Any) -> dict[str, Any]:
        """A certified motion; see POST /v1/maps/{map_id}/plans for what may be asked. No motion is an error."""
        return self._json("POST", f"/v1/maps/{quote(map_id, safe='')}/plans", asked)

    def grasps(self, map_id: str, **asked: Any) -> dict[str, Any]:
        """Ranked grasps of a thing; see POST /v1/maps/{map_id}/grasps for how it is named. No grasp is an error."""
        return self._json("POST", f"/v1/maps/{quote(map_id, safe='')}/grasps", asked)

    def pick(self, scene: str, target: str, *, key: str | None = None, **more: Any) -> dict[str, Any]:
        """Pick a thing in the twin of a shipped scene: the job, to be watched by :meth:`wait` or :meth:`events`.

        Args:
            scene: its name.
            target: a name of the scene, or words.
            key: Idempotency-Key: asked again with it, the same job is returned.
            more: views, lift, force, tries, budget_ms, margin, home, seed.
        """
        headers = {"Idempotency-Key": key} if key else {}
        return self._json("POST", "/v1/picks", {"scene": scene, "target": target, **more}, headers)

    def cancel(self, job_id: str) -> dict[str, Any]:
        """Cancel a job; as it stands then."""
        return self._json("DELETE", f"/v1/jobs/{quote(job_id, safe='')}")

    def ik(self, pose: Mapping[str, Any], **more: Any) -> NDArray[np.float64]:
        """Configurations (K, J) that bring the tool to a pose."""
        found: NDArray[np.float64] = self._packed("POST", "/v1/ik", {"pose": dict(pose), **more})["q"]
        return found

    def send(self, plan_id: str, *, arm: str = "fake", key: str | None = None) -> dict[str, Any]:
        """Let an arm follow a plan; the motion, to be watched by :meth:`wait` under "/v1/trajectories"."""
        headers = {"Idempotency-Key": key} if key else {}
        return self._json("POST", "/v1/trajectories", {"plan": plan_id, "arm": arm}, headers)

    def stop(self, motion_id: str) -> dict[str, Any]:
        """Stop an arm's motion."""
        return self._json("DELETE", f"/v1/trajectories/{quote(motion_id, safe='')}")

    def wait(self, job_id: str, *, under: str = "/v1/jobs", timeout_s: float = 600.0) -> dict[str, Any]:
        """The job once it has ended.

        Raises:
            ServiceError: it has not ended in time.
        """
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            job = self._json("GET", f"{under}/{quote(job_id, safe='')}")
            if job["state"] in _ENDED:
                return job
            time.sleep(0.05)
        raise ServiceError(f"job {job_id} has not ended within {timeout_s:g} s.")

    def events(self, path: str) -> Iterator[tuple[str, dict[str, Any]]]:
        """Name and data of each server-sent event of e.g. "/v1/jobs/ID/events", to the end of the stream."""
        self._connection.request("GET", path, headers=self._headers | {"Accept": "text/event-stream"})
        response = self._connection.getresponse()
        if response.status != 200:
            raise _refused(response.status, response.read())
        name, data = "message", ""
        while line := response.readline():
            text = line.decode().rstrip("\r\n")
            if text.startswith("event:"):
                name = text[6:].strip()
            elif text.startswith("data:"):
                data += text[5:].strip()
            elif not text and data:
                yield name, json.loads(data)
                name, data = "message", ""

    def request(
        self, method: str, path: str, body: bytes | None = None, headers: Mapping[str, str] | None = None
    ) -> tuple[bytes, Mapping[str, str]]:
        """One request; the answer's body and headers. What is answered "later" (429, 503) is asked again in a while.

        Raises:
            ServiceError: it was refused, or no answer came.
        """
        for attempt in range(self._retries + 1):
            try:
                self._connection.request(method, path, body, self._headers | dict(headers or {}))
                response = self._connection.getresponse()
                data = response.read()
            except (OSError, http.client.HTTPException) as error:
                self._connection.close()
                raise ServiceError(f"no answer ({error or type(error).__name__}).") from error
            told = {name.lower(): value for name, value in response.getheaders()}
            if response.status < 400:
                return data, told
            if attempt == self._retries or response.status not in (429, 503) or "retry-after" not in told:
                raise _refused(response.status, data)
            time.sleep(min(10.0, float(told["retry-after"])))
        raise AssertionError("the last attempt returns or raises")

    def close(self) -> None:
        """End the connection."""
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _json(
        self, method: str, path: str, body: Mapping[str, Any] | None = None, headers: Mapping[str, str] | None = None
    ) -> dict[str, Any]:
        sent = None if body is None else json.dumps(body).encode()
        data, _ = self.request(method, path, sent, {"Content-Type": "application/json"} | dict(headers or {}))
        found: dict[str, Any] = json.loads(data)
        return found

    def _packed(self, method: str, path: str, body: Mapping[str, Any]) -> dict[str, Any]:
        data, _ = self.request(
            method, path, msgpack.packb(body, default=pack_array), {"Content-Type": _MSGPACK, "Accept": _MSGPACK}
        )
        found: dict[str, Any] = msgpack.unpackb(data, object_hook=_unpack)
        return found


def _refused(status: int, data: bytes) -> ServiceError:
    try:
        problem = json.loads(data)
        return ServiceError(str(problem["detail"]), status=status, problem=problem)
    except (ValueError, KeyError, TypeError):
        return ServiceError(f"status {status}.", status=status)


def pack_array(value: Any) -> Any:
    """How msgpack carries an array: {dtype, shape, data}; numpy's numbers become Python's."""
    if isinstance(value, np.ndarray):
        return {"dtype": value.dtype.str, "shape": list(value.shape), "data": np.ascontiguousarray(value).tobytes()}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be sent")


def _unpack(value: dict[str, Any]) -> Any:
    if set(value) != {"dtype", "shape", "data"}:
        return value
    return np.frombuffer(value["data"], np.dtype(value["dtype"])).reshape(value["shape"]).copy()
