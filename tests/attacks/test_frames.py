"""One bad frame is one refused frame: the map goes on, and the service keeps its memory."""

from __future__ import annotations

import asyncio
import base64
import io
import json
import struct
import time
import zipfile
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import httpx
import msgpack
import numpy as np
import pytest

from splatbot.client import Client, ServiceError
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.logs import open_log
from splatbot.logs.ros_types import build
from splatbot.services.ros.subscribers import FramePairs
from splatbot.services.settings import ServiceSettings
from splatbot.slam import Slam
from tests.attacks.victim import Victim, victim
from tests.contracts.conftest import Service, running

MSGPACK = {"content-type": "application/msgpack"}
DESK = "synthetic:tabletop?frames=6&width=160&height=120"


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    log = open_log(DESK)
    return [log[i] for i in range(len(log))]


@pytest.fixture(scope="module")
def service() -> Iterator[Victim]:
    with victim() as it:
        it.client.post("/v1/maps", json={"id": "warm"})
        it.client.post("/v1/maps/warm/frames", content=msgpack.packb(body_of(open_log(DESK)[0])), headers=MSGPACK)
        yield it


@pytest.fixture
def stream(service: Victim) -> Iterator[str]:
    name = f"map-{time.monotonic_ns()}"
    assert service.client.post("/v1/maps", json={"id": name}).status_code == 201
    yield name
    service.client.delete(f"/v1/maps/{name}")


def packed(array: Any) -> dict[str, Any]:
    return {"dtype": array.dtype.str, "shape": list(array.shape), "data": array.tobytes()}


