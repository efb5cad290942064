"""A camera with all faults at once is mapped to its end; its map is that of the camera without faults."""

from __future__ import annotations

import time

import numpy as np
import pytest

from splatbot.logs import Log, open_log
from splatbot.robots.cameras.replay import ReplayCamera, ReplayOptions
from splatbot.services.settings import ServiceSettings
from splatbot.services.topics import RESULT, map_topic
from splatbot.slam import FrameResult, Slam
from tests.contracts.conftest import Service, running

LOG = "synthetic:tabletop?frames=100&width=160&height=120"


@pytest.fixture(scope="module")
def log() -> Log:
    return open_log(LOG)


def follow(service: Service, camera: ReplayCamera) -> tuple[list[FrameResult], list[str]]:
    """Map a camera to its end; return the results, and the details of the map's state on the way."""
    results, details = list[FrameResult](), list[str]()
    with service.store.bus.subscribe(map_topic("camera", RESULT), capacity=1000) as news:
        served = service.store.add("camera", source="camera", state="mapping", awaited=False)
        service.runtime.follow(served, camera, Slam(service.runtime.config))
        deadline = time.monotonic() + 120
        while (told := service.client.get("/v1/maps/camera").json())["state"] == "mapping":
            assert time.monotonic() < deadline
            if told["detail"] and told["detail"] not in details:
                details.append(told["detail"])
            time.sleep(0.02)
        details.append(told["state"])
        while (message := news.get(0.0)) is not None:
            results.append(message.value)
    return results, details


def errors(results: list[FrameResult], log: Log) -> np.ndarray:
    """Return the position errors (N,) [m] of the tracked frames, whose frames are known by their colour stamps."""
    truth = log.ground_truth
    assert truth is not None
    first = np.linalg.inv(truth.T_world_camera[0])
    tracked = [(r.index, r.T_world_camera) for r in results if r.T_world_camera is not None]
    return np.array([np.linalg.norm((first @ truth.T_world_camera[k])[:3, 3] - T[:3, 3]) for k, T in tracked])


@pytest.mark.long
def test_drops_noise_a_stall_and_an_unplugged_device_cost_only_their_frames(log: Log) -> None:
    options = ReplayOptions(
        drop=0.05, corrupt=0.035, stall=30, stall_s=2.0, unplug=60, replug_s=1.5, fault_seed=7, speed=0.5
    )
    camera = ReplayCamera(log, options)
    with running(ServiceSettings(port=0)) as service:
        results, details = follow(service, camera)
    assert camera.corrupted == 3
    assert 2 <= camera.lost <= 8
    # Each frame is mapped, lost by the device, dropped by a slow reader, or the one at which the device was gone.
    assert len(results) == 100 - camera.lost - camera.dropped - 1
    assert details == ["The camera is gone. It is opened again for 60 s.", "ended"]
    assert sum(r.index > 60 for r in results) > 25  # mapping went on afterwards
    known = errors([r for r in results if r.verdict != "lost"], log)
    assert len(known) >= len(results) - camera.corrupted - 2
    assert np.median(known) < 0.01
    assert known[-1] < 0.02


def test_a_device_that_stays_away_ends_the_map_which_is_still_served(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splatbot.robots.cameras.replay._QUEUE", 20)  # none is lost, however slow the machine is
    with running(ServiceSettings(port=0, camera_wait_s=0.6)) as service:
        results, details = follow(service, ReplayCamera(log, ReplayOptions(unplug=20, speed=10)))
        assert details[-1] == "failed"
        assert len(results) == 20
        assert service.client.get("/v1/maps/camera").json()["gaussians"] > 500
