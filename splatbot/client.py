"""Client of the HTTP service; it imports no part of the service.

>>> from splatbot.client import Client
>>> robot = Client("http://127.0.0.1:8000")
>>> robot.distance("default", [[0.1, 0.0, 0.8]]).inside  # doctest: +SKIP
"""

from __future__ import annotations

import io
import ipaddress
import json
import os
import ssl
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields
from types import TracebackType
from typing import Any, TypeVar
from urllib.parse import quote, urlsplit

import httpx
import msgpack
import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.errors import InputError, SplatbotError
from splatbot.frame import Frame
from splatbot.service_key import key_file, read_key

_MSGPACK = "application/msgpack"
_NPY = "application/x-npy"
_ENDED = ("succeeded", "failed", "cancelled")


class ServiceError(SplatbotError):
    """The service refused a request, or did not answer.

    Args:
        message: detail of the problem document.
        status: HTTP status; 0 if no answer arrived.
        problem: the whole problem document (RFC 9457).
    """

    def __init__(self, message: str, *, status: int = 0, problem: Mapping[str, Any] | None = None) -> None:
        self.status = status
        self.problem = dict(problem or {})
        self.code = int(self.problem.get("code", SplatbotError.code))
        super().__init__(message, field=self.problem.get("field"), hint=self.problem.get("hint"))


@dataclass(frozen=True, eq=False)
class Distances:
    """Distances of P points to the map.

    Args:
        distance_sigma: (P,) float32, in standard deviations of the nearest Gaussian; infinity in an empty map.
        distance_m: (P,) float32, signed distance to the surface at 2 standard deviations [m]; infinity beyond 1 m, and
            if another ``n_sigma`` was queried.
        index: (P,) row of that Gaussian; -1 in an empty map.
        inside: (P,) bool, whether the distance is below ``n_sigma``.
        map_version: version of the map that answered.
    """

    distance_sigma: NDArray[np.float32]
    distance_m: NDArray[np.float32]
    index: NDArray[np.int64]
    inside: NDArray[np.bool_]
    map_version: int


@dataclass(frozen=True, eq=False)
class Collisions:
    """Collision verdicts of C configurations.

    Args:
        in_collision: (C,) bool; False is certified.
        link: (C,) link in collision; -1 if the configuration is free.
        other: (C,) link that it collides with; -1 is the map.
        clearance: (C,) [m].
        gradient: (C, J) of the clearance; None unless it was requested.
        map_version: version of the map that answered.
    """

    in_collision: NDArray[np.bool_]
    link: NDArray[np.int32]
    other: NDArray[np.int32]
    clearance: NDArray[np.float64]
    gradient: NDArray[np.float64] | None
    map_version: int


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """Result of a pushed frame.

    Args:
        T_world_camera: (4, 4); None if the frame is lost.
        verdict: "ok", "degraded" or "lost".
        keyframe: whether the frame entered the map.
        gaussians: size of the map afterwards.
        map_version: latest version of the map.
        stage_ms: time of each stage of tracking and mapping [ms].
        reasons: causes of a verdict other than "ok".
    """

    T_world_camera: NDArray[np.float64] | None
    verdict: str
    keyframe: bool
    gaussians: int
    map_version: int
    stage_ms: dict[str, float]
    reasons: list[str]


_Result = TypeVar("_Result", Distances, Collisions, TrackedFrame)


