"""The landing page, the list of objects, and distances in two units."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np
import pytest

from splatbot.gaussians import Snapshot
from splatbot.results.margin import AuditedError
from splatbot.services.margins import MarginSource
from splatbot.services.settings import ServiceSettings
from splatbot.workspace import Workspace
from tests.contracts.conftest import Service, running
from tests.unit.test_workspace import _table


@pytest.fixture(scope="module")
def table() -> Iterator[Service]:
    """A service with a map of a table whose base is known."""
    model, T = _table()
    base = T.copy()
    base[:3, 3] = (T @ [0.0, -0.55, 0.0, 1.0])[:3]
    with running(ServiceSettings(port=0)) as service:
        service.store.add(
            "desk", source="desk", state="static", snapshot=Snapshot(model, 3), workspace=Workspace(T_world_base=base)
        )
        yield service


def test_the_landing_page_names_the_maps_and_its_links_answer(table: Service) -> None:
    page = table.client.get("/")
    assert page.status_code == 200
    assert page.headers["content-type"].startswith("text/html")
    assert "desk" in page.text
    links = set(re.findall(r'(?:href|src)="(/[^"]*)"', page.text))
    assert {"/docs", "/v1/maps", "/v1/maps/desk/render", "/v1/maps/desk/objects"} <= links
    for link in links:
        assert table.client.get(link).status_code == 200, link
    assert "//" not in page.text.replace("<!doctype html>", "")  # nothing is fetched from elsewhere


def test_objects_name_their_unit_and_what_does_not_fit_the_hand(table: Service) -> None:
    body = table.client.get("/v1/maps/desk/objects").json()
    assert body["map_version"] == 3
    assert body["hand_opens_m"] == pytest.approx(0.08)
    assert body["objects"]
    for number, item in enumerate(body["objects"]):
        assert item["target"] == f"object {number}"
        _, short, height = item["size_m"]
        assert item["graspable_by_size"] == (short <= 0.076 and height >= 0.012)
        assert short <= 0.076 or "the hand opens 80 mm" in item["obstacle"]


def test_objects_are_listed_with_the_margin_of_each_request(table: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.zeros((1000, 3))
    for error in (0.0, 0.3):
        source = MarginSource(AuditedError(points, np.full(1000, error)), 0.0, "audited")
        monkeypatch.setattr("splatbot.services.routes.objects.margin_source", lambda *_, source=source: source)
        body = table.client.get("/v1/maps/desk/objects").json()
        assert body["arm_margin_m"] == pytest.approx(error)
        assert body["margin_source"] == "audited error of the map around the objects"
        keeps = ["or its 300.0 mm margin" in item["obstacle"] for item in body["objects"]]
        assert keeps == [error > 0.0] * 2


def test_the_documented_list_of_objects_has_the_fields_of_the_answer(table: Service) -> None:
    body = table.client.get("/v1/maps/desk/objects").json()
    route = table.client.get("/openapi.json").json()["paths"]["/v1/maps/{map_id}/objects"]["get"]
    example = route["responses"]["200"]["content"]["application/json"]["example"]
    assert example.keys() == body.keys()
    assert example["planes"][0].keys() == body["planes"][0].keys()
    assert example["objects"][1].keys() == body["objects"][0].keys()
    assert {item["reach"] for item in body["objects"]} <= {"yes", "blocked", "no pose", "too far"}
    assert (body["arm_margin_m"], body["margin_source"]) == (0.0, "unknown: the map has no recording; 0 is assumed")


def test_distances_are_in_sigmas_and_in_metres(table: Service) -> None:
    field = table.store.get("desk").field
    points = np.array([[0.0, 0.0, 0.5], [0.0, 0.2, 0.6], [0.0, 0.0, 50.0]])
    body = table.client.post("/v1/maps/desk/distance", json={"points": points.tolist()}).json()
    np.testing.assert_allclose(body["distance_sigma"], field.mahalanobis(points).distance, rtol=1e-6)
    np.testing.assert_allclose(body["distance_m"][:2], field.clearance(points[:2]).distance, atol=1e-6)
    assert body["distance_m"][2] is None
    other = table.client.post("/v1/maps/desk/distance", json={"points": points.tolist(), "n_sigma": 3.0}).json()
    assert other["distance_m"] == [None] * 3
