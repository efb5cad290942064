"""Motions that must not be executed: each attack as it was found, over the interface that let it through."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from splatbot.client import Client, ServiceError
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.geometry import pose_from_quat
from splatbot.robots.panda import panda
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore
from splatbot.workspace import Workspace
from tests.contracts.conftest import Service, running
from tests.waiting import until

HOME = np.asarray(panda().home)
TURN = np.eye(7)[0]
BASE = pose_from_quat((0, 0, 0), (1, 0, 0, 0))
PERIOD_S = 0.005
"""Control period of the arm [s]; a stop acts within one, and the arm rests after the next."""


def ball(at: Any, version: int = 1, radius: float = 0.05) -> Snapshot:
    model = GaussianModel.from_activated(
        means=[at], quats=[[1.0, 0, 0, 0]], scales=[[radius / 3] * 3], opacities=[0.9], colors=[[1.0, 0, 0]]
    )
    return Snapshot(model, version)


def hand_at(q: Any) -> Any:
    return panda().tcp(np.asarray(q))[:3, 3]


@pytest.fixture
def arms() -> Iterator[Service]:
    store = MapStore()
    workspace = Workspace(T_world_base=BASE)
    store.add("default", source="ball", state="mapping", snapshot=ball((3.0, 0, 0)), workspace=workspace)
    with running(ServiceSettings(), store) as service:
        yield service


@pytest.fixture
def client(arms: Service) -> Iterator[Client]:
    with Client(arms.url) as client:
        yield client


def position(service: Service) -> Any:
    return np.array(service.client.get("/v1/arms/fake").json()["position"])


def moved_for(service: Service) -> float:
    """Return how long the arm has moved [s], counted in its control periods: a busy machine takes longer for them."""
    feedback = service.runtime.arms.get("fake").feedback
    return 0.0 if feedback is None else feedback.time


def plan(client: Client, turn: float = 0.5, **more: Any) -> str:
    return str(client.plan("default", start=list(HOME), goal=list(HOME + turn * TURN), **more)["id"])


def test_a_plan_for_a_base_100_m_away_is_refused(arms: Service, client: Client) -> None:
    far = plan(client, base={"translation": [100.0, 0.0, 0.0]})
    with client.lease() as lease, pytest.raises(ServiceError, match="another base") as caught:
        lease.send(far)
    assert caught.value.status == 409
    np.testing.assert_array_equal(position(arms), HOME)


def test_a_plan_of_a_deleted_map_is_refused_although_another_has_its_name(arms: Service, client: Client) -> None:
    made = plan(client)
    client.delete_map("default")
    with client.lease() as lease:
        with pytest.raises(ServiceError, match="no longer exists"):
            lease.send(made)
        workspace = Workspace(T_world_base=BASE)
        arms.store.add("default", source="ball", state="static", snapshot=ball((3.0, 0, 0)), workspace=workspace)
        with pytest.raises(ServiceError, match="earlier map"):
            lease.send(made)
    np.testing.assert_array_equal(position(arms), HOME)


def test_a_plan_that_is_no_longer_free_in_the_map_of_now_is_refused(arms: Service, client: Client) -> None:
    made = plan(client)
    arms.store.publish("default", ball(hand_at(HOME + 0.3 * TURN), 2))
    with client.lease() as lease, pytest.raises(ServiceError, match="not certified as free"):
        lease.send(made)
    np.testing.assert_array_equal(position(arms), HOME)


def test_a_motion_stops_when_the_map_grows_into_it(arms: Service, client: Client) -> None:
    made = plan(client, 1.5, speed=0.1)
    with client.lease() as lease:
        motion = lease.send(made)
        until(lambda: moved_for(arms) > 0.5)
        arms.store.publish("default", ball(hand_at(HOME + 1.2 * TURN), 2))
        ended = client.wait(motion["id"], under="/v1/trajectories")
    assert ended["state"] == "failed"
    assert "not certified as free" in ended["detail"]
    assert position(arms)[0] < HOME[0] + 0.8


def test_a_motion_goes_on_when_the_map_grows_elsewhere(arms: Service, client: Client) -> None:
    made = plan(client, 0.3)
    with client.lease() as lease:
        motion = lease.send(made)
        for version in range(2, 8):
            arms.store.publish("default", ball((3.0, 0.1 * version, 0), version))
            time.sleep(0.02)
        assert client.wait(motion["id"], under="/v1/trajectories")["state"] == "succeeded"


def test_a_motion_stops_when_its_map_is_deleted(arms: Service, client: Client) -> None:
    made = plan(client, 1.5, speed=0.1)
    with client.lease() as lease:
        motion = lease.send(made)
        client.delete_map("default")
        ended = client.wait(motion["id"], under="/v1/trajectories")
    assert (ended["state"], "no longer exists" in ended["detail"]) == ("failed", True)


def test_an_arm_without_a_lease_of_the_client_does_not_move(arms: Service, client: Client) -> None:
    made = plan(client)
    body = {"plan": made, "arm": "fake"}
    assert arms.client.post("/v1/trajectories", json=body).status_code == 422
    stolen = arms.client.post("/v1/trajectories", json=body | {"lease": "0" * 32})
    assert (stolen.status_code, "lease" in stolen.json()["detail"]) == (409, True)
    with client.lease() as lease:
        with pytest.raises(ServiceError, match="another client"):
            client.lease()
        with pytest.raises(ServiceError, match="of arm fake"):
            client._json("POST", "/v1/trajectories", body | {"arm": "twin", "lease": lease.id})
    np.testing.assert_array_equal(position(arms), HOME)


def test_the_arm_stops_when_its_owner_is_gone(arms: Service, client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    passed = [0.0]  # [s] of the clock of leases, beyond that of the machine
    clock = SimpleNamespace(monotonic=lambda: time.monotonic() + passed[0])
    monkeypatch.setattr("splatbot.services.leases.time", clock)
    made = plan(client, 1.5, speed=0.05)
    lease = client.lease(seconds=30)
    motion = lease.send(made)
    until(lambda: moved_for(arms) > 0.0)
    lease._ended.set()  # the client dies: nothing renews its lease
    passed[0] = 31.0
    begin = moved_for(arms)
    ended = client.wait(motion["id"], under="/v1/trajectories")
    assert moved_for(arms) - begin <= 3 * PERIOD_S
    assert (ended["state"], "owner is gone" in ended["detail"]) == ("failed", True)


def test_an_emergency_stop_acts_at_once_and_lasts_until_it_is_reset(arms: Service, client: Client) -> None:
    made = plan(client, 1.5, speed=0.05)
    with client.lease() as lease:
        motion = lease.send(made)
        until(lambda: moved_for(arms) > 0.2)
        with Client(arms.url) as other:
            assert other.emergency_stop()["stopped"]
        begin = moved_for(arms)
        ended = client.wait(motion["id"], under="/v1/trajectories")
        assert moved_for(arms) - begin <= 3 * PERIOD_S
        assert (ended["state"], "emergency stop" in ended["detail"]) == ("failed", True)
        again = str(client.plan("default", start=list(position(arms)), goal=list(HOME))["id"])
        with pytest.raises(ServiceError, match="emergency stop"):
            lease.send(again)
        client.reset_stop()
        assert client.wait(lease.send(again)["id"], under="/v1/trajectories")["state"] == "succeeded"


def test_an_emergency_stop_acts_although_it_is_reset_before_the_next_period(arms: Service, client: Client) -> None:
    made = plan(client, 1.5, speed=0.05)
    with client.lease() as lease:
        motion = lease.send(made)
        arms.runtime.arms.stop_all("a client")
        arms.runtime.arms.reset()
        ended = client.wait(motion["id"], under="/v1/trajectories")
    assert (ended["state"], "emergency stop" in ended["detail"]) == ("failed", True)


def test_of_many_clients_that_want_one_arm_at_once_one_gets_it(arms: Service) -> None:
    taken: list[str] = []
    barrier = threading.Barrier(8)

    def take() -> None:
        with Client(arms.url) as client:
            barrier.wait()
            with contextlib.suppress(ServiceError):
                taken.append(client.lease(seconds=30).id)

    threads = [threading.Thread(target=take) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(taken) == 1
