"""Requests that fit the OpenAPI document, and many that do not, never cause a fault of the service."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore
from tests.contracts.conftest import Service, generated_requests, running, wall

CASES = 2000
# A robot base far from the map and small budgets keep single questions cheap, not the number of kinds of questions.
SETTINGS = ServiceSettings(
    max_plan_ms=200, max_views=4, max_pixels=100_000, max_frames=3, max_jobs=4, requests_per_s=1e6, max_requests=512
)


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    store = MapStore()
    store.add("default", source="a log", state="ended", snapshot=wall())
    with running(SETTINGS.model_copy(update={"data_dir": tmp_path_factory.mktemp("maps")}), store) as service:
        yield service


@pytest.mark.long
def test_two_thousand_generated_requests_meet_no_fault_and_errors_are_problems(api: Service) -> None:
    schemathesis = pytest.importorskip("schemathesis", reason="schemathesis is not installed")
    from hypothesis import HealthCheck, Phase, given, settings

    schema = schemathesis.openapi.from_dict(generated_requests(api))
    operations = [operation.ok() for operation in schema.get_all_operations()]
    # Deleting the map that all requests use would make the rest of them 404.
    operations = [o for o in operations if not (o.method.upper() == "DELETE" and "{map_id}" in o.path)]
    each = 3 * CASES // (2 * len(operations))  # calls without parameters are sent only once
    asked, statuses = 0, set()
    for operation in operations:
        quiet = settings(
            max_examples=each,
            deadline=None,
            database=None,
            derandomize=True,
            phases=(Phase.generate,),
            suppress_health_check=list(HealthCheck),
        )

        @quiet
        @given(case=operation.as_strategy())
        def ask(case: Any) -> None:
            nonlocal asked
            if "map_id" in (case.path_parameters or {}):
                case.path_parameters["map_id"] = "default"
            response = case.call(base_url=api.url, headers={"Authorization": f"Bearer {api.key}"})
            asked += 1
            statuses.add(response.status_code)
            assert response.status_code != 500, (case.method, case.path, response.text)
            if response.status_code == 503:
                assert "retry-after" in response.headers, (case.path, response.text)
            if response.status_code >= 400:
                kind = response.headers["content-type"]
                kinds = kind if isinstance(kind, str) else kind[0]
                assert kinds.startswith("application/problem+json"), (case.path, response.status_code, response.text)

        ask()
    assert asked >= CASES
    assert {200, 422} <= statuses


def test_every_field_of_every_body_is_described(service: Service) -> None:
    schemas = service.client.get("/openapi.json").json()["components"]["schemas"]
    own = {name: schema for name, schema in schemas.items() if "Validation" not in name}
    assert len(own) > 20
    missing = [
        f"{name}.{field}"
        for name, schema in own.items()
        for field, value in schema.get("properties", {}).items()
        if not value.get("description")
    ]
    assert not missing