def body_of(frame: Frame, **more: Any) -> dict[str, Any]:
    camera = {name: getattr(frame.camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    return {"stamp": frame.stamp, "camera": camera, "rgb": packed(frame.rgb), "depth": packed(frame.depth)} | more


def push(service: Victim, name: str, body: dict[str, Any]) -> httpx.Response:
    return service.client.post(f"/v1/maps/{name}/frames", content=msgpack.packb(body), headers=MSGPACK)


BAD: dict[str, Any] = {
    "a stamp of 1e308": {"stamp": 1e308},
    "a stamp of the year 30,000": {"stamp": 9e11},
    "a negative stamp": {"stamp": -1.0},
    "the stamp of before": {"stamp": 0.0},
    "a stamp two days later": {"stamp": 2 * 86_400.0},
    "fx 1e300": {"camera": {"fx": 1e300}},
    "fx 1e-300": {"camera": {"fx": 1e-300}},
    "fy in metres": {"camera": {"fy": 0.004}},
    "a field of view of 0.1 degrees": {"camera": {"fx": 92_000.0}},
    "cx far outside": {"camera": {"cx": 1e9}},
    "cy far outside": {"camera": {"cy": -500.0}},
    "a size of 1e9 x 1e9": {"camera": {"width": 10**9, "height": 10**9}},
    "a size of 2^63": {"camera": {"width": 2**63}},
    "half of the image": {"camera": {"width": 80}},
    "a negative depth": {"depth": packed(np.full((120, 160), -1, np.float32))},
    "text as an image": {"rgb": b"GIF89a" + bytes(1000)},
    "joints that are not finite": {"joints": [float("nan")]},
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_frame_is_refused_alone(service: Victim, stream: str, frames: list[Frame], name: str) -> None:
    assert push(service, stream, body_of(frames[0])).json()["verdict"] == "ok"
    bad = body_of(frames[1])
    for key, value in BAD[name].items():
        bad[key] = bad[key] | value if isinstance(value, dict) and key == "camera" else value
    with service.attacked():
        answer = push(service, stream, bad)
    assert answer.status_code in (413, 422), answer.text
    assert answer.json()["detail"]
    after = push(service, stream, body_of(frames[2]))
    assert (after.status_code, after.json()["verdict"]) == (200, "ok")
    assert service.client.get(f"/v1/maps/{stream}").json()["state"] == "mapping"


@pytest.mark.parametrize("depth", [1e-30, 1e30, 3e38, float("inf"), float("nan")])
def test_a_frame_of_impossible_depth_ends_no_map(
    service: Victim, stream: str, frames: list[Frame], depth: float
) -> None:
    first = push(service, stream, body_of(frames[0], depth=packed(np.full((120, 160), depth, np.float32))))
    assert first.status_code == 200
    assert push(service, stream, body_of(frames[1])).status_code == 200
    third = push(service, stream, body_of(frames[2], depth=packed(np.full((120, 160), depth, np.float32))))
    assert third.status_code == 200
    assert push(service, stream, body_of(frames[3])).json()["verdict"] == "ok"


def test_an_error_inside_mapping_is_told_for_that_frame_and_the_map_goes_on(
    frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    track = Slam._track

    def broken(self: Slam, prepared: Any, hold_out: bool) -> Any:
        if prepared.frame.index == 1:
            raise RuntimeError("a secret of the machine")
        return track(self, prepared, hold_out)

    monkeypatch.setattr(Slam, "_track", broken)
    with running(ServiceSettings()) as service, Client(service.url) as client:
        service.client.post("/v1/maps", json={"id": "desk"})
        assert client.push("desk", frames[0]).verdict == "ok"
        with pytest.raises(ServiceError, match="cannot be mapped") as caught:
            client.push("desk", frames[1])
        assert (caught.value.status, "secret" in str(caught.value)) == (500, False)
        assert [client.push("desk", frame).verdict for frame in frames[2:]] == ["ok"] * 4
        client.end("desk")
        assert wait_until_ended(service) == "ended"
        assert len(service.client.get("/v1/maps/desk/trajectory").json()["stamps"]) == 5


def wait_until_ended(service: Service) -> str:
    for _ in range(600):
        if (state := service.store.get("desk").state) != "mapping":
            return state
        time.sleep(0.1)
    return "mapping"


def test_after_a_jump_of_the_clock_a_client_resynchronises(service: Victim, stream: str, frames: list[Frame]) -> None:
    at = [1e9, 1e9 + 0.1, 50.0, 50.1, 5e9, 5e9 + 0.1]
    stamps = []
    for number, (stamp, frame) in enumerate(zip(at, frames, strict=True)):
        answer = push(service, stream, body_of(frame, stamp=stamp))
        if number in (2, 4):
            assert (answer.status_code, "resync" in answer.json()["hint"]) == (422, True)
            assert service.client.post(f"/v1/maps/{stream}/resync").status_code == 204
            answer = push(service, stream, body_of(frame, stamp=stamp))
        assert answer.json()["verdict"] == "ok", answer.text
        stamps.append(answer.json()["stamp"])
    steps = np.diff(stamps)
    assert (steps > 0).all()
    np.testing.assert_allclose(steps[[0, 1, 2, 4]], 0.1, atol=1e-6)
    service.client.post(f"/v1/maps/{stream}/end")
    assert service.client.post(f"/v1/maps/{stream}/resync").status_code == 409


def tiff(width: int, height: int) -> bytes:
    """Build a small TIFF file that unpacks to an image of any size: strips of zeros, compressed."""
    ok, data = cv2.imencode(".tiff", np.zeros((height, width), np.uint16), [cv2.IMWRITE_TIFF_COMPRESSION, 5])
    assert ok
    return bytes(data)


def jpeg(width: int, height: int, before: int = 0) -> bytes:
    """Build a JPEG whose header declares a size, behind ``before`` bytes of other segments."""
    data = bytearray(cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", height, width)
    comment = b"".join(b"\xff\xfe\xff\xff" + bytes(0xFFFD) for _ in range(before // 0xFFFF + (before > 0)))
    return bytes(data[:2] + comment + data[2:])


def png(width: int, height: int) -> bytes:
    data = bytearray(cv2.imencode(".png", np.zeros((2, 2), np.uint16))[1].tobytes())
    data[16:24] = struct.pack(">II", width, height)
    return bytes(data)


PICTURES: dict[str, Callable[[], bytes]] = {
    "a TIFF of 9000 x 9000": lambda: tiff(9000, 9000),
    "a JPEG of 30,000 x 30,000": lambda: jpeg(30_000, 30_000),
    "a JPEG with its size behind 1 MB": lambda: jpeg(30_000, 30_000, 1 << 20),
    "a PNG of 30,000 x 30,000": lambda: png(30_000, 30_000),
    "a JPEG that never says": lambda: b"\xff\xd8\xff" + b"\xff" * 2_000_000,
    "a BMP": lambda: cv2.imencode(".bmp", np.zeros((4, 4, 3), np.uint8))[1].tobytes(),
}


@pytest.mark.parametrize("name", PICTURES)
def test_a_pushed_picture_is_judged_by_its_real_format_before_it_is_decoded(
    service: Victim, stream: str, frames: list[Frame], name: str
) -> None:
    picture = PICTURES[name]()
    with service.attacked():
        answers = [push(service, stream, body_of(frames[0]) | {key: picture}) for key in ("rgb", "depth")]
    assert all(answer.status_code in (413, 422) for answer in answers), [answer.text for answer in answers]


def recording(**more: bytes) -> bytes:
    frames = open_log("synthetic:tabletop?frames=2&width=64&height=48")
    camera = frames.camera
    about = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    files: dict[str, bytes] = {"intrinsics.json": json.dumps(about | {"depth_scale": 1000.0}).encode()}
    for kind in ("rgb", "depth"):
        files[f"{kind}.txt"] = b"".join(b"%d.0 %s/%d.png\n" % (i, kind.encode(), i) for i in range(2))
    for i in range(2):
        frame = frames[i]
        files[f"rgb/{i}.png"] = cv2.imencode(".png", frame.rgb)[1].tobytes()
        files[f"depth/{i}.png"] = cv2.imencode(".png", (1000 * frame.depth).astype(np.uint16))[1].tobytes()
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as pack:
        for name, data in (files | {key.replace("__", "/").replace("_", "."): v for key, v in more.items()}).items():
            pack.writestr(name, data)
    return out.getvalue()


def intrinsics(**values: float) -> bytes:
    camera = {"fx": 50.0, "fy": 50.0, "cx": 32.0, "cy": 24.0, "width": 64, "height": 48, "depth_scale": 1000.0}
    return json.dumps(camera | {"distortion": [0.1, 0, 0, 0]} | values).encode()


UPLOADS: dict[str, Callable[[], dict[str, bytes]]] = {  # built in their test: up to 100 MB each
    "a TIFF that is named PNG": lambda: {"rgb__1_png": tiff(9000, 9000)},
    "a JPEG with its size behind 1 MB": lambda: {"rgb__1_png": jpeg(30_000, 30_000, 1 << 20)},
    "a list of 8 million lines": lambda: {"rgb_txt": b"".join(b"%d a\n" % i for i in range(4_000_000))},
    "a list without ends of lines": lambda: {"rgb_txt": b"0 " + b"a" * 100_000_000},
    "intrinsics of 60,000 x 60,000": lambda: {
        "intrinsics_json": intrinsics(width=60_000, height=60_000, cx=3e4, cy=3e4)
    },
    "intrinsics of 1e300": lambda: {"intrinsics_json": intrinsics(fx=1e300)},
    "intrinsics of 20 MB of lists": lambda: {"intrinsics_json": b"[" + b"[]," * 7_000_000 + b"[]]"},
}


@pytest.mark.parametrize("name", UPLOADS)
def test_an_upload_is_checked_before_it_is_read(service: Victim, name: str) -> None:
    data = recording(**UPLOADS[name]())
    client = service.client
    map_id = f"up-{time.monotonic_ns()}"
    with service.attacked(seconds=15):
        answer = client.post(f"/v1/maps/{map_id}/upload", content=data, headers={"content-type": "application/zip"})
        assert answer.status_code == 202, answer.text
        url = f"/v1/jobs/{answer.json()['id']}"
        while (job := client.get(url).json())["state"] in ("queued", "running"):
            time.sleep(0.05)
    assert job["state"] == "failed", job
    assert job["detail"]
    client.delete(f"/v1/maps/{map_id}")


def test_a_good_upload_is_mapped(service: Victim) -> None:
    answer = service.client.post(
        "/v1/maps/good/upload", content=recording(), headers={"content-type": "application/zip"}
    )
    while (job := service.client.get(f"/v1/jobs/{answer.json()['id']}").json())["state"] in ("queued", "running"):
        time.sleep(0.05)
    assert job["state"] == "succeeded", job


def ros_info(width: int, height: int, distortion: list[float] | None = None, focal: float = 500.0) -> dict[str, Any]:
    k = [focal, 0, width / 2, 0, focal, height / 2, 0, 0, 1]
    return {"width": width, "height": height, "distortion_model": "plumb_bob", "d": distortion or [0.0] * 5, "k": k}


def encoded(data: bytes) -> dict[str, Any]:
    return {"format": "png", "data": base64.b64encode(data).decode()}


COLOR, INFO = "/camera/color/image_raw", "/camera/color/camera_info"
ROS = {
    "CameraInfo of 20,000 x 20,000": [(INFO, "sensor_msgs/msg/CameraInfo", ros_info(20_000, 20_000, [0.1] * 5))],
    "CameraInfo of fx 1e300": [(INFO, "sensor_msgs/msg/CameraInfo", ros_info(640, 480, focal=1e300))],
    "an image of one row and a step of 4e9": [
        (
            COLOR,
            "sensor_msgs/msg/Image",
            {"height": 1, "width": 1, "step": 4_000_000_000, "encoding": "rgb8", "data": [1, 2, 3]},
        )
    ],
    "an image of 2e9 x 2e9": [
        (COLOR, "sensor_msgs/msg/Image", {"height": 2**31, "width": 2**31, "encoding": "rgb8", "data": []})
    ],
}


@pytest.mark.parametrize("name", ROS)
def test_one_message_costs_little_memory(service: Victim, name: str) -> None:
    async def send() -> None:
        async with service.rosbridge() as socket:
            for topic, kind, message in ROS[name]:
                await socket.send(json.dumps({"op": "advertise", "topic": topic, "type": kind}))
                await socket.send(json.dumps({"op": "publish", "topic": topic, "msg": message}))
            await socket.send(json.dumps({"op": "call_service", "service": "/rosapi/topics", "id": "x"}))
            await asyncio.wait_for(socket.recv(), 20)
            await asyncio.sleep(0.5)

    with service.attacked():
        asyncio.run(send())


@pytest.mark.parametrize("name", PICTURES)
def test_a_compressed_image_of_ros_is_judged_before_it_is_decoded(name: str) -> None:
    pairs = FramePairs()
    message = build("sensor_msgs/msg/CompressedImage", format="png", data=PICTURES[name]())
    with pytest.raises(InputError, match=r"neither PNG nor JPEG|pixels"):
        pairs.add(COLOR, message)
