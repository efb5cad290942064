"""Grasps on the map of a run, by the command and by the service."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from splatbot.bench.collision.accuracy import depth_views as exact_views
from splatbot.bench.tabletop import Tabletop
from splatbot.camera import Camera
from splatbot.cli import main
from splatbot.cli.serve import _add_map
from splatbot.collision.visibility import measured_depths
from splatbot.config import Config
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.results.folder import FrameRow, RunFolder
from splatbot.results.views import subsampled
from splatbot.robots.graspable_objects import MeasuredMap, measured_map, run_of, segment_objects
from splatbot.services.app import create_app
from splatbot.services.runtime import Runtime
from splatbot.services.settings import ServiceSettings
from splatbot.trajectory import Trajectory
from splatbot.workspace import Workspace
from tests.unit.grasping.objects import OBJECTS, TABLE, model

VIEWS = tuple(exact_views(Tabletop((TABLE, *OBJECTS.values())), 8))
FLYING = np.array([0.56, -0.15, 0.12])  # next to the can, where depth sees through


def _flying() -> GaussianModel:
    rng = np.random.default_rng(0)
    return GaussianModel.from_activated(
        means=FLYING + rng.uniform(-0.03, 0.03, (200, 3)),
        quats=np.tile([1.0, 0, 0, 0], (200, 1)),
        scales=np.full((200, 3), 2e-3),
        opacities=np.full(200, 0.9),
        colors=np.full((200, 3), 0.5),
    )


@pytest.fixture
def run_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run whose map has flying pixels next to the can; its depth is exact."""
    run = RunFolder.create(tmp_path / "run")
    full = GaussianModel.concatenate([model(), _flying()])
    full.anchors[:] = 0
    poses = np.stack([T for _, _, T in VIEWS])
    stamps = np.arange(len(VIEWS), dtype=np.float64)
    rows = [FrameRow(k, float(k), "ok", keyframe=True) for k in range(len(VIEWS))]
    run.save(config=Config(), rows=rows, trajectories={"": Trajectory(stamps, poses)}, model=full, metrics={})
    Workspace(T_world_base=np.eye(4)).save(run.path / "scene.yaml")
    monkeypatch.setattr("splatbot.robots.graspable_objects.reopen_log", lambda run: None)
    monkeypatch.setattr("splatbot.robots.graspable_objects.subsampled_views", lambda run, log: VIEWS)
    monkeypatch.setattr("splatbot.robots.graspable_objects.raw_views", lambda run, log, most: (list(range(8)), VIEWS))
    return run.path


def _of_service(map_: Path, **asked: Any) -> dict[str, Any]:
    runtime = Runtime(ServiceSettings())
    _add_map(runtime, map_)
    app = create_app(runtime)

    async def ask() -> httpx.Response:
        transport = httpx.ASGITransport(app)
        async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
            return await client.post("/v1/maps/default/grasps", json=asked)

    response = asyncio.run(ask())
    assert response.status_code == 200, response.text
    answer: dict[str, Any] = response.json()
    return answer


def _of_command(map_: Path, out: Path, *words: str) -> dict[str, Any]:
    assert main(["grasp", "--map", str(map_), "--out", str(out), *words]) == 0
    answer: dict[str, Any] = json.loads((out / "grasp.json").read_text())
    return answer


def test_service_and_command_give_the_same_grasps_of_a_run(run_folder: Path, tmp_path: Path) -> None:
    words = ("--target", "blue can", "--wanted", "3", "--samples", "100")
    told = _of_command(run_folder, tmp_path / "out", *words)
    answer = _of_service(run_folder, target="blue can", wanted=3, samples=100)
    for key in ("grasps", "target", "rejected", "candidates", "notes"):
        assert answer[key] == told[key], key
    assert not any("Visibility" in note for note in answer["notes"])


def test_what_depth_saw_through_is_no_thing_and_the_others_know_who_saw_them(run_folder: Path) -> None:
    run = run_of(run_folder)
    state = Snapshot(GaussianModel.load(run_folder / "map.ply"), 3)
    measured = measured_map(state, run)
    left = measured.state.model.means.double().numpy()
    assert (np.abs(left - FLYING).max(axis=1) < 0.02).sum() == 0
    assert len(left) > 0.99 * len(model())
    assert measured.state.map_version == 3
    assert measured.observers is not None
    np.testing.assert_allclose(measured.observers, np.broadcast_to(VIEWS[0][2][:3, 3], left.shape))
    things = segment_objects(measured, np.eye(4), None, as_known=False)
    assert things.scene.model is measured.state.model


def test_the_service_says_which_evidence_it_lacks(run_folder: Path) -> None:
    (note,) = _of_service(run_folder / "map.ply", target="red box", samples=50, base=_HERE)["notes"][:1]
    assert "no run's folder" in note


_HERE = {"translation": [0.0, 0.0, 0.0], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}


def test_a_map_is_measured_once_for_all_questions(run_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from splatbot.services import robots_in_maps

    runtime = Runtime(ServiceSettings())
    _add_map(runtime, run_folder)
    asked, real = [], robots_in_maps.measured_map

    def counted(*given: Any) -> MeasuredMap:
        asked.append(given)
        return real(*given)

    monkeypatch.setattr(robots_in_maps, "measured_map", counted)
    served = runtime.store.get("default")
    first = robots_in_maps.objects_in(served, np.eye(4), as_known=True)
    moved = np.eye(4)
    moved[0, 3] = 0.1
    second = robots_in_maps.objects_in(served, moved, as_known=False)
    assert len(asked) == 1
    assert first.measured is second.measured


def test_thinned_depth_is_of_the_same_places() -> None:
    """Points on a wall that is not level: the evidence of a thinned image equals the evidence of the whole image."""
    camera = Camera(900.0, 900.0, 641.3, 352.1, 1280, 720)
    v, u = np.mgrid[0:720, 0:1280]
    depth = (1.0 + 1e-4 * u + 2e-4 * v).astype(np.float32)
    small, few, _ = subsampled((depth, camera, np.eye(4)))
    assert small.size <= 640 * 480
    assert small.shape == (few.height, few.width)
    z = depth[200:600:7, 100:1200:13].astype(np.float64).ravel()
    at_u, at_v = u[200:600:7, 100:1200:13].ravel(), v[200:600:7, 100:1200:13].ravel()
    points = np.stack([(at_u - camera.cx) / camera.fx * z, (at_v - camera.cy) / camera.fy * z, z], axis=1)
    rows, measured, own = measured_depths(points, small, few, np.eye(4))
    assert len(rows) == len(points)
    assert np.abs(measured - own).max() < 4e-4  # the slope over the one pixel that is left out
    whole = (depth[:480, :640].copy(), Camera(900.0, 900.0, 320.0, 240.0, 640, 480), np.eye(4))
    assert subsampled(whole) is whole
