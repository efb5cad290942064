"""Folders of saved maps: two owners, damaged files, full disks, disks that vanish, requests that are killed."""

from __future__ import annotations

import io
import logging
import os
import signal
import subprocess
import tempfile
import threading
import time
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from splatbot.errors import FormatError, InputError
from splatbot.formats.ply import load_ply
from splatbot.services.library import MapLibrary
from splatbot.services.problems import SaveError
from splatbot.services.scratch import Scratch, sweep_scratch
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore, ServedMap
from splatbot.trajectory import Trajectory
from splatbot.workspace import Workspace
from tests.contracts.conftest import Service, running, wall
from tests.e2e.test_serve_cli import refused, serving
from tests.waiting import until


def save(folder: Path, *versions: int) -> None:
    store, library = MapStore(), MapLibrary(folder)
    trajectory = Trajectory(np.arange(2.0), np.tile(np.eye(4), (2, 1, 1)))
    store.add("desk", source="log", state="mapping", trajectory=trajectory, workspace=Workspace(np.eye(4)))
    for version in versions:
        store.publish("desk", wall(version, z=float(version)))
        library.save(store.get("desk"))


def load(folder: Path) -> int:
    """Return the version that a restart serves, 0 for none."""
    store = MapStore()
    return store.get("desk").map_version if MapLibrary(folder).load_all(store) else 0


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 2 MB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if os.getuid() != 0 or subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "none", disk]).returncode:
        pytest.skip("needs the right to mount a tmpfs")
    yield disk
    subprocess.run(["umount", "-l", disk], check=False)


@pytest.mark.long
def test_a_second_service_on_one_folder_is_refused_and_told_the_first_one_s_process(tmp_path: Path) -> None:
    with serving("--data", str(tmp_path)) as (process, client):
        assert client.get("/readyz").status_code == 200
        told = refused("--data", str(tmp_path), "--port", "0")
        assert f"is in use by process {process.pid}" in told
        process.send_signal(signal.SIGKILL)
        process.wait(10)
    library = MapLibrary(tmp_path)
    library.lock()  # a killed process holds no lock
    with pytest.raises(InputError, match=f"in use by process {os.getpid()}"):
        MapLibrary(tmp_path).lock()
    library.unlock()


