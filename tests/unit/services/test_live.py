"""A log that is mapped while it is served."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import pytest
import torch

from splatbot.camera import Camera
from splatbot.config import Config
from splatbot.errors import LogError
from splatbot.frame import Frame
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.mapping.further_camera import FreeCamera, FurtherCamera
from splatbot.services.live import LiveMapping
from splatbot.services.store import MapStore
from splatbot.services.topics import FRAME, RESULT, STATE, TRAJECTORY, map_topic
from splatbot.slam import FrameResult
from splatbot.trajectory import Trajectory

CAMERA = Camera(10, 10, 1.5, 1.5, 4, 4)


class _Log:
    """Ten frames; reading ``broken`` raises ``error``."""

    name = uri = "ten frames"
    camera = CAMERA
    ground_truth = None
    effects: ClassVar[list[dict[str, Any]]] = []

    def __init__(self, broken: int | None = None, error: Exception | None = None) -> None:
        self.broken, self.error = broken, error
        self.names: dict[int, str] = {}
        self.hold = threading.Event()
        self.hold.set()

    def __len__(self) -> int:
        return 10

    def __iter__(self) -> Iterator[Frame]:
        return (self.read(i) for i in range(10))

    def __getitem__(self, index: int) -> Frame:
        return self.read(index)

    def read(self, index: int) -> Frame:
        self.hold.wait(5)
        if index == self.broken and self.error is not None:
            raise self.error
        rgb, depth = np.zeros((4, 4, 3), np.uint8), np.ones((4, 4), np.float32)
        return Frame(float(index), rgb, depth, CAMERA, index=index, camera_name=self.names.get(index, ""))


class _Mapper:
    """Adds one Gaussian per even frame, which is a keyframe."""

    def __init__(self, *lost: int) -> None:
        self.lost = lost
        self.frames = 0
        self.keyframes = 0
        self.finished = False
        self.closed = False

    def process(self, frame: Frame) -> FrameResult:
        keyframe = self.frames % 2 == 0
        self.frames += 1
        self.keyframes += keyframe
        result = FrameResult(
            frame.index, frame.stamp, np.eye(4), "ok", keyframe=keyframe, camera_name=frame.camera_name
        )
        if frame.index in self.lost:
            return replace(result, T_world_camera=None, verdict="lost", reasons=("it is dark",))
        return result

    def finish(self) -> None:
        self.finished = True

    def close(self) -> None:
        self.closed = True

    @property
    def further_cameras(self) -> dict[str, FurtherCamera]:
        return {"table": FreeCamera(Config())}

    @property
    def trajectory(self) -> Trajectory:
        return Trajectory(np.arange(self.frames, dtype=np.float64), np.tile(np.eye(4), (self.frames, 1, 1)))

    def snapshot(self) -> Snapshot:
        model = GaussianModel.empty()
        version = self.keyframes + self.finished
        ints = torch.zeros(version, dtype=torch.int32)
        z = torch.zeros
        quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(version, 1)
        model = GaussianModel(z(version, 3), quats, z(version, 3), z(version), z(version, 1, 3), ints, ints)
        return Snapshot(model, version)


def _follow(log: _Log, mapper: _Mapper | None = None) -> tuple[MapStore, LiveMapping]:
    store = MapStore()
    served = store.add("live", source=log.name, state="mapping")
    mapping = LiveMapping(store, served, log, mapper or _Mapper())
    mapping.start()
    return store, mapping


def test_the_map_grows_with_each_keyframe_and_stays_after_the_log_ends() -> None:
    store, mapping = _follow(_Log())
    assert mapping.wait(10)
    served = store.get("live")
    assert (served.state, served.map_version, len(served.ready.model)) == ("ended", 6, 6)


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (LogError("is cut off.", file="/srv/logs/rgb/5.png", field="rgb"), "is cut off."),
        (RuntimeError("a secret of the machine"), "unexpected error; the service's log says more"),
    ],
)
def test_a_log_that_breaks_leaves_what_was_mapped_and_says_why(error: Exception, told: str) -> None:
    store, mapping = _follow(_Log(broken=5, error=error))
    assert mapping.wait(10)
    served = store.get("live")
    assert (served.state, served.detail, served.map_version) == ("failed", told, 3)
    assert len(served.ready.model) == 3


@pytest.mark.parametrize("error", [None, LogError("is cut off."), RuntimeError("a bug")])
def test_the_mapper_s_own_thread_is_ended_however_the_log_ends(error: Exception | None) -> None:
    mapper = _Mapper()
    _, mapping = _follow(_Log(broken=5, error=error), mapper)
    assert mapping.wait(10)
    assert mapper.closed


def test_stopping_ends_after_the_frame_in_work() -> None:
    log = _Log()
    log.hold.clear()
    store, mapping = _follow(log)
    mapping.stop(timeout_s=0.0)  # while it waits for the first frame
    log.hold.set()
    mapping.stop(timeout_s=10)
    assert mapping.wait(0)
    assert store.get("live").map_version <= 1


def test_the_bus_is_told_of_every_frame_result_state_and_trajectory() -> None:
    log = _Log()
    log.hold.clear()
    store, mapping = _follow(log)
    with store.bus.subscribe(map_topic("live", "*"), capacity=1000, latched=False) as reader:
        log.hold.set()
        assert mapping.wait(10)
        messages = []
        while (message := reader.get(0)) is not None:
            messages.append(message)
    by_kind = {kind: [m.value for m in messages if m.topic == map_topic("live", kind)] for kind in (FRAME, RESULT)}
    assert [f.index for f in by_kind[FRAME]] == [r.index for r in by_kind[RESULT]] == list(range(10))
    versions = [m.value.map_version for m in messages if m.topic == map_topic("live", STATE)]
    assert versions == [1, 2, 3, 4, 5, 6, 6]
    assert len([m for m in messages if m.topic == map_topic("live", TRAJECTORY)][-1].value.stamps) == 10


def test_frames_of_a_further_camera_have_topics_of_their_own_and_are_counted_by_camera() -> None:
    log = _Log()
    log.names = {3: "table", 4: "table", 8: "table"}
    log.hold.clear()
    store, mapping = _follow(log, _Mapper(3, 8))
    assert store.get("live").cameras.by_name["table"] == {
        "kind": "free", "frames": 0, "tracked": 0, "lost": 0, "keyframes": 0, "reason": None, "pose": None,
    }  # fmt: skip
    with store.bus.subscribe("maps/*", capacity=1000, latched=False) as reader:
        log.hold.set()
        assert mapping.wait(10)
        topics: dict[str, list[int]] = {}
        while (message := reader.get(0)) is not None:
            if message.topic.endswith(("frame", "result")):
                topics.setdefault(message.topic, []).append(message.value.index)
    own = [0, 1, 2, 5, 6, 7, 9]
    assert topics == {
        "maps/live/frame": own,
        "maps/live/result": own,
        "maps/live/cameras/table/frame": [3, 4, 8],
        "maps/live/cameras/table/result": [3, 4, 8],
    }
    now = store.get("live").cameras.by_name["table"]
    assert (now["frames"], now["tracked"], now["lost"], now["keyframes"]) == (3, 1, 2, 2)
    assert now["reason"] == "it is dark"


def test_a_map_that_is_deleted_while_it_is_mapped_ends_its_mapping() -> None:
    log = _Log()
    log.hold.clear()
    store, mapping = _follow(log)
    store.remove("live")
    log.hold.set()
    assert mapping.wait(10)
    assert store.list() == ()
