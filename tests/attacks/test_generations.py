"""Writers of a deleted map: an old recording must not fill a new map of the same name."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from splatbot.errors import MapNotFoundError
from splatbot.services.runtime import Runtime
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore
from tests.contracts.conftest import Service, running, wall
from tests.waiting import until

LONG = "synthetic:tabletop?frames=400&width=160&height=120"


@pytest.fixture
def kept(tmp_path: Path) -> Iterator[Service]:
    with running(ServiceSettings(data_dir=tmp_path / "maps", save_every_s=0.05)) as service:
        yield service


def test_an_old_recording_never_fills_a_new_map_of_the_same_name(kept: Service) -> None:
    client = kept.client
    for _ in range(3):
        job = client.post("/v1/maps", json={"id": "desk", "log": LONG}).json()["id"]
        until(lambda: client.get("/v1/maps/desk").json()["map_version"] > 0)
        assert client.delete("/v1/maps/desk").status_code == 204
        assert client.get(f"/v1/jobs/{job}").json()["state"] == "cancelled", "DELETE awaits the job"
        assert client.post("/v1/maps", json={"id": "desk"}).status_code == 201
        time.sleep(0.5)
        described = client.get("/v1/maps/desk").json()
        assert (described["map_version"], described["state"], described["gaussians"]) == (0, "mapping", 0)
        assert client.delete("/v1/maps/desk").status_code == 204
    assert not (kept.runtime.settings.data_dir / "desk").exists()  # type: ignore[operator]


def test_a_job_that_has_waited_while_its_map_was_replaced_ends_without_a_trace(tmp_path: Path) -> None:
    settings = ServiceSettings(job_workers=1)
    with running(settings) as service:
        hold = threading.Event()
        service.runtime.jobs.submit("other", lambda handle: {"held": hold.wait(30)})
        job = service.client.post("/v1/maps", json={"id": "desk", "log": LONG}).json()["id"]
        service.store.remove("desk")  # behind the job's back
        assert service.client.post("/v1/maps", json={"id": "desk"}).status_code == 201
        hold.set()
        until(lambda: service.client.get(f"/v1/jobs/{job}").json()["state"] == "cancelled")
        assert service.client.get("/v1/maps/desk").json()["map_version"] == 0


def test_frames_of_a_deleted_stream_reach_no_later_stream(kept: Service) -> None:
    client = kept.client
    for _ in range(20):
        assert client.post("/v1/maps", json={"id": "desk"}).status_code == 201
        stream = kept.runtime.stream("desk")
        assert client.delete("/v1/maps/desk").status_code == 204
        assert client.post("/v1/maps", json={"id": "desk"}).status_code == 201
        assert kept.runtime.stream("desk") is not stream
        assert client.delete("/v1/maps/desk").status_code == 204


def test_the_store_refuses_a_writer_of_another_generation() -> None:
    store = MapStore()
    old = store.add("desk", source="a", state="mapping")
    store.remove("desk")
    new = store.add("desk", source="b", state="mapping")
    for write in (
        lambda: store.publish("desk", wall(7), generation=old.generation),
        lambda: store.set_state("desk", "failed", "a", generation=old.generation),
        lambda: store.tell(old, "result", 1),
        lambda: store.remove("desk", generation=old.generation),
    ):
        with pytest.raises(MapNotFoundError, match="deleted"):
            write()
    store.publish("desk", wall(7), generation=new.generation)
    assert store.get("desk").map_version == 7


def test_a_map_that_is_deleted_while_it_is_saved_stays_deleted(tmp_path: Path) -> None:
    runtime = Runtime(ServiceSettings(data_dir=tmp_path))
    for version in range(1, 40):
        served = runtime.store.add("desk", source="a", state="mapping", snapshot=wall(version))
        saving = threading.Thread(target=runtime.save, args=(served,))
        saving.start()
        time.sleep(np.random.default_rng(version).uniform(0, 0.01))
        runtime.remove(served)
        saving.join()
    runtime.close()
    assert not (tmp_path / "desk").exists()
