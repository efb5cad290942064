"""Margins of plans over HTTP and MoveIt: audited where the map has a recording, stated where nothing is known."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatbot.cli import main
from splatbot.collision import GaussianCollisionField
from splatbot.errors import LogError
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.results.folder import RunFolder
from splatbot.results.margin import audited_error
from splatbot.robots.in_view import reopen_log
from splatbot.robots.panda import panda
from splatbot.services import plan_obstacles
from splatbot.services.margins import margin_source
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore
from splatbot.workspace import Workspace
from tests.contracts.conftest import Service, running, wall

HOME = panda().home.tolist()
GOAL = [0.3, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]
BASE = {"translation": [0.0, 0.9, 0.3], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}
FAR = {"translation": [0.0, 30.0, 0.0], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of four frames."""
    run = tmp_path_factory.mktemp("runs") / "table"
    assert main(["map", "synthetic:tabletop?frames=4&width=160&height=120", "--out", str(run), "--quiet"]) == 0
    return run


@pytest.fixture(scope="module")
def service(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service with the map of a recording, one without, and one whose recording is lost."""
    lost = tmp_path_factory.mktemp("lost") / "table"
    shutil.copytree(recorded, lost)
    store = MapStore()
    state = Snapshot(GaussianModel.load(recorded / "map.ply"), 1)
    store.add("table", source="table", state="static", snapshot=state, run=RunFolder(recorded))
    far = Workspace(T_world_base=np.array([[1.0, 0, 0, 0], [0, 1, 0, 30], [0, 0, 1, 0], [0, 0, 0, 1]]))
    store.add("placed", source="table", state="static", snapshot=state, run=RunFolder(recorded), workspace=far)
    proposed = replace(far, base_proposed=True)
    store.add("proposed", source="table", state="static", snapshot=state, run=RunFolder(recorded), workspace=proposed)
    store.add("lost", source="lost", state="static", snapshot=state, run=RunFolder(lost))
    store.add("wall", source="wall.ply", state="static", snapshot=wall())
    store.add("bare", source="wall.ply", state="static", snapshot=wall(), workspace=far)
    for file in lost.glob("*.json*"):
        file.unlink()
    with running(ServiceSettings(), store) as one:
        yield one


def plan(service: Service, name: str, **request: Any) -> Any:
    body = {"start": HOME, "goal": GOAL, "base": FAR, "budget_ms": 50} | request
    return service.client.post(f"/v1/maps/{name}/plans", json=body)


def test_the_default_margin_of_a_recorded_map_is_its_audited_error(service: Service, recorded: Path) -> None:
    answer = plan(service, "table").json()
    assert answer["margin_source"] == "audited error of the map where the arm moves"
    covers = answer["covers"]
    assert (covers["margin_from"], covers["unknown_space"], covers["base"]) == ("audit", "free", False)
    assert covers["measured_surface"]
    assert covers["region_points"] == 1000  # far from all points, so that the nearest count
    assert 0.0 < covers["region_error_m"] <= answer["margin_m"] * (1 + 1e-9)
    error = audited_error(recorded, reopen_log(RunFolder(recorded)), service.store.get("table").field)
    assert covers["region_error_m"] in error.error
    assert answer["certified"]
    median = plan(service, "table", margin="auto", confidence=0.5).json()["margin_m"]
    assert 0.0 <= median < answer["margin_m"]


def test_a_given_margin_is_kept_and_stated(service: Service) -> None:
    answer = plan(service, "table", margin=0.012).json()
    assert answer["margin_m"] == 0.012
    assert answer["margin_source"] == "given"
    assert (answer["covers"]["margin_from"], answer["covers"]["region_points"]) == ("user", None)
    assert not answer["covers"]["measured_surface"]
    zero = plan(service, "table", margin=0).json()
    assert (zero["margin_m"], zero["margin_source"]) == (0.0, "given")


def test_a_plan_says_whether_its_base_is_only_proposed(service: Service) -> None:
    answer = plan(service, "proposed", margin=0, base=None).json()
    assert answer["covers"]["base_proposed"] is True
    again = service.client.get(f"/v1/plans/{answer['id']}").json()
    assert again["covers"]["base_proposed"] is True
    assert plan(service, "proposed", margin=0).json()["covers"]["base_proposed"] is False  # the request gives one
    assert plan(service, "placed", margin=0, base=None).json()["covers"]["base_proposed"] is False


def test_unknown_space_is_an_obstacle_where_it_is_asked_for(service: Service) -> None:
    blocked = plan(service, "placed", unknown="occupied", margin=0, base=None)  # no frame saw the place of the arm
    assert blocked.status_code == 422
    assert "space that no frame saw to be empty" in blocked.json()["detail"]
    assert "panda_joint" in blocked.json()["detail"]
    wary = plan(service, "placed", unknown="cautious", margin=0, base=None).json()
    assert wary["covers"]["unknown_space"] == "cautious"
    assert wary["map_version"] == 1  # the solids of unknown space are no other version
    assert plan(service, "placed", margin=0).json()["covers"]["unknown_space"] == "free"
    refused = plan(service, "bare", unknown="cautious", base=None)
    assert (refused.status_code, refused.json()["field"]) == (422, "unknown")
    assert "has no recording" in refused.json()["detail"]
    elsewhere = plan(service, "placed", unknown="cautious")  # each base would be another search
    assert (elsewhere.status_code, elsewhere.json()["field"]) == (422, "base")
    assert plan(service, "table", unknown="maybe").status_code == 422


def test_without_a_recording_the_answer_says_that_the_error_is_unknown(service: Service) -> None:
    answer = plan(service, "wall").json()
    assert answer["margin_m"] == 0.0
    assert answer["margin_source"] == "unknown: the map has no recording; 0 is assumed"
    asked = plan(service, "wall", margin="auto")
    assert asked.status_code == 422
    assert "which has no recording" in asked.json()["detail"]


def test_a_recording_that_cannot_be_read_is_stated_and_refused_where_it_was_asked_for(service: Service) -> None:
    answer = plan(service, "lost").json()
    assert answer["margin_m"] == 0.0
    assert answer["margin_source"].startswith("unknown: the recording cannot be audited (")
    asked = plan(service, "lost", margin="auto")
    assert 400 <= asked.status_code < 500


def test_the_margin_of_grasps_is_the_error_of_their_own_field(service: Service, recorded: Path) -> None:
    served = service.store.get("table")
    thin = GaussianCollisionField(GaussianModel.load(recorded / "map.ply"), 1.0)
    source, plans = margin_source(served, None, thin), margin_source(served, None)
    assert source.error is not None
    assert plans.error is not None
    expected = audited_error(recorded, reopen_log(RunFolder(recorded)), thin)
    np.testing.assert_array_equal(source.error.error, expected.error)
    assert source.error.error.mean() > plans.error.error.mean()  # thinner ellipsoids leave more of the surface out
    assert margin_source(served, None, thin).error is source.error  # audited once


def test_grasps_take_the_unknown_space_of_plans(service: Service) -> None:
    def grasps(name: str, **request: Any) -> Any:
        return service.client.post(f"/v1/maps/{name}/grasps", json={"point": [0.0, 0.0, 1.0], "samples": 10} | request)

    elsewhere = grasps("placed", base=FAR, unknown="cautious")
    assert (elsewhere.status_code, elsewhere.json()["field"]) == (422, "base")
    refused = grasps("bare", unknown="occupied", point=wall().model.means[0].tolist())
    assert (refused.status_code, refused.json()["field"]) == (422, "unknown")
    assert "has no recording" in refused.json()["detail"]
    assert grasps("placed", unknown="maybe").status_code == 422


@pytest.mark.parametrize("margin", [-0.1, "much", "1e400", float("1e300"), True])
def test_margins_that_make_no_sense_are_refused(service: Service, margin: Any) -> None:
    assert plan(service, "table", margin=margin).status_code == 422


def test_a_plan_that_is_asked_again_states_the_same_margin(service: Service) -> None:
    answer = plan(service, "table").json()
    again = service.client.get(f"/v1/plans/{answer['id']}").json()
    assert (again["margin_m"], again["margin_source"]) == (answer["margin_m"], answer["margin_source"])
    assert np.isfinite(again["margin_m"])


def test_a_recording_that_is_lost_after_its_audit_leaves_out_measured_surface_unless_auto_is_requested(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert plan(service, "table").json()["covers"]["measured_surface"]  # audits the map

    def gone(_: RunFolder) -> Any:
        raise LogError("does not exist.", file="table.mcap", hint="restore it")

    monkeypatch.setattr(plan_obstacles, "reopen_log", gone)
    elsewhere = FAR | {"translation": [0.0, 31.0, 0.0]}
    covers = plan(service, "table", base=elsewhere).json()["covers"]
    assert (covers["margin_from"], covers["measured_surface"]) == ("audit", False)
    refused = plan(service, "table", base=elsewhere, margin="auto")
    assert refused.status_code == 422
    assert "does not exist" in refused.json()["detail"]
