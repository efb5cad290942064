"""Sequences of requests that use each other's answers (schemathesis, stateful): maps, jobs, plans, leases, versions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore
from tests.contracts.conftest import Service, generated_requests, running, wall

SETTINGS = ServiceSettings(
    max_plan_ms=100, max_views=2, max_pixels=20_000, max_frames=3, max_jobs=4, requests_per_s=1e6, max_requests=512
)
WORKFLOWS, STEPS = 60, 25
SEEDS = 10  # at most
ANSWERS = {200, 201, 202, 204, 404, 409, 422}  # each must be met
FOLLOWED = 100  # requests that take a value of an earlier answer


@pytest.fixture
def api(tmp_path: Path) -> Iterator[Service]:
    store = MapStore()
    store.add("default", source="a log", state="ended", snapshot=wall())
    with running(SETTINGS.model_copy(update={"data_dir": tmp_path}), store) as service:
        yield service


@pytest.mark.long
def test_requests_that_use_each_others_answers_meet_no_fault_and_nothing_deleted_is_served(api: Service) -> None:
    schemathesis = pytest.importorskip("schemathesis", reason="schemathesis is not installed")
    from hypothesis import HealthCheck, Phase, seed, settings
    from hypothesis.errors import FlakyStrategyDefinition
    from schemathesis.specs.openapi.checks import ensure_resource_availability, use_after_free

    schema = schemathesis.openapi.from_dict(generated_requests(api))
    schema.config.update(base_url=api.url)
    statuses: Counter[int] = Counter()
    followed: Counter[str] = Counter()
    workflows = 0

    class Workflow(schema.as_state_machine()):  # type: ignore[misc]
        def get_call_kwargs(self, case: Any) -> dict[str, Any]:
            return {"headers": {"Authorization": f"Bearer {api.key}"}}

        def step(self, input: Any) -> Any:
            if input.transition is not None:
                followed[input.transition.id] += 1
            return super().step(input)

        def teardown(self) -> None:
            nonlocal workflows
            workflows += 1
            super().teardown()

        def validate_response(self, response: Any, case: Any, *args: Any, **kwargs: Any) -> None:
            statuses[response.status_code] += 1
            assert response.status_code != 500, (case.method, case.path, response.text)
            case.validate_response(response, checks=[use_after_free, ensure_resource_availability])

    # A job ends when it ends, so two workflows with the same requests can meet different answers. Hypothesis stops
    # at such a workflow, because it could not repeat a failure. The next seed goes on.
    for number in range(SEEDS):
        rest = settings(
            max_examples=max(WORKFLOWS - workflows, WORKFLOWS // 4),
            stateful_step_count=STEPS,
            deadline=None,
            database=None,
            phases=(Phase.generate,),
            suppress_health_check=list(HealthCheck),
        )
        try:
            seed(number)(Workflow).run(settings=rest)
        except FlakyStrategyDefinition as error:
            print(f"seed {number}, {workflows} workflows so far: {str(error).splitlines()[0]}")
        if workflows >= WORKFLOWS and set(statuses) >= ANSWERS:
            break
    print(
        f"{statuses.total()} requests, {followed.total()} of them with a value of an earlier answer: {dict(statuses)}"
    )
    assert set(statuses) >= ANSWERS
    assert workflows >= WORKFLOWS
    assert followed.total() >= FOLLOWED
    assert api.client.get("/healthz").status_code == 200
