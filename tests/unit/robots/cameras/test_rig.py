"""Several live cameras as one: frames in the order of their stamps, whichever camera delivers first."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from splatbot.errors import DeviceError, LogError
from splatbot.frame import Frame
from splatbot.logs import open_log
from splatbot.logs.live import RecordedCamera
from splatbot.robots.cameras import CameraRig, open_camera
from tests.conftest import MakeLog

RIG = "cameras: {wrist: {log: 'oak://a'}, table: {log: 'oak://b', max_gap: 1}}"


class Given:
    """A camera that delivers its frames after a wait [s], and then may fail."""

    dropped = 0

    def __init__(self, uri: str, frames: list[Frame], wait: float = 0.0, failure: Exception | None = None) -> None:
        self.name = self.uri = uri
        self._frames, self._wait, self._failure, self._closed = frames, wait, failure, False

    def __iter__(self) -> Iterator[Frame]:
        for frame in self._frames:
            if self._closed:
                return
            time.sleep(self._wait)
            yield frame
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        self._closed = True


@pytest.fixture
def frames(make_log: MakeLog) -> list[Frame]:
    """Eight frames, 0.1 s apart."""
    return list(open_log(make_log(8, period=0.1)))


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Has frames wait for earlier ones of other cameras as long as a busy machine needs."""
    monkeypatch.setattr("splatbot.robots.cameras.rig._WAIT_S", 60.0)


def rig_of(tmp_path: Path, cameras: dict[str, Given], text: str = RIG) -> CameraRig:
    """Return a rig of the given cameras by their addresses."""
    (tmp_path / "rig.yaml").write_text(text)
    opener: Callable[[str], Given] = cameras.__getitem__
    return CameraRig(tmp_path / "rig.yaml", opener)


@pytest.mark.usefixtures("patient")
def test_frames_come_in_the_order_of_their_stamps_with_the_names_of_their_cameras(
    tmp_path: Path, frames: list[Frame]
) -> None:
    between = [replace(frame, stamp=frame.stamp + 0.05) for frame in frames]
    cameras = {"oak://a": Given("oak://a", frames, 0.01), "oak://b": Given("oak://b", between, 0.03)}
    rig = rig_of(tmp_path, cameras)
    seen = [(frame.stamp, frame.camera_name) for frame in rig]
    assert [stamp for stamp, _ in seen] == sorted(stamp for stamp, _ in seen)
    assert {name for _, name in seen} == {"", "table"}
    assert rig.dropped == 0
    assert rig.first_name == "wrist"


def test_a_frame_that_comes_after_a_later_one_is_left_out_and_counted(tmp_path: Path, frames: list[Frame]) -> None:
    slow = [frames[0], *(replace(frame, stamp=frame.stamp - 0.15) for frame in frames[2:4])]
    cameras = {"oak://a": Given("oak://a", frames, 0.05), "oak://b": Given("oak://b", slow, 0.5)}
    rig = rig_of(tmp_path, cameras)
    stamps = [frame.stamp for frame in rig]
    assert stamps == sorted(stamps)
    assert rig.dropped >= 1


def test_time_offsets_and_equal_stamps_keep_the_order_of_the_file(tmp_path: Path, frames: list[Frame]) -> None:
    text = "cameras: {wrist: {log: 'oak://a'}, table: {log: 'oak://b', time_offset: -128.0}}"
    first = [replace(frame, stamp=k / 8) for k, frame in enumerate(frames)]
    later = [replace(frame, stamp=frame.stamp + 128.0) for frame in first]
    rig = rig_of(tmp_path, {"oak://a": Given("oak://a", first), "oak://b": Given("oak://b", later)}, text)
    seen = [(frame.stamp, frame.camera_name) for frame in rig]
    assert seen == [(frame.stamp, name) for frame in first for name in ("", "table")]


@pytest.mark.usefixtures("patient")
def test_the_loss_of_one_camera_ends_all_after_the_frames_up_to_then(tmp_path: Path, frames: list[Frame]) -> None:
    lost = DeviceError("is gone.", file="oak://b", field="camera", hint="check its cable")
    cameras = {"oak://a": Given("oak://a", frames, 0.01), "oak://b": Given("oak://b", frames[:3], 0.01, lost)}
    rig = rig_of(tmp_path, cameras)
    seen: list[str] = []
    with pytest.raises(DeviceError, match="is gone"):
        seen.extend(frame.camera_name for frame in rig)
    assert seen.count("table") == 3


def test_a_camera_without_a_frame_is_named(tmp_path: Path, frames: list[Frame]) -> None:
    rig = rig_of(tmp_path, {"oak://a": Given("oak://a", frames), "oak://b": Given("oak://b", [])})
    with pytest.raises(DeviceError, match="no frame") as caught:
        next(iter(rig))
    assert caught.value.file == "oak://b"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cameras: {a: {log: 'oak://a'}, b: {log: desk}}", "no address of a camera"),
        ("cameras: {a: {log: 'oak://a'}, b: {log: 'oak://a'}}", "twice"),
        ("cameras: {a: {log: 'oak://a'}, b: {log: 'oak://b', camera: x.json}}", "is for recordings"),
        ("cameras: {a: {log: 'oak://a'}, b: {log: 'oak://b', time_offset: x}}", "time_offset"),
    ],
)
def test_mistakes_in_the_file_are_named(tmp_path: Path, frames: list[Frame], text: str, message: str) -> None:
    with pytest.raises(LogError, match=message):
        rig_of(tmp_path, {uri: Given(uri, frames) for uri in ("oak://a", "oak://b")}, text)


def test_a_recorded_rig_has_the_numbers_and_stamps_of_its_recording(tmp_path: Path, make_log: MakeLog) -> None:
    log = make_log(9, period=0.04)
    settings = "time_offset: 0.01, T_world_camera: {translation: [0.1, 0, 0], quaternion_wxyz: [1, 0, 0, 0]}"
    text = f"cameras: {{wrist: {{log: 'replay:{log}'}}, table: {{log: 'replay:{log}?speed=1', {settings}}}}}"
    (tmp_path / "rig.yaml").write_text(text)
    rig = CameraRig(tmp_path / "rig.yaml", open_camera)
    recorded = RecordedCamera(rig, tmp_path / "out.mcap", cameras=rig.cameras, first_name=rig.first_name)
    seen = [(number, frame.stamp, frame.camera_name) for number, frame in recorded.arrivals()]
    read = open_log(tmp_path / "out.yaml")
    assert recorded.uri == str(tmp_path / "out.yaml")
    assert dict(read.cameras) == dict(recorded.cameras) == dict(rig.cameras)
    assert len(read) == len(recorded) >= len(seen) > 0
    assert [number for number, _, _ in seen] == sorted({number for number, _, _ in seen})
    for number, stamp, name in seen:
        assert (read[number].stamp, read[number].camera_name) == (stamp, name)