@pytest.mark.parametrize("name", ["map.ply", "map.json", "trajectory.tum", "scene.yaml", "SHA256SUMS"])
@pytest.mark.parametrize("how", ["flip", "zeros", "cut", "empty", "gone"])
def test_a_damaged_file_is_set_aside_and_the_state_before_is_served(
    tmp_path: Path, name: str, how: str, caplog: pytest.LogCaptureFixture
) -> None:
    save(tmp_path, 1, 2)
    path = tmp_path / "desk" / "v2" / name
    data = bytearray(path.read_bytes())
    if how == "flip":
        data[len(data) // 2] ^= 4
    elif how == "zeros":
        at = len(data) // 3
        data[at : at + 512] = bytes(len(data[at : at + 512]))
    elif how == "cut":
        del data[-1:]
    path.write_bytes(b"" if how == "empty" else data)
    if how == "gone":
        path.unlink()
    with caplog.at_level(logging.WARNING):
        assert load(tmp_path) == 1
    assert "damaged and set aside" in caplog.text
    assert name in caplog.text
    assert (tmp_path / "desk" / "v2.damaged").is_dir()
    assert load(tmp_path) == 1


@pytest.mark.parametrize("text", ["v1", "v3", "", "\x00\x00", "w2", "../v1"])
def test_a_damaged_pointer_is_told_and_the_newest_whole_state_is_served(
    tmp_path: Path, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    save(tmp_path, 1, 2)
    (tmp_path / "desk" / "current").write_text(text)
    assert load(tmp_path) == 2
    assert "current names" in caplog.text


def test_if_no_state_is_whole_nothing_is_served_and_a_new_map_may_take_the_name(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    save(tmp_path, 8, 9)
    for version in ("v8", "v9"):
        (tmp_path / "desk" / version / "map.ply").write_bytes(b"ply")
    assert load(tmp_path) == 0
    assert "no state of it is whole" in caplog.text
    save(tmp_path, 1)
    assert load(tmp_path) == 1


def test_a_zero_quaternion_in_a_saved_map_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    served = wall()
    served.model.quats[7] = 0.0
    from splatbot.formats.ply import save_ply

    save_ply(served.model, path, bookkeeping=True)
    with pytest.raises(FormatError, match="zero quaternion, the first is row 7"):
        load_ply(path)


def test_a_folder_of_an_earlier_version_is_served_with_a_note(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    save(tmp_path, 1)
    state = tmp_path / "desk" / "v1"
    (state / "SHA256SUMS").unlink()
    (state / "map.json").write_text('{"source": "log", "map_version": 1, "stamp": 0.0}')
    with caplog.at_level(logging.WARNING):
        assert load(tmp_path) == 1
    assert "has no checksums" in caplog.text


def test_what_a_killed_service_left_is_swept_at_the_next_start(tmp_path: Path) -> None:
    save(tmp_path, 1)
    (tmp_path / "desk" / ".current.12345678.tmp").write_text("v")
    (tmp_path / "desk" / ".12345678.tmp").mkdir()
    (tmp_path / ".deleted-1234" / "v1").mkdir(parents=True)
    load(tmp_path)
    assert {path.name for path in (tmp_path / "desk").iterdir()} == {"v1", "current"}
    assert not (tmp_path / ".deleted-1234").exists()


def test_abandoned_uploads_are_swept_and_those_of_living_services_are_not() -> None:
    old = Path(tempfile.mkdtemp(prefix="splatbot-upload-"))
    (old / "recording.zip").write_bytes(b"PK")
    living, young = Scratch("upload"), Path(tempfile.mkdtemp(prefix="splatbot-upload-"))
    for path in (old, living.path):
        os.utime(path, (1.0, 1.0))
    sweep_scratch()
    assert [path.exists() for path in (old, living.path, young)] == [False, True, True]
    living.discard()
    young.rmdir()


def test_a_full_disk_is_told_and_stops_nothing(small_disk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", str(small_disk))
    monkeypatch.setattr(tempfile, "tempdir", str(small_disk))
    with running(ServiceSettings(data_dir=small_disk / "maps", save_every_s=0.1)) as service:
        service.store.add("desk", source="log", state="mapping", snapshot=wall(1))
        until(lambda: (small_disk / "maps" / "desk" / "v1").is_dir())
        filler = small_disk / "filler"
        with filler.open("wb", buffering=0) as file, suppress(OSError):
            while file.write(bytes(4096)):
                pass
        service.store.publish("desk", wall(2))
        until(lambda: service.client.get("/readyz").json().get("unsaved") == 1)
        assert service.client.get("/readyz").status_code == 200
        assert _metric(service, "splatbot_maps_unsaved ") == 1
        assert _metric(service, "splatbot_map_save_failures_total ") >= 1
        asked = service.client.post("/v1/maps/desk/distance", json={"points": [[0, 0, 1]]})
        assert (asked.status_code, asked.json()["map_version"]) == (200, 2)
        headers = {"content-type": "application/zip"}
        sent = service.client.post("/v1/maps/shelf/upload", content=_zip(3_000_000), headers=headers)
        assert sent.status_code == 507, sent.text
        assert "No space left" in sent.json()["detail"]
        assert service.client.get("/v1/maps/shelf").status_code == 404
        assert service.client.get("/v1/maps/desk/splats.ply").status_code == 507
        filler.unlink()
        until(lambda: service.client.get("/readyz").json().get("unsaved") == 0)
        assert (small_disk / "maps" / "desk" / "v2").is_dir()


def test_a_read_only_disk_is_told_and_a_map_that_cannot_be_deleted_stays(small_disk: Path) -> None:
    with running(ServiceSettings(data_dir=small_disk / "maps", save_every_s=0.1)) as service:
        service.store.add("desk", source="log", state="mapping", snapshot=wall(1))
        until(lambda: (small_disk / "maps" / "desk" / "v1").is_dir())
        subprocess.run(["mount", "-o", "remount,ro", small_disk], check=True)
        told = service.client.delete("/v1/maps/desk")
        assert told.status_code == 507
        assert "cannot be deleted (Read-only file system)" in told.json()["detail"]
        assert service.client.get("/v1/maps/desk").status_code == 200
        service.store.publish("desk", wall(2))
        until(lambda: service.client.get("/readyz").json().get("unsaved") == 1)


def test_a_disk_that_vanishes_is_told_and_nothing_is_written_beneath_it(small_disk: Path) -> None:
    with running(ServiceSettings(data_dir=small_disk, save_every_s=0.1)) as service:
        service.store.add("desk", source="log", state="mapping", snapshot=wall(1))
        until(lambda: (small_disk / "desk" / "v1").is_dir())
        subprocess.run(["umount", "-l", small_disk], check=True)
        service.store.publish("desk", wall(2))
        until(lambda: service.client.get("/readyz").json().get("unsaved") == 1)
        assert list(small_disk.iterdir()) == []
        assert service.client.get("/v1/maps/desk").json()["map_version"] == 2


def test_a_disk_that_vanishes_within_a_save_does_not_end_the_saving(
    small_disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def vanish(folder: Path) -> None:  # after the last step of the first save, before older states are removed
        monkeypatch.undo()
        subprocess.run(["umount", "-l", folder], check=True)

    monkeypatch.setattr("splatbot.services.library.sync_folder", vanish)
    with running(ServiceSettings(data_dir=small_disk, save_every_s=0.1)) as service:
        service.store.add("desk", source="log", state="mapping", snapshot=wall(1))
        until(lambda: not os.path.ismount(small_disk))
        service.store.publish("desk", wall(2))
        until(lambda: service.client.get("/readyz").json().get("unsaved") == 1)


def test_a_defect_in_saving_one_map_does_not_end_the_saving_of_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save = MapLibrary.save

    def fail(library: MapLibrary, served: ServedMap) -> None:
        if served.id == "broken":
            raise RuntimeError("a defect")
        save(library, served)

    monkeypatch.setattr(MapLibrary, "save", fail)
    with running(ServiceSettings(data_dir=tmp_path, save_every_s=0.1)) as service:
        service.store.add("broken", source="log", state="mapping", snapshot=wall(1))
        service.store.add("desk", source="log", state="mapping", snapshot=wall(1))
        until(lambda: (tmp_path / "desk" / "v1").is_dir())
        service.store.publish("desk", wall(2))
        until(lambda: (tmp_path / "desk" / "v2").is_dir())


def test_a_save_that_failed_after_its_state_was_renamed_is_made_up_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, library = MapStore(), MapLibrary(tmp_path)
    store.add("desk", source="log", state="mapping", workspace=Workspace(np.eye(4)), snapshot=wall(1))

    def fail(folder: Path) -> None:
        raise OSError(5, "Input/output error", str(folder))

    monkeypatch.setattr("splatbot.services.library.sync_folder", fail)  # the last step of a save
    with pytest.raises(SaveError, match="Input/output error"):
        library.save(store.get("desk"))
    assert (tmp_path / "desk" / "v1").is_dir()
    monkeypatch.undo()
    library.save(store.get("desk"))
    assert load(tmp_path) == 1


def test_an_idempotency_key_covers_the_uploaded_file() -> None:
    headers = {"content-type": "application/zip", "Idempotency-Key": "a"}
    with running(ServiceSettings()) as service:
        first = service.client.post("/v1/maps/desk/upload", content=_zip(10), headers=headers)
        again = service.client.post("/v1/maps/desk/upload", content=_zip(10), headers=headers)
        other = service.client.post("/v1/maps/desk/upload", content=_zip(11), headers=headers)
    assert (first.status_code, again.status_code, other.status_code) == (202, 202, 409)
    assert first.json()["id"] == again.json()["id"]
    assert "Idempotency-Key" in other.json()["detail"]


def test_deleted_maps_leave_no_threads_descriptors_or_metric_series(tmp_path: Path) -> None:
    with running(ServiceSettings(data_dir=tmp_path, requests_per_s=1e6)) as service:
        _make_and_delete(service, 40)  # pools of threads grow to their size, later on busy cores
        before = _held(service)
        _make_and_delete(service, 40)
        until(lambda: _held(service)[0] <= before[0])
        assert _held(service)[1:] == before[1:]


@pytest.mark.long
@pytest.mark.alone
def test_sigterm_ends_within_eight_seconds_while_a_big_upload_is_unpacked(tmp_path: Path) -> None:
    os.environ["TMPDIR"], before = str(tmp_path), os.environ.get("TMPDIR")
    try:
        with serving("--data", str(tmp_path / "maps")) as (process, client):
            headers = {"content-type": "application/zip"}
            sent = client.post("/v1/maps/desk/upload", content=_zip(3_500_000_000), headers=headers)
            job = sent.json()["id"]
            until(lambda: "unpacking" in (client.get(f"/v1/jobs/{job}").json()["detail"] or ""))
            start = time.monotonic()
            process.send_signal(signal.SIGTERM)
            assert process.wait(30) == 0
            assert time.monotonic() - start < 8
    finally:
        os.environ.pop("TMPDIR") if before is None else os.environ.update(TMPDIR=before)


def test_deleting_a_map_ends_the_unpacking_of_its_upload() -> None:
    with running(ServiceSettings()) as service:
        headers = {"content-type": "application/zip"}
        job = service.client.post("/v1/maps/desk/upload", content=_zip(1_500_000_000), headers=headers).json()["id"]
        until(lambda: "unpacking" in (service.client.get(f"/v1/jobs/{job}").json()["detail"] or ""))
        assert service.client.delete("/v1/maps/desk").status_code == 204
        assert service.client.get(f"/v1/jobs/{job}").json()["state"] == "cancelled"


def _zip(size: int) -> bytes:
    """Return a zip of one text of zeros that unpacks to ``size`` bytes."""
    made, kind = io.BytesIO(), zipfile.ZIP_DEFLATED if size > 5_000_000 else zipfile.ZIP_STORED
    with (
        zipfile.ZipFile(made, "w", kind, compresslevel=1) as pack,
        pack.open("zeros.txt", "w", force_zip64=True) as file,
    ):
        while size > 0:
            file.write(bytes(min(size, 1 << 24)))
            size -= 1 << 24
    return made.getvalue()


def _make_and_delete(service: Service, count: int) -> None:
    for k in range(count):
        made = service.client.post("/v1/maps", json={"id": f"m{k}"})
        assert made.status_code == 201
        assert service.client.delete(f"/v1/maps/m{k}").status_code == 204


def _held(service: Service) -> tuple[int, int, int]:
    series = [line for line in service.client.get("/metrics").text.splitlines() if not line.startswith("#")]
    series = [line for line in series if "request_seconds" not in line]
    return threading.active_count(), len(list(Path("/proc/self/fd").iterdir())), len(series)


def _metric(service: Service, name: str) -> float:
    lines = service.client.get("/metrics").text.splitlines()
    return float(next(line for line in lines if line.startswith(name)).split()[-1])
