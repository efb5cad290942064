"""One service answers for maps with different arms at the same time."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from splatbot.robots.panda import panda
from splatbot.services.arms import known_robot
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore
from splatbot.workspace import Workspace
from tests.contracts.conftest import Service, running, table_with_box, wall

PANDA, UR = "panda", "ur5e-2f85"
JOINTS = {PANDA: 7, UR: 6}


@pytest.fixture(scope="module")
def service() -> Iterator[Service]:
    """Map "a" is a table with the base of a Panda; map "b" is a wall, with that of a UR5e elsewhere."""
    store = MapStore()
    for name, snapshot, at in (("a", table_with_box(), (0.0, 0.0, 0.0)), ("b", wall(), (-0.8, -0.4, 1.0))):
        T = np.eye(4)
        T[:3, 3] = at
        store.add(name, source=name, state="static", snapshot=snapshot, workspace=Workspace(T_world_base=T))
    with running(ServiceSettings(), store) as it:
        yield it


def home(robot: str) -> list[float]:
    return known_robot(robot).home.tolist()


def ask(service: Service, path: str, body: dict[str, Any]) -> dict[str, Any]:
    answer = service.client.post(f"/v1/maps/{path}", json=body)
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def test_plans_of_two_arms_on_two_maps_are_each_of_their_own_arm(service: Service) -> None:
    bodies: list[tuple[str, dict[str, Any]]] = []
    for turn in np.linspace(0.2, 0.6, 6):
        for name, robot in (("a", PANDA), ("b", UR)):
            goal = [home(robot)[0] + float(turn), *home(robot)[1:]]
            bodies.append((name, {"robot": robot, "start": home(robot), "goal": goal, "budget_ms": 200.0}))
    with ThreadPoolExecutor(4) as pool:
        plans = list(pool.map(lambda body: ask(service, f"{body[0]}/plans", body[1]), bodies))
    for (name, body), plan in zip(bodies, plans, strict=True):
        assert plan["certified"], name
        waypoints = np.array(plan["waypoints"])
        np.testing.assert_allclose(waypoints[[0, -1]], [body["start"], body["goal"]], atol=1e-12)
        names = plan["trajectory"]["joint_names"]
        assert len(names) == JOINTS[body["robot"]]
        assert all(word.startswith("panda_joint") for word in names) == (body["robot"] == PANDA)
    assert len({plan["id"] for plan in plans}) == len(plans)


def test_collisions_of_two_arms_at_once_are_those_of_each_alone(service: Service) -> None:
    bodies: list[tuple[str, dict[str, Any]]] = []
    for seed in range(10):
        for name, robot in (("a", PANDA), ("b", UR)):
            spread = np.random.default_rng(seed).uniform(-0.8, 0.8, (30, JOINTS[robot]))
            bodies.append((name, {"robot": robot, "q": (np.array(home(robot)) + spread).tolist(), "gradient": True}))
    alone = [ask(service, f"{name}/collisions", body) for name, body in bodies]
    with ThreadPoolExecutor(8) as pool:
        together = list(pool.map(lambda body: ask(service, f"{body[0]}/collisions", body[1]), bodies))
    assert together == alone
    assert any(sum(answer["in_collision"]) for answer in alone)
    assert {len(answer["gradient"][0]) for answer in alone} == {6, 7}


def test_joints_of_the_other_arm_are_refused(service: Service) -> None:
    answer = service.client.post("/v1/maps/b/collisions", json={"robot": UR, "q": [panda().home.tolist()]})
    assert answer.status_code == 422
    assert "q" in answer.json()["detail"]


def test_configurations_in_degrees_are_refused_with_their_row(service: Service) -> None:
    body = {"robot": UR, "q": [home(UR), [0, -90, 90, -90, -90, 0]]}
    answer = service.client.post("/v1/maps/b/collisions", json=body)
    assert answer.status_code == 422
    assert "q[1]" in answer.text
    assert "degrees?" in answer.text
