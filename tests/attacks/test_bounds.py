"""Requests that cost far more than they are: each is refused before the work, in little memory."""

from __future__ import annotations

import asyncio
import json
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from numpy.typing import NDArray
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode

from splatbot.errors import InputError
from splatbot.logs.index import associate
from splatbot.robots.store import robot_file
from splatbot.services.bounds import check_json, check_msgpack
from splatbot.services.codecs import decode_msgpack, decode_npy
from splatbot.services.problems import TooLargeError
from tests.attacks.victim import Victim, victim

SIZE = 16 * 2**20 - 100
JSON = {"content-type": "application/json"}
MSGPACK = {"content-type": "application/msgpack"}
NPY = {"content-type": "application/x-npy"}
CAMERA = {"fx": 500.0, "fy": 500.0, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480}


@pytest.fixture(scope="module")
def service() -> Iterator[Victim]:
    with victim() as it:
        it.client.get("/v1/maps/wall/render?width=64&height=48")  # everything is imported, the field is built
        it.client.post("/v1/maps/wall/distance", json={"points": [[0, 0, 1.0]]})
        yield it


def json_of(part: bytes, field: bytes = b"points") -> bytes:
    return b'{"' + field + b'": [' + part * ((SIZE - 20) // len(part)) + part.rstrip(b",") + b"]}"


def msgpack_of(part: bytes, field: bytes = b"points") -> bytes:
    count = (SIZE - 20) // len(part)
    return b"\x81" + msgpack.packb(field.decode()) + b"\xdd" + struct.pack(">I", count) + part * count


BODIES: dict[str, tuple[dict[str, str], Callable[[], bytes]]] = {  # 16 MiB each, built in their test
    "empty lists": (JSON, lambda: json_of(b"[],")),
    "empty objects": (JSON, lambda: json_of(b"{},")),
    "numbers": (JSON, lambda: json_of(b"1,")),
    "short texts": (JSON, lambda: json_of(b'"",')),
    "wrong rows": (JSON, lambda: json_of(b"[1],")),
    "deep": (JSON, lambda: b'{"points": ' + b"[" * (SIZE - 20)),
    "other fields": (JSON, lambda: b"{" + b",".join(b'"%d":0' % i for i in range(1_400_000)) + b"}"),
    "msgpack of empty lists": (MSGPACK, lambda: msgpack_of(b"\x90")),
    "msgpack of empty maps": (MSGPACK, lambda: msgpack_of(b"\x80")),
    "msgpack of numbers": (MSGPACK, lambda: msgpack_of(b"\x01")),
    "msgpack of long lists in each other": (MSGPACK, lambda: b"\xdd\x00\xff\xff\xff" * 1000 + bytes(SIZE - 5000)),
    "deep msgpack": (MSGPACK, lambda: b"\x91" * SIZE),
    "npy of bytes": (NPY, lambda: npy("|u1", (SIZE // 3, 3)) + bytes(SIZE // 3 * 3)),
}


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("route", ["maps/wall/distance", "maps/wall/plans", "maps/wall/render"])
def test_a_body_of_millions_of_values_is_refused_before_objects_are_made(
    service: Victim, route: str, name: str
) -> None:
    headers, build = BODIES[name]
    body = build()
    with service.attacked():
        answer = service.client.post(f"/v1/{route}", content=body, headers=headers)
    assert answer.status_code in (413, 415, 422), answer.text[:300]
    assert len(answer.content) < 5000


def test_as_many_wrong_rows_as_may_come_are_one_error(service: Victim) -> None:
    body = b'{"points": [' + b"[]," * 99_999 + b"[]]}"
    with service.attacked():
        answer = service.client.post("/v1/maps/wall/distance", content=body, headers=JSON)
    assert answer.status_code == 422


def test_as_many_points_as_may_come_are_answered_in_each_kind(service: Victim) -> None:
    points = np.full((100_000, 3), 0.123456)
    bodies = [
        (JSON, json.dumps({"points": points.tolist()}).encode()),
        (MSGPACK, msgpack.packb({"points": points.tolist()})),
    ]
    for headers, body in bodies:
        answer = service.client.post(
            "/v1/maps/wall/distance", content=body, headers=headers | {"accept": "application/x-npy"}
        )
        assert answer.status_code == 200, answer.text


@pytest.mark.parametrize("data", ['{"a": "[[[[,,,,{{{"}', '{"a": "\\\\"}', '{"a\\"[": [1, "\\\\\\"]"]}', "[]", "3", ""])
def test_only_structure_counts_in_json(data: str) -> None:
    check_json(data.encode(), 10)


@pytest.mark.parametrize("seed", range(20))
def test_the_scans_count_as_the_parsers_do(seed: int) -> None:
    rng = np.random.default_rng(seed)
    document = tree(rng, 4)
    for count, check, data in (
        (json_count(document), check_json, json.dumps(document).encode()),
        (msgpack_count(document), check_msgpack, msgpack.packb(document)),
    ):
        check(data, count)
        with pytest.raises(TooLargeError):
            check(data, count - 1)


def test_a_long_document_is_counted_across_its_chunks() -> None:
    document = ['a"\\[{,' * 7, [1, 2, {"x": "]"}]] * 40_000
    data = json.dumps(document).encode()
    assert len(data) > 2**21
    check_json(data, json_count(document))
    with pytest.raises(TooLargeError):
        check_json(data, json_count(document) - 1)


def tree(rng: Any, depth: int) -> Any:
    kind = rng.integers(0, 6) if depth < 4 else 4
    if kind == 0 or depth == 0:
        return rng.choice(['"', "\\", '\\"[', "{,}", "x" * 300, "é" * 40, ""])
    if kind == 1:
        return float(rng.normal())
    if kind == 2:
        return int(rng.choice([0, -1, 200, -200, 70_000, -70_000, 2**40, -(2**40)]))
    if kind == 3:
        return [None, True, False][rng.integers(3)]
    count = int(rng.integers(1, 30))
    parts = [tree(rng, depth - 1) for _ in range(count)]
    return parts if kind == 4 else {f"k{i}": part for i, part in enumerate(parts)}


def json_count(value: Any) -> int:
    if isinstance(value, list | dict):
        parts = list(value.values()) if isinstance(value, dict) else value
        return 4 + len(parts) - 1 + sum(map(json_count, parts))
    return 0


def msgpack_count(value: Any) -> int:
    if isinstance(value, dict):
        return 4 + 2 * len(value) + sum(map(msgpack_count, value.values()))
    return 4 + len(value) + sum(map(msgpack_count, value)) if isinstance(value, list) else 0


def npy(dtype: str, shape: Any) -> bytes:
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


@pytest.mark.parametrize("shape", ["(0, 10**30)", f"(0, {10**30})", "(True, 3)", "(0, 1099511627776)", "(-1, 3)"])
def test_a_shape_that_no_array_has_is_refused(service: Victim, shape: str) -> None:
    body = npy("<f8", shape) + (bytes(24) if "True" in shape else b"")
    with pytest.raises(InputError):
        decode_npy(body)
    assert service.client.post("/v1/maps/wall/distance", content=body, headers=NPY).status_code == 422


@pytest.mark.parametrize(
    ("dtype", "shape", "data"),
    [
        ("<f8", [True, 3], bytes(24)),
        ("<f8", [0, 2**40], b""),
        ("<f8", [0, 2**63], b""),
        ("<f8", [0] + [2**31] * 3, b""),
        ("<f4," * 1000, [1], bytes(4000)),
        ("(1000000000,)f4", [0], b""),
    ],
)
def test_a_packed_array_that_cannot_be_is_refused(service: Victim, dtype: str, shape: Any, data: bytes) -> None:
    body = msgpack.packb({"points": {"dtype": dtype, "shape": shape, "data": data}})
    with pytest.raises(InputError):
        decode_msgpack(body)
    assert service.client.post("/v1/maps/wall/distance", content=body, headers=MSGPACK).status_code == 422


MESSAGES = {
    "empty lists": '{"op": "publish", "topic": "/x", "msg": {"a": [' + "[]," * (SIZE // 3 - 50) + "[]]}}",
    "texts": '{"op": "publish", "topic": "/x", "msg": {"a": [' + '"",' * (SIZE // 3 - 50) + '""]}}',
    "objects": '{"op": "publish", "topic": "/x", "msg": {"a": [' + "{}," * (SIZE // 3 - 50) + "{}]}}",
    "deep": '{"op": "publish", "topic": "/x", "msg": ' + "[" * 8_000_000,
    "messages": '{"op": "publish", "topic": "/markers", "msg": {"markers": [' + "{}," * 190_000 + "{}]}}",
}


@pytest.mark.parametrize("name", MESSAGES)
def test_a_message_of_millions_of_values_is_refused_before_objects_are_made(service: Victim, name: str) -> None:
    async def ask() -> str:
        async with service.rosbridge() as socket:
            advertise = {"op": "advertise", "topic": "/markers", "type": "visualization_msgs/msg/MarkerArray"}
            await socket.send(json.dumps(advertise))
            await socket.send(MESSAGES[name])
            return str(await asyncio.wait_for(socket.recv(), 20))

    with service.attacked():
        answer = json.loads(asyncio.run(ask()))
    assert (answer["op"], answer["level"]) == ("status", "error")
    assert "Fix:" in answer["msg"], answer


def test_a_message_that_is_too_long_ends_its_connection_before_it_is_read(service: Victim) -> None:
    async def closed() -> int | None:
        async with service.rosbridge() as socket:
            with suppress(ConnectionClosed):  # while it still sends
                await socket.send("[]," * 8_000_000)
            await asyncio.wait_for(socket.wait_closed(), 20)
            return socket.close_code

    with service.attacked(memory=20):
        code = asyncio.run(closed())
    assert code == CloseCode.MESSAGE_TOO_BIG


def test_a_socket_inflates_no_message_that_a_client_compressed(service: Victim) -> None:
    async def extensions() -> list[str]:
        async with service.rosbridge() as socket:  # offers permessage-deflate, as browsers do
            return [extension.name for extension in socket.protocol.extensions]

    assert asyncio.run(extensions()) == []


SIDES = [(2_100_000, 1), (1, 2_100_000), (100_000, 21), (10**9, 10**9)]


@pytest.mark.parametrize(("width", "height"), SIDES)
def test_a_view_that_cannot_be_drawn_is_refused(service: Victim, width: int, height: int) -> None:
    camera = CAMERA | {"width": width, "height": height}
    view = {"camera": camera, "pose": {"translation": [0, 0, -1]}}
    with service.attacked():
        answers = [
            service.client.get(f"/v1/maps/wall/render?width={width}&height={height}"),
            service.client.post("/v1/maps/wall/render", json={"camera": camera}),
            service.client.post("/v1/maps/wall/views", json={"views": [view]}),
        ]
    assert [answer.status_code for answer in answers] == [413] * 3, [answer.text for answer in answers]
    assert "pixels" in answers[0].json()["detail"]


@pytest.mark.parametrize("focal", [1e300, 1e-300, 1e9, 1e-9])
def test_a_view_of_an_impossible_camera_is_answered_or_refused(service: Victim, focal: float) -> None:
    camera = CAMERA | {"fx": focal, "fy": focal}
    with service.attacked():
        answers = [
            service.client.post("/v1/maps/wall/render", json={"camera": camera}),
            service.client.post(
                "/v1/maps/wall/views",
                json={"views": [{"camera": camera, "pose": {"translation": [0, 0, -1]}}], "modes": ["depth", "normal"]},
            ),
        ]
    assert all(answer.status_code in (200, 422) for answer in answers), [answer.text for answer in answers]


def test_points_of_a_trajectory_are_bounded_by_its_duration_and_rate(service: Victim) -> None:
    goal = [0.3, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]
    body = {"goal": goal, "base": {"translation": [5.0, 0, 0]}, "speed": 0.005, "rate": 1000}
    with service.attacked():
        answer = service.client.post("/v1/maps/wall/plans", json=body)
    assert answer.status_code == 413, answer.text
    assert "10000 points" in answer.json()["detail"]
    assert service.client.post("/v1/maps/wall/plans", json=body | {"rate": None, "speed": 1}).status_code == 200


@pytest.mark.parametrize("speed", [2e-3, 1e-4, 1e-6, 1e-12, 1e-300])
def test_a_motion_without_end_is_refused_before_its_points_are_made(service: Victim, speed: float) -> None:
    body = {"goal": [1.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785], "base": {"translation": [5.0, 0, 0]}, "speed": speed}
    with service.attacked():
        answer = service.client.post("/v1/maps/wall/plans", json=body)
    assert answer.status_code in (413, 422), answer.text


SYNTHETIC = [
    "width=4096&height=4096",
    "frames=100001",
    "frames=1000000000",
    "width=1000000",
    "effects=" + "a;" * 100_000,
]


@pytest.mark.parametrize("query", SYNTHETIC)
def test_synthetic_frames_are_bounded_before_the_scene_is_built(service: Victim, query: str) -> None:
    with service.attacked():
        answer = service.client.post("/v1/maps", json={"id": "big", "log": f"synthetic:tabletop?{query}"})
    assert answer.status_code in (413, 422), answer.text


BOXES = [
    {"use_aabb": True, "aabb_size_m": {"x": 1e9, "y": 1e9, "z": 1e9}},
    {"use_aabb": True, "aabb_size_m": {"x": 1e300, "y": 1e300, "z": 1e300}},
    {"use_aabb": True, "aabb_size_m": {"x": 1e12, "y": 1e-12, "z": 1e-12}},
    {"use_aabb": True, "aabb_size_m": {"x": 1e9, "y": 0, "z": 1}},
    {"use_aabb": True, "aabb_size_m": {"x": -1e9, "y": -1e9, "z": 1}},
    {"voxel_size_m": 1e-12},
    {"voxel_size_m": 1e-300},
    {"voxel_size_m": -1},
]


@pytest.mark.parametrize("box", BOXES, ids=str)
def test_voxels_of_a_distance_field_are_bounded_before_they_are_made(service: Victim, box: Any) -> None:
    call = {"op": "call_service", "id": "e", "service": "/nvblox_node/get_esdf_and_gradient", "args": box}

    async def ask() -> Any:
        async with service.rosbridge() as socket:
            await socket.send(json.dumps(call))
            return json.loads(await asyncio.wait_for(socket.recv(), 20))

    with service.attacked():
        answer = asyncio.run(ask())
    assert not answer["result"]
    assert "Fix:" in answer["values"]


def test_pairing_of_stamps_is_not_quadratic() -> None:
    a: NDArray[np.float64] = np.arange(50_000, dtype=np.float64) * 1e-8
    b: NDArray[np.float64] = np.asarray(a + 0.3e-8, np.float64)
    begin = time.monotonic()
    pairs = associate(a, b, 0.02)
    assert time.monotonic() - begin < 10
    assert pairs == [(i, i) for i in range(50_000)]


@pytest.mark.parametrize(
    "name", ["../../evil", "/tmp/evil", "a/b", "..", ".hidden", "a" * 300, "panda", "new\nline", ""]
)
def test_the_name_of_a_robot_leads_nowhere(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "data" / "robots"
    monkeypatch.setenv("SPLATBOT_ROBOTS", str(folder))
    with pytest.raises(InputError, match="name"):
        robot_file(name)
    assert robot_file("ur5_e-2.1") == folder / "ur5_e-2.1.json"
