"""Maps on disk: complete or absent, also after a crash."""

from __future__ import annotations

import json
import resource
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.gaussians import Snapshot
from splatbot.services.library import MapLibrary, SaveError, check_id
from splatbot.services.store import MapStore, ServedMap
from splatbot.trajectory import Trajectory
from splatbot.workspace import Workspace
from tests.models import uniform_model


def _served(version: int, n: int = 5) -> ServedMap:
    means = np.arange(3 * n, dtype=np.float64).reshape(n, 3)
    model = uniform_model(means)
    trajectory = Trajectory(np.arange(2.0), np.tile(np.eye(4), (2, 1, 1)))
    return ServedMap("desk", "desk log", "ended", None, Snapshot(model, version, 1.5), trajectory, Workspace(np.eye(4)))


@contextmanager
def disk_of(size: int) -> Iterator[None]:
    """Limit files to ``size`` bytes: writing fails as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def _loaded(folder: Path) -> ServedMap:
    store = MapStore()
    assert MapLibrary(folder).load_all(store) == ["desk"]
    return store.get("desk")


def test_a_restart_serves_what_was_saved_last(tmp_path: Path) -> None:
    library = MapLibrary(tmp_path)
    library.save(_served(3))
    library.save(_served(7, n=6))
    found = _loaded(tmp_path)
    assert (found.map_version, len(found.ready.model), found.source, found.state) == (7, 6, "desk log", "ended")
    assert found.ready.stamp == 1.5
    assert found.trajectory is not None
    assert len(found.trajectory.stamps) == 2
    assert found.workspace is not None
    assert found.workspace.T_world_base is not None
    assert np.array_equal(found.workspace.T_world_base, np.eye(4))
    assert sorted(p.name for p in (tmp_path / "desk").iterdir()) == ["current", "v3", "v7"]
    library.save(_served(9))
    assert sorted(p.name for p in (tmp_path / "desk").iterdir()) == ["current", "v7", "v9"]


def test_a_full_disk_is_told_and_leaves_the_state_before_in_force(tmp_path: Path) -> None:
    library = MapLibrary(tmp_path)
    library.save(_served(3))
    with disk_of(1000), pytest.raises(SaveError, match=r"desk.*cannot be saved"):
        library.save(_served(4, n=5000))
    assert _loaded(tmp_path).map_version == 3
    assert sorted(p.name for p in (tmp_path / "desk").iterdir()) == ["current", "v3"]


def test_what_a_killed_process_left_half_written_is_never_served(tmp_path: Path) -> None:
    library = MapLibrary(tmp_path)
    library.save(_served(3))
    for name in ("v4", ".ab.tmp"):  # killed before `current` was replaced, and while writing
        (tmp_path / "desk" / name).mkdir()
        (tmp_path / "desk" / name / "map.ply").write_bytes(b"ply\nformat")
    (tmp_path / "shelf" / ".cd.tmp").mkdir(parents=True)
    assert _loaded(tmp_path).map_version == 3
    assert sorted(p.name for p in (tmp_path / "desk").iterdir()) == ["current", "v3"]


def test_a_damaged_map_does_not_keep_the_others_from_being_served(tmp_path: Path) -> None:
    library = MapLibrary(tmp_path)
    library.save(_served(3))
    (tmp_path / "broken" / "v1").mkdir(parents=True)
    (tmp_path / "broken" / "current").write_text("v1")
    (tmp_path / "evil").mkdir()
    (tmp_path / "evil" / "current").write_text("../desk/v3")
    assert _loaded(tmp_path).map_version == 3


def test_a_map_saved_without_a_world_has_the_same_world_at_each_start_and_another_name_another_one(
    tmp_path: Path,
) -> None:
    """Format 1 has neither a world nor checksums."""
    MapLibrary(tmp_path).save(_served(3))
    state = tmp_path / "desk" / "v3"
    (state / "SHA256SUMS").unlink()
    (state / "map.json").write_text(json.dumps({"source": "desk log", "map_version": 3, "stamp": 1.5}))
    shutil.copytree(tmp_path / "desk", tmp_path / ".other" / "shelf")
    first, again = _loaded(tmp_path), MapStore()
    library = MapLibrary(tmp_path)
    library.load_all(again)
    assert again.get("desk").world == first.world
    again.publish("desk", Snapshot(uniform_model(np.zeros((5, 3))), 4))
    library.save(again.get("desk"))
    assert _loaded(tmp_path).world == first.world
    elsewhere = MapStore()
    MapLibrary(tmp_path / ".other").load_all(elsewhere)
    assert elsewhere.get("shelf").world != first.world


def test_a_removed_map_is_gone_after_a_restart(tmp_path: Path) -> None:
    library = MapLibrary(tmp_path)
    library.save(_served(3))
    library.remove("desk")
    library.remove("never-saved")
    assert library.load_all(MapStore()) == []


@pytest.mark.parametrize("bad", ["", "..", "a/b", "../etc", "A", "-a", "_a", "a.b", "a" * 65, "a\n", "a\x00", "ä"])
def test_ids_that_could_lead_elsewhere_are_refused(bad: str) -> None:
    with pytest.raises(InputError, match="id"):
        check_id(bad)
