"""The store: readers keep their version, versions only grow."""

from __future__ import annotations

import threading

import pytest
import torch

from splatbot.errors import MapNotFoundError
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.services.problems import MapNotReadyError
from splatbot.services.store import MapExistsError, MapStore, TooManyMapsError


def _snapshot(version: int, x: float = 0.0) -> Snapshot:
    model = GaussianModel.from_activated(
        means=[[x, 0, 0]], quats=[[1, 0, 0, 0]], scales=[[0.1] * 3], opacities=[0.9], colors=[[0.5] * 3]
    )
    return Snapshot(model, version)


def _store(snapshot: Snapshot | None = None) -> MapStore:
    store = MapStore()
    store.add("desk", source="desk log", state="mapping", snapshot=snapshot)
    return store


def test_a_reader_keeps_the_state_it_took_while_a_newer_one_is_published() -> None:
    store = _store(_snapshot(1, x=0.0))
    held = store.get("desk")
    store.publish("desk", _snapshot(2, x=5.0))
    assert held.map_version == 1
    assert held.field.in_collision([[0.0, 0, 0]]).all()
    assert store.get("desk").map_version == 2
    assert not store.get("desk").field.in_collision([[0.0, 0, 0]]).any()


def test_a_state_that_is_not_newer_is_ignored() -> None:
    store = _store(_snapshot(3))
    store.publish("desk", _snapshot(3, x=1.0))
    store.publish("desk", _snapshot(2, x=1.0))
    assert store.get("desk").map_version == 3
    assert float(store.get("desk").ready.model.means[0, 0]) == 0.0


def test_the_first_published_state_may_have_any_version() -> None:
    store = _store()
    assert store.get("desk").map_version == 0
    store.publish("desk", _snapshot(0))
    assert store.get("desk").snapshot is not None


def test_before_the_first_state_the_map_is_not_ready_and_a_failure_says_why() -> None:
    store = _store()
    with pytest.raises(MapNotReadyError, match="no state yet"):
        _ = store.get("desk").ready
    store.set_state("desk", "failed", "frame 0 is damaged.")
    with pytest.raises(MapNotReadyError, match="frame 0 is damaged"):
        _ = store.get("desk").field


def test_a_failed_map_still_serves_what_was_mapped() -> None:
    store = _store(_snapshot(4))
    store.set_state("desk", "failed", "the log broke")
    served = store.get("desk")
    assert (served.state, served.detail, served.ready.map_version) == ("failed", "the log broke", 4)


def test_an_unknown_map_is_named_with_the_known_ones() -> None:
    with pytest.raises(MapNotFoundError, match=r"'shelf'.*desk"):
        _store().get("shelf")


def test_a_name_is_given_once() -> None:
    store = _store()
    with pytest.raises(MapExistsError, match="desk"):
        store.add("desk", source="another", state="static")


def test_readers_among_a_thousand_writes_see_whole_states_with_growing_versions() -> None:
    store = _store(_snapshot(1, x=1.0))
    torn: list[tuple[int, float]] = []
    done = threading.Event()

    def read() -> None:
        last = 0
        while not done.is_set():
            snapshot = store.get("desk").ready
            x = float(snapshot.model.means[0, 0])
            if x != snapshot.map_version or snapshot.map_version < last:
                torn.append((snapshot.map_version, x))
            last = snapshot.map_version

    readers = [threading.Thread(target=read) for _ in range(2)]
    for reader in readers:
        reader.start()
    base = _snapshot(1, x=1.0).model
    for version in range(2, 1000):
        model = base.clone()
        model.means = torch.tensor([[float(version), 0.0, 0.0]])
        store.publish("desk", Snapshot(model, version))
    done.set()
    for reader in readers:
        reader.join()
    assert torn == []
    assert store.get("desk").map_version == 999


def test_clients_add_a_bounded_number_of_maps_and_saved_ones_always_return() -> None:
    store = MapStore(most=2)
    for number in range(3):
        store.add(f"saved{number}", source="disk", state="ended", counted=False)
    with pytest.raises(TooManyMapsError, match="3 maps are served already"):
        store.add("one more", source="x", state="mapping")
    store.remove("saved0")
    store.remove("saved1")
    store.add("one more", source="x", state="mapping")