class Client(AbstractContextManager["Client"]):
    """Connection to a service.

    Args:
        url: "http://host:port" or "https://...".
        key: API key. If None, that of SPLATBOT_API_KEY, else for a service on loopback that of
            :func:`splatbot.service_key.key_file`, if there is one.
        timeout_s: longest wait for an answer [s].
        retries: number of repetitions after the statuses 429 and 503.
        tls: context for https. If None, the certificates of the system are trusted.

    Raises:
        InputError: the URL is not one of HTTP.
        ConfigError: the file of the key is open to other users.
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
        if key is None:
            key = os.environ.get("SPLATBOT_API_KEY") or (read_key(key_file()) if _loopback(parts.hostname) else None)
        self._retries = retries
        self._http = httpx.Client(
            base_url=f"{parts.scheme}://{parts.netloc}",
            headers={"Authorization": f"Bearer {key}"} if key else {},
            timeout=timeout_s,
            verify=(tls or ssl.create_default_context()) if parts.scheme == "https" else False,
            trust_env=False,  # the proxies of the environment are for other hosts than a robot's
        )

    def maps(self) -> list[dict[str, Any]]:
        """List all maps."""
        found: list[dict[str, Any]] = self._json("GET", "/v1/maps")["maps"]
        return found

    def map(self, map_id: str) -> dict[str, Any]:
        """Return the description of a map: id, map_version, state, gaussians, bounds, ..."""
        return self._json("GET", _map_path(map_id))

    def create_map(self, map_id: str, log: str | None = None, *, key: str | None = None, **more: Any) -> dict[str, Any]:
        """Create a map of a recording and return its job; without ``log``, an empty map for :meth:`push`.

        Args:
            map_id: name of the map.
            log: synthetic:SCENE?..., or a folder, .mcap or .bag under the service's log roots.
            key: Idempotency-Key; a repeated request with the same key returns the same job.
            more: camera, max_frames, robot_base, robot, cameras.
        """
        body = {"id": map_id, **({"log": log} if log is not None else {}), **more}
        return self._json("POST", "/v1/maps", body, _idempotency(key))

    def delete_map(self, map_id: str) -> None:
        """Delete a map."""
        self.request("DELETE", _map_path(map_id))

    def save_version(self, map_id: str, label: str | None = None, *, note: str | None = None) -> dict[str, Any]:
        """Save a map as it is now, and return the version: number, label, gaussians, keyframes, bytes, checksum, ..."""
        return self._json("POST", _map_path(map_id, "versions"), {"label": label, "note": note})

    def versions(self, map_id: str) -> list[dict[str, Any]]:
        """List the versions of a map by number."""
        found: list[dict[str, Any]] = self._json("GET", _map_path(map_id, "versions"))["versions"]
        return found

    def restore(self, map_id: str, number: int) -> dict[str, Any]:
        """Let a map go back to a version, and return the new version that records it."""
        return self._json("POST", _map_path(map_id, "versions", str(number), "restore"))

    def delete_version(self, map_id: str, number: int) -> None:
        """Delete a version of a map."""
        self.request("DELETE", _map_path(map_id, "versions", str(number)))

    def merge(self, map_id: str, other: str, made: str, *, key: str | None = None, **more: int) -> dict[str, Any]:
        """Merge two maps into a new one, and return the job.

        Args:
            map_id: name of the map whose world the new one has.
            other: name of the later map.
            made: name of the new map.
            key: Idempotency-Key; a repeated request with the same key returns the same job.
            more: version, other_version: numbers of versions instead of the present states.
        """
        body = {"id": made, "other": other, **more}
        return self._json("POST", _map_path(map_id, "merge"), body, _idempotency(key))

    def diff(self, map_id: str, other: str, *, key: str | None = None, **more: int | bool) -> dict[str, Any]:
        """Find the objects that differ between a map and a later one, and return the job; its result has ``objects``.

        Args:
            map_id: name of the earlier map.
            other: name of the later map; the same name with ``version`` compares a map with its earlier state.
            key: Idempotency-Key; a repeated request with the same key returns the same job.
            more: version, other_version: numbers of versions instead of the present states; aligned.
        """
        return self._json("POST", _map_path(map_id, "diff"), {"other": other, **more}, _idempotency(key))

    def quota(self) -> dict[str, Any]:
        """Return used and largest numbers of maps, jobs and bytes of this client."""
        return self._json("GET", "/v1/quota")

    def push(self, map_id: str, frame: Frame) -> TrackedFrame:
        """Send a frame of any camera for tracking and mapping; wait while too many frames are in progress."""
        c = frame.camera
        joints, names, depth_joints = _known_joints(frame)
        body = {
            "stamp": frame.stamp,
            "camera": {n: getattr(c, n) for n in ("fx", "fy", "cx", "cy", "width", "height")},
            "rgb": frame.rgb,
            "depth": frame.depth,
            "mask": frame.mask,
            "depth_delay": frame.depth_delay,
            "joints": joints,
            "joint_names": names,
            "camera_name": frame.camera_name,
            "depth_joints": depth_joints,
        }
        answer = self._packed("POST", _map_path(map_id, "frames"), body)
        return _result(TrackedFrame, answer)

    def report_joints(self, robot: str, stamps: ArrayLike, positions: ArrayLike, *, names: Sequence[str] = ()) -> int:
        """Report joint states, by which a robot is masked in the frames of maps.

        Returns:
            The number of masks that use them.

        Args:
            robot: its name.
            stamps: (N,) by the clock of the images [s], at most 1000.
            positions: (N, J) [rad or m].
            names: of the joints; if empty, they are in the order of the robot.
        """
        rows = zip(np.asarray(stamps, np.float64).tolist(), np.asarray(positions, np.float64).tolist(), strict=True)
        states = [{"stamp": stamp, "position": q, "names": list(names)} for stamp, q in rows]
        return int(self._json("POST", f"/v1/robots/{quote(robot, safe='')}/joints", {"states": states})["masks"])

    def hold(self, map_id: str, spheres: ArrayLike) -> None:
        """Mask an object in the robot's hand: spheres (A, 4) (x, y, z, radius) [m] in the frame of the last link."""
        body = {"spheres": np.asarray(spheres, np.float64).reshape(-1, 4).tolist()}
        self.request("PUT", _map_path(map_id, "held"), json.dumps(body).encode(), {"Content-Type": "application/json"})

    def resync(self, map_id: str) -> None:
        """Announce that the clock of the frames was set; the next frame may have any stamp."""
        self.request("POST", _map_path(map_id, "resync"))

    def end(self, map_id: str) -> None:
        """End the stream of pushed frames."""
        self.request("POST", _map_path(map_id, "end"))

    def distance(self, map_id: str, points: ArrayLike, *, n_sigma: float = 2.0) -> Distances:
        """Query the distances of points (P, 3) [m] to the map, in standard deviations and in metres."""
        body = {"points": np.asarray(points, dtype=np.float64).reshape(-1, 3), "n_sigma": n_sigma}
        answer = self._packed("POST", _map_path(map_id, "distance"), body)
        return _result(Distances, answer)

    def distance_npy(self, map_id: str, points: ArrayLike) -> NDArray[np.float32]:
        """Query the distances (P,) of points (P, 3) [m] alone, with the smallest bodies in both directions."""
        sent = io.BytesIO()
        np.save(sent, np.asarray(points), allow_pickle=False)
        headers = {"Content-Type": _NPY, "Accept": _NPY}
        data, _ = self.request("POST", _map_path(map_id, "distance"), sent.getvalue(), headers)
        return np.asarray(np.load(io.BytesIO(data), allow_pickle=False), dtype=np.float32)

    def collisions(self, map_id: str, q: ArrayLike, *, gradient: bool = False, **more: Any) -> Collisions:
        """Check configurations (C, J) against the map and the arm itself, and return their clearance.

        Args:
            map_id: name of the map.
            q: (C, J) [rad or m].
            gradient: whether to return the gradient of the clearance.
            more: robot, base, margin, opening.
        """
        body = {"q": np.atleast_2d(np.asarray(q, dtype=np.float64)), "gradient": gradient, **more}
        answer = self._packed("POST", _map_path(map_id, "collisions"), body)
        return _result(Collisions, {"gradient": None} | answer)

    def views(
        self, map_id: str, views: Sequence[Mapping[str, Any]], modes: Sequence[str] = ("rgb",)
    ) -> list[dict[str, NDArray[Any]]]:
        """Render ``views`` ({"camera": {...}, "pose": {...}}); images by mode: rgb uint8, depth float32 [m]."""
        answer = self._packed("POST", _map_path(map_id, "views"), {"views": list(views), "modes": list(modes)})
        rendered: list[dict[str, NDArray[Any]]] = answer["views"]
        return rendered

    def plan(self, map_id: str, **request: Any) -> dict[str, Any]:
        """Plan a certified motion; POST /v1/maps/{map_id}/plans defines the fields. A failed plan is an error."""
        return self._json("POST", _map_path(map_id, "plans"), request)

    def grasps(self, map_id: str, **request: Any) -> dict[str, Any]:
        """Rank grasps of an object; POST /v1/maps/{map_id}/grasps defines the fields. No grasp is an error."""
        return self._json("POST", _map_path(map_id, "grasps"), request)

    def pick(self, scene: str, target: str, *, key: str | None = None, **more: Any) -> dict[str, Any]:
        """Pick an object in the twin of a shipped scene; return the job for :meth:`wait` or :meth:`events`.

        Args:
            scene: name of the scene.
            target: name of an object in the scene, or a description in words.
            key: Idempotency-Key; a repeated request with the same key returns the same job.
            more: views, lift, force, tries, budget_ms, margin, home, look, attempts, seed.
        """
        return self._json("POST", "/v1/picks", {"scene": scene, "target": target, **more}, _idempotency(key))

    def cancel(self, job_id: str) -> dict[str, Any]:
        """Cancel a job and return its state."""
        return self._json("DELETE", f"/v1/jobs/{quote(job_id, safe='')}")

    def ik(self, pose: Mapping[str, Any], **more: Any) -> NDArray[np.float64]:
        """Solve the inverse kinematics; return configurations (K, J) that place the tool at a pose."""
        found: NDArray[np.float64] = self._packed("POST", "/v1/ik", {"pose": dict(pose), **more})["q"]
        return found

    def lease(self, arm: str = "fake", *, seconds: float = 5.0, preempt: bool = False) -> ArmLease:
        """Take the lease of an arm, which its motions need; the arm stops when the lease ends.

        Args:
            arm: name of the arm.
            seconds: time without a renewal after which the arm stops, 0.5 to 60 [s].
            preempt: take the lease from the owner of an arm at rest; during a motion this needs a key of an
                administrator.

        Returns:
            Context manager that renews the lease in the background and ends it on exit.
        """
        body = {"seconds": seconds, "preempt": preempt}
        taken = self._json("POST", f"/v1/arms/{quote(arm, safe='')}/lease", body)
        return ArmLease(self, arm, str(taken["lease"]), seconds)

    def emergency_stop(self) -> dict[str, Any]:
        """Stop every arm at once and refuse motions until :meth:`reset_stop`."""
        return self._json("POST", "/v1/stop")

    def reset_stop(self) -> dict[str, Any]:
        """End the emergency stop."""
        return self._json("DELETE", "/v1/stop")

    def stop(self, motion_id: str) -> dict[str, Any]:
        """Stop the motion of an arm."""
        return self._json("DELETE", f"/v1/trajectories/{quote(motion_id, safe='')}")

    def wait(self, job_id: str, *, under: str = "/v1/jobs", timeout_s: float = 600.0) -> dict[str, Any]:
        """Wait for a job and return it once it has ended.

        Raises:
            ServiceError: the job has not ended in time.
        """
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            job = self._json("GET", f"{under}/{quote(job_id, safe='')}")
            if job["state"] in _ENDED:
                return job
            time.sleep(0.05)
        raise ServiceError(f"job {job_id} has not ended within {timeout_s:g} s.")

    def events(self, path: str) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield name and data of each server-sent event of a path such as "/v1/jobs/ID/events"."""
        with self._http.stream("GET", path, headers={"Accept": "text/event-stream"}) as response:
            if response.status_code != 200:
                raise _refused(response.status_code, response.read())
            name, data = "message", ""
            for text in response.iter_lines():
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
        """Send a request and return body and headers of the answer; repeat it after the statuses 429 and 503.

        Raises:
            ServiceError: the service refused the request, or did not answer.
        """
        for attempt in range(self._retries + 1):
            try:
                response = self._http.request(method, path, content=body, headers=dict(headers or {}))
            except httpx.HTTPError as error:
                raise ServiceError(f"no answer ({error or type(error).__name__}).") from error
            if response.status_code < 400:
                return response.content, response.headers
            wait_s = response.headers.get("retry-after")
            if attempt == self._retries or response.status_code not in (429, 503) or wait_s is None:
                raise _refused(response.status_code, response.content)
            time.sleep(min(10.0, float(wait_s)))
        raise AssertionError("the last attempt returns or raises")

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

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


class ArmLease(AbstractContextManager["ArmLease"]):
    """Lease of an arm, renewed in a thread; see :meth:`Client.lease`.

    Attributes:
        id: its name, which motions need.
        lost: reason why the last renewal failed, empty while the lease holds.
    """

    def __init__(self, client: Client, arm: str, lease_id: str, seconds: float) -> None:
        self.id, self.lost = lease_id, ""
        self._client, self._arm = client, arm
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._renew, args=(seconds / 3.0,), daemon=True)
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self.release()

    def send(self, plan_id: str, *, key: str | None = None) -> dict[str, Any]:
        """Send a plan to the arm; return the motion for :meth:`Client.wait` with ``under="/v1/trajectories"``."""
        body = {"plan": plan_id, "arm": self._arm, "lease": self.id}
        return self._client._json("POST", "/v1/trajectories", body, _idempotency(key))

    def release(self) -> None:
        """End the lease; the arm stops if it moves."""
        self._ended.set()
        self._thread.join()
        self._client.request("DELETE", f"/v1/leases/{self.id}")

    def _renew(self, period: float) -> None:
        while not self._ended.wait(period):
            try:
                self._client.request("PUT", f"/v1/leases/{self.id}")
            except (ServiceError, RuntimeError) as error:  # RuntimeError: the client was closed
                self.lost = str(error)
                return


def _result(kind: type[_Result], answer: Mapping[str, Any]) -> _Result:
    """Build a result from those entries of an answer that have the names of its fields."""
    return kind(**{field.name: answer[field.name] for field in fields(kind)})


def _loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _known_joints(frame: Frame) -> tuple[list[float] | None, list[str], list[float] | None]:
    """Return joints, names and joints at the time of depth, without named joints that one of both times lacks."""
    if frame.joints is None or frame.depth_joints is None:
        return None if frame.joints is None else frame.joints.tolist(), list(frame.joint_names), None
    names, joints, later = list(frame.joint_names), frame.joints.tolist(), frame.depth_joints.tolist()
    if not names:
        return joints, names, later
    known = [k for k, values in enumerate(zip(joints, later, strict=True)) if np.isfinite(values).all()]
    return [joints[k] for k in known], [names[k] for k in known], [later[k] for k in known]


def _map_path(map_id: str, *rest: str) -> str:
    return "/".join(("/v1/maps", quote(map_id, safe=""), *rest))


def _idempotency(key: str | None) -> dict[str, str]:
    return {"Idempotency-Key": key} if key else {}


def _refused(status: int, data: bytes) -> ServiceError:
    try:
        problem = json.loads(data)
        return ServiceError(str(problem["detail"]), status=status, problem=problem)
    except (ValueError, KeyError, TypeError):
        return ServiceError(f"status {status}.", status=status)


def pack_array(value: Any) -> Any:
    """Convert an array to {dtype, shape, data} for msgpack, and a number of numpy to one of Python."""
    if isinstance(value, np.ndarray):
        return {"dtype": value.dtype.str, "shape": list(value.shape), "data": np.ascontiguousarray(value).tobytes()}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be sent")


def _unpack(value: dict[str, Any]) -> Any:
    if set(value) != {"dtype", "shape", "data"}:
        return value
    return np.frombuffer(value["data"], np.dtype(value["dtype"])).reshape(value["shape"]).copy()
