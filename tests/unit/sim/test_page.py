"""A run as a page: its data are those of the run, and a browser plays, steps and scrubs it."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from splatbot.bench.tabletop import Block, Tabletop
from splatbot.sim.page import recording_html, surface_points, twin_html
from splatbot.sim.recording import CONSTANTS as RECORDING
from splatbot.sim.recording import TwinRecording
from splatbot.sim.scene import load_scene, make_scene
from splatbot.sim.twin import Twin, TwinResult
from tests.browser.chromium import Chromium
from tests.unit.batch.processes import wait_until

_SHAPES: list[dict[str, Any]] = [
    {"kind": "box", "size": [0.1, 0.2, 0.3]},
    {"kind": "sphere", "radius": 0.1},
    {"kind": "cylinder", "radius": 0.05, "height": 0.3},
    {"kind": "capsule", "radius": 0.05, "height": 0.3},
    {"kind": "ellipsoid", "axes": [0.1, 0.05, 0.2]},
]


@cache
def recorded(scene: str = "mug_hanging") -> tuple[TwinRecording, TwinResult]:
    twin = Twin(load_scene(scene))
    recording = TwinRecording(twin.world)
    return recording, twin.follow(watch=recording)


def document(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    values: dict[str, Any] = json.loads(found.group(1))
    return values


def unpacked(text: str, kind: type) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind)


@pytest.mark.parametrize("shape", _SHAPES, ids=lambda shape: str(shape["kind"]))
def test_points_of_a_shape_are_where_a_ray_from_outside_hits_it(shape: dict[str, Any]) -> None:
    model = Twin(make_scene({"name": "x", "robot": None, "objects": [{"name": "body", "shapes": [shape]}]})).world.model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    points, hit = surface_points(model, 0, 200), np.zeros(1, np.int32)
    assert len(points) == 200
    for point in points:
        out = point / np.linalg.norm(point)
        far = mujoco.mj_ray(model, data, 2.0 * out, -out, None, 1, -1, hit)
        assert 2.0 - far == pytest.approx(float(np.linalg.norm(point)), abs=1e-6)


def test_the_recording_has_the_contacts_and_clearance_of_the_run() -> None:
    recording, result = recorded()
    assert len(recording.times) == pytest.approx(RECORDING.rate * result.duration, abs=1)
    seen: list[np.ndarray] = []
    twin = Twin(load_scene("mug_hanging"))
    twin.follow(watch=lambda data, time: seen.append(data.xpos.copy()) if time in recording.times else None)
    np.testing.assert_array_equal(recording.poses[..., 3], np.array(seen))
    assert min(recording.clearances) == pytest.approx(result.clearance.value, abs=1e-3)
    in_contact = [t for t, found in zip(recording.times, recording.contacts, strict=True) if found]
    first, last = min(contact.first for contact in result.contacts), max(contact.last for contact in result.contacts)
    assert first <= in_contact[0] <= first + 2 / RECORDING.rate + 0.2  # at first fainter than is shown
    assert in_contact[-1] <= last
    assert max(force for found in recording.contacts for *_, force in found) <= max(t.force for t in result.contacts)


def test_expected_contacts_are_apart_from_those_of_the_arm_and_the_curve_shows_the_rise_in_height() -> None:
    """The mug hangs on the hand; all of its contacts are expected, and those of other bodies are not."""
    whole, _ = recorded()
    twin = Twin(load_scene("mug_hanging"))
    recording = TwinRecording(twin.world, expected=lambda part, other, depth, time: other == "mug")
    body, heights = twin.data.body("object/mug"), []

    def watch(data: Any, time: float) -> None:
        before = len(recording.times)
        recording(data, time)
        if len(recording.times) > before:
            heights.append(float(body.xipos[2]))

    twin.follow(watch=watch)
    assert any(recording.grips)
    for all_, rest, grips in zip(whole.contacts, recording.contacts, recording.grips, strict=True):
        assert sorted(all_) == sorted([*rest, *grips])
    page = recording_html(recording, title="x", facts="", target="mug")
    assert document(page)["grips"] != document(page)["contacts"]
    np.testing.assert_allclose(document(page)["rises"], np.array(heights) - heights[0], atol=1e-5)
    assert "rise of the target" in page
    assert ("contact of the arm; in the curve its time" in page) == any(recording.contacts)


def test_the_pages_bodies_are_where_mujocos_geoms_are() -> None:
    recording, result = recorded()
    values = document(twin_html(recording, result))
    model = recording.world.model
    own, body = unpacked(values["own"], np.float32).reshape(-1, 3), unpacked(values["body"], np.uint16)
    poses = unpacked(values["poses"], np.float32).reshape(len(values["times"]), model.nbody, 3, 4)
    mug = int(model.body("object/mug").id)
    at = poses[-1, mug]
    shown = own[body == mug] @ at[:, :3].T + at[:, 3]
    assert len(shown) > 100
    assert np.linalg.norm(shown - recording.poses[-1, mug, :, 3], axis=1).max() < 0.15
    assert values["contacts"][-1]
    assert {number for number in body if recording.world.of_robot[model.body_geomadr[number]]}


def test_the_path_of_the_tool_is_that_of_mujocos_site() -> None:
    recording, result = recorded()
    seen: list[np.ndarray] = []
    twin = Twin(load_scene("mug_hanging"))
    twin.follow(watch=lambda data, time: seen.append(data.site("tcp").xpos.copy()) if time in recording.times else None)
    path = unpacked(document(twin_html(recording, result))["path"], np.float32).reshape(-1, 3)
    np.testing.assert_allclose(path, np.array(seen), atol=1e-6)


def test_normals_of_moving_points_are_unit_vectors() -> None:
    normals = unpacked(document(twin_html(*recorded()))["normals"], np.int8).reshape(-1, 3) / 127
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=0.02)


def test_the_page_names_all_that_it_draws_and_fits_a_phone(browser: str, tmp_path: Path) -> None:
    page = twin_html(*recorded())
    rows = re.findall(r"<li><i [^>]*></i>([^<]*)</li>", page)
    assert rows[0].startswith("arm and hand")
    assert {"path of the tool", "mug", "clearance of arm and hand, in the curve"} < set(rows)
    with Chromium(tmp_path / "profile", width=360, height=640) as chromium:
        (tmp_path / "run.html").write_text(page)
        for scheme, page_color in (("light", "rgb(238, 240, 243)"), ("dark", "rgb(22, 24, 29)")):
            chromium.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
            chromium.open(f"file://{tmp_path / 'run.html'}")
            wait_until(lambda: chromium.evaluate("document.getElementById('label')?.textContent || ''") != "")
            assert chromium.evaluate("getComputedStyle(document.body).backgroundColor") == page_color
            assert chromium.evaluate("document.documentElement.scrollWidth") <= 360
            assert chromium.evaluate("document.getElementById('view').clientHeight") > 150


def test_the_legend_calls_only_the_named_target_a_completed_surface() -> None:
    recording, result = recorded()
    assert "mug: its completed surface</li>" in recording_html(recording, title="x", facts="", target="mug")
    assert "completed surface" not in twin_html(recording, result)


def test_a_map_is_shown_by_its_gaussians_less_those_that_move(tmp_path: Path) -> None:
    table, carton = Block((0.6, 0.0, -0.02), (0.8, 1.0, 0.04)), Block((0.5, 0.15, 0.06), (0.10, 0.07, 0.12))
    Tabletop((table, carton)).gaussians(8000).save(tmp_path / "map.ply")
    shown, file = {}, str(tmp_path / "map.ply")
    for movable in (False, True):
        twin = Twin(make_scene({"name": "x", "map": {"file": file, "movable": movable, "support": [0, 0, 1, 0]}}))
        recording = TwinRecording(twin.world)
        values = document(twin_html(recording, twin.follow(watch=recording)))
        points = unpacked(values["points"], np.float32).reshape(-1, 3)
        on_top = (np.abs(points - [0.5, 0.15, 0.12]) < [0.05, 0.035, 0.003]).all(axis=1)
        shown[movable] = int(on_top.sum())
    assert shown[False] > 20
    assert shown[True] == 0


@pytest.fixture
def browser(tmp_path: Path) -> str:
    found = shutil.which("chromium") or shutil.which("google-chrome")
    if found is None:
        pytest.skip("no Chromium here")
    return found


@pytest.mark.parametrize(
    ("address", "clicks", "time"),
    [
        ("", "", 0.0),
        ("#t=2.5", "", 2.5),
        ("#t=99", "", 4.0),
        ("#t=1", 'press("on"); press("on"); press("back");', 1.0 + 1 / RECORDING.rate),
        ("", 'press("back");', 4.0),
        ("", 'const s = document.getElementById("time"); s.value = 60; s.dispatchEvent(new Event("input"));', 2.0),
    ],
    ids=["begins", "address", "beyond the end", "steps", "a step back from the start", "scrubs"],
)
def test_a_browser_shows_the_moment_of_the_address(
    browser: str, tmp_path: Path, address: str, clicks: str, time: float
) -> None:
    text = _label(browser, tmp_path, address, clicks)
    assert float(text.split()[0]) == pytest.approx(time, abs=1.5 / RECORDING.rate)
    assert "of 4.00 s, clearance" in text


def test_a_browser_plays_until_it_is_stopped(browser: str, tmp_path: Path) -> None:
    playing = 'press("play"); setTimeout(() => press("play"), 600);'
    assert 0.1 < float(_label(browser, tmp_path, "", playing).split()[0]) < 3.5


def _label(browser: str, folder: Path, address: str, clicks: str) -> str:
    """Return the text next to the slider after some clicks."""
    page = twin_html(*recorded())
    press = f"const press = (id) => document.getElementById(id).click(); {clicks}"
    (folder / "run.html").write_text(page.replace("</body>", f"<script>{press}</script></body>"))
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder / 'profile'}",
               "--virtual-time-budget=3000", "--dump-dom", f"file://{folder / 'run.html'}{address}"]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    found = re.search(r'<span id="label">([^<]*)', done.stdout)
    assert found is not None, done.stderr[-2000:]
    return found.group(1)
