"""Picks in the twin, requested over HTTP."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from splatbot.client import Client, ServiceError
from splatbot.services.settings import ServiceSettings
from tests.contracts.conftest import running

SCENE = "tabletop_clutter"


@pytest.fixture(scope="module")
def robot() -> Iterator[Client]:
    with running(ServiceSettings()) as service, Client(service.url) as client:
        yield client


def test_a_pick_is_a_job_that_tells_its_stages_and_how_far_the_thing_rose(robot: Client) -> None:
    job = robot.pick(SCENE, "can", key="once")
    assert robot.pick(SCENE, "can", key="once")["id"] == job["id"]
    told = [event["detail"] for _, event in robot.events(f"/v1/jobs/{job['id']}/events") if event["detail"]]
    ended = robot.wait(job["id"])
    assert ended["state"] == "succeeded", ended
    result = ended["result"]
    assert (result["outcome"], result["stage"]) == ("picked", "check")
    stages = [step["stage"] for step in result["steps"]]
    assert stages == ["grasp", "plan", "open", "move", "look", "approach", "close", "lift", "lift", "check"]
    assert (result["attempts"], result["shift_m"]) == (1, 0.0)
    assert {text.partition(":")[0] for text in told} & set(stages)
    assert result["rose_m"]["can"] == pytest.approx(0.15, abs=0.03)
    assert all(abs(by) < 0.02 for name, by in result["rose_m"].items() if name != "can")


def test_a_pick_without_a_look_has_no_such_stage(robot: Client) -> None:
    ended = robot.wait(robot.pick(SCENE, "can", look=False, attempts=1)["id"])
    assert "look" not in [step["stage"] for step in ended["result"]["steps"]]
    assert ended["result"]["shift_m"] is None


def test_a_pick_is_cancelled_before_anything_is_lifted(robot: Client) -> None:
    job = robot.pick(SCENE, "can", views=2)
    robot.cancel(job["id"])
    ended = robot.wait(job["id"], timeout_s=60)
    assert (ended["state"], ended["result"]) == ("cancelled", None)


def test_a_thing_that_is_not_there_fails_the_job_with_the_names_that_are(robot: Client) -> None:
    ended = robot.wait(robot.pick(SCENE, "unicorn", views=2)["id"], timeout_s=60)
    assert ended["state"] == "failed"
    assert "unicorn" in ended["detail"] or "can" in ended["detail"]


@pytest.mark.parametrize(
    ("asked", "field", "status"),
    [
        ({"scene": "/etc/hosts"}, "scene", 422),
        ({"budget_ms": 1e9}, "budget_ms", 413),
        ({"lift": 0.01}, "lift", 422),
        ({"attempts": 0}, "attempts", 422),
        ({"target": "x" * 300}, "target", 422),
    ],
)
def test_a_pick_that_makes_no_sense_is_refused(
    robot: Client, asked: dict[str, object], field: str, status: int
) -> None:
    with pytest.raises(ServiceError) as caught:
        robot.pick(**{"scene": SCENE, "target": "can"} | asked)  # type: ignore[arg-type]
    assert caught.value.status == status
    assert caught.value.field == field or caught.value.message.startswith(f"body.{field}")
