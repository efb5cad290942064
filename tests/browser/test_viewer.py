"""The viewer and its page as Chromium draws them: colours at pixels whose content is known."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.geometry import inverse, look_at, pose_from_quat, transform_points
from splatbot.planning import Certificate, JointTrajectory
from splatbot.rasterize.views import render_view
from splatbot.report.plan_page import plan_html
from splatbot.robots.appearance import coarse_appearance
from splatbot.robots.store import load_robot
from splatbot.service_key import key_file, read_key
from splatbot.services.access import Access
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore
from splatbot.services.topics import PLAN, RESULT, map_topic
from splatbot.services.viewer.page import map_page
from splatbot.services.viewer.scene import ViewerScene, close_server, open_server
from splatbot.services.viewer.viewer import Viewer
from splatbot.slam import FrameResult
from splatbot.workspace import Workspace
from tests.browser.chromium import Chromium

pytestmark = [pytest.mark.long, pytest.mark.alone]

WIDTH, HEIGHT, FOV = 1100, 480, 50.0  # the panel covers the right 330
EYE, TARGET = np.array([1.6, -1.2, 1.0]), np.array([0.3, 0.0, 0.4])
BASE = pose_from_quat((0.0, 0.0, 0.0), (1, 0, 0, 0))


def _camera() -> Camera:
    f = HEIGHT / 2 / np.tan(np.radians(FOV) / 2)
    return Camera(f, f, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5, WIDTH, HEIGHT)


def _wall(axes: tuple[int, int, int] = (0, 1, 2)) -> GaussianModel:
    """Build a wall behind the robot, across the first of the axes, one half red, the other blue, 2 m wide; opaque."""
    y, z = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 81), np.linspace(-0.4, 1.4, 73)))
    n = len(y)
    red, blue = np.array([0.9, 0.1, 0.1]), np.array([0.1, 0.2, 0.9])
    return GaussianModel.from_activated(
        means=np.stack([np.full(n, -0.6), y, z], -1)[:, axes],
        quats=np.tile([1.0, 0, 0, 0], (n, 1)),
        scales=np.tile([0.002, 0.02, 0.02], (n, 1))[:, axes],
        opacities=np.full(n, 0.99),
        colors=np.where(y[:, None] < 0, red, blue),
    )


def _pixel(point: NDArray[np.float64]) -> tuple[int, int]:
    u, v = _camera().project(transform_points(inverse(look_at(EYE, TARGET)), point))
    return round(float(u)), round(float(v))


def _colour(image: NDArray[np.uint8], point: NDArray[np.float64]) -> NDArray[np.float64]:
    u, v = _pixel(point)
    return np.median(image[v - 2 : v + 3, u - 2 : u + 3].reshape(-1, 3), axis=0)


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Chromium]:
    with Chromium(tmp_path / "profile", width=WIDTH, height=HEIGHT) as found:
        yield found


def _shot(browser: Chromium, sought: NDArray[np.float64], colour: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Capture the page once a point has about a colour, or the last picture if it never does."""
    for _ in range(60):
        time.sleep(0.5)
        image = browser.screenshot()
        if np.abs(_colour(image, sought) - colour).max() < 60:
            time.sleep(1.0)
            return browser.screenshot()
    return image


def _plan(robot_home: NDArray[np.float64], names: tuple[str, ...]) -> JointTrajectory:
    turn = np.linspace(0.0, 0.9, 14)[:, None] * np.eye(7)[0]
    return JointTrajectory(names, robot_home + turn, 0.1, Certificate(False, 1e-3, 0.0, 0.0, 1))


def test_the_viewer_draws_the_splats_as_the_rasterizer_does_and_the_robot_and_its_path(browser: Chromium) -> None:
    store, model, robot = MapStore(), _wall(), load_robot("panda")
    store.add("desk", source="a", state="mapping", snapshot=Snapshot(model, 1), workspace=Workspace(T_world_base=BASE))
    viewer = Viewer(store, Access(ServiceSettings()), port=0)
    viewer._scene._up = np.array([0.0, 0.0, 1.0])
    viewer.server.scene.set_up_direction("+z")
    viewer.start()
    try:
        home = np.asarray(robot.home)
        arm = RobotSpheres(robot, T_world_base=BASE)
        store.bus.publish(map_topic("desk", PLAN), _plan(home, robot.chain.names))
        store.bus.publish(map_topic("desk", RESULT), FrameResult(3, 1.0, None, "lost", stage_ms={"direct": 7.5}))
        time.sleep(1.5)
        viewer._scene.look(EYE, TARGET, fov_deg=FOV)
        browser.open(f"http://127.0.0.1:{viewer.port}/?key={read_key(key_file())}")
        left, right = np.array([-0.6, -0.7, 0.2]), np.array([-0.6, 0.7, 0.9])  # the robot covers neither
        image = _shot(browser, left, np.array([230.0, 26, 26]))
        expected = render_view(model, _camera(), look_at(EYE, TARGET), "rgb")
        for point in (left, right):
            u, v = _pixel(point)
            np.testing.assert_allclose(_colour(image, point) / 255, expected[v, u], atol=0.06)
        largest = int(np.argmax(arm.spheres.radii))
        hand = arm.centers(home[None])[0][largest]
        light = _colour(image, hand)
        assert np.ptp(light) < 40  # a mesh, white or grey
        viewer._scene.display_robot("certified spheres")
        image = _shot(browser, hand, np.array([26.0, 220, 26]))
        assert GaussianCollisionField(model).clearance(hand[None]).distance[0] > 0.1
        red, green, blue = _colour(image, hand)
        assert green > 1.3 * max(red, blue)  # much room: green
        text = browser.evaluate("document.body.innerText")
        assert "direct" in text
        assert "7.5" in text
        q = _plan(home, robot.chain.names).at(0.7 * 1.1).position
        last = int(np.flatnonzero(arm.spheres.link == arm.spheres.link.max())[-1])
        u, v = _pixel(arm.centers(np.asarray(q)[None])[0][last])
        near = image[v - 8 : v + 9, u - 8 : u + 9].reshape(-1, 3).astype(int)
        amber = (near[:, 0] > 180) & (near[:, 1] > 100) & (near[:, 2] < 120)
        assert amber.any()
    finally:
        viewer.stop()


def test_two_clicks_measure_a_distance_and_the_crop_leaves_the_robot_alone(browser: Chromium) -> None:
    store, model = MapStore(), _wall()
    store.add("desk", source="a", state="mapping", snapshot=Snapshot(model, 1), workspace=Workspace(T_world_base=BASE))
    viewer = Viewer(store, Access(ServiceSettings()), port=0)
    viewer._scene._up = np.array([0.0, 0.0, 1.0])
    viewer.server.scene.set_up_direction("+z")
    viewer.start()
    try:
        time.sleep(1.5)
        viewer._scene.look(EYE, TARGET, fov_deg=FOV)
        browser.open(f"http://127.0.0.1:{viewer.port}/?key={read_key(key_file())}")
        ends = np.array([-0.6, -0.7, 0.2]), np.array([-0.6, 0.6, 0.9])
        _shot(browser, ends[0], np.array([230.0, 26, 26]))
        viewer._measure.value = True  # type: ignore[misc]
        for count, end in enumerate(ends, 1):
            browser.click(*_pixel(end))
            for _ in range(30):
                time.sleep(0.5)
                if len(viewer._clicked) == count:
                    break
            assert len(viewer._clicked) == count
        assert np.linalg.norm(viewer._clicked[1] - viewer._clicked[0]) == pytest.approx(np.hypot(1.3, 0.7), abs=0.02)
        for _ in range(20):
            time.sleep(0.3)
            if " mm" in (text := browser.evaluate("document.body.innerText")):
                break
        assert f"{1e3 * np.linalg.norm(viewer._clicked[1] - viewer._clicked[0]):.0f} mm" in text
        viewer._crop.value = 0.5  # type: ignore[misc]  # the wall is 0.6 m from the base
        viewer._stale = True
        gone = _shot(browser, ends[0], np.array([255.0, 255, 255]))
        assert np.abs(_colour(gone, ends[0]) - 255).max() < 60
    finally:
        viewer.stop()


def test_the_page_needs_nothing_else_and_shows_the_same_colours(browser: Chromium, tmp_path: Path) -> None:
    model = _wall((1, 2, 0))  # across the world's z axis, along which a map is looked at
    page = map_page(model, workspace=Workspace(T_world_base=BASE))
    assert "<script src=" not in page
    (tmp_path / "page.html").write_text(page)
    browser.open(f"file://{tmp_path / 'page.html'}")
    for _ in range(40):
        time.sleep(0.5)
        image = browser.screenshot().reshape(-1, 3).astype(int)
        red = ((image[:, 0] > 190) & (image[:, 1] < 80) & (image[:, 2] < 80)).mean()
        blue = ((image[:, 2] > 190) & (image[:, 0] < 80) & (image[:, 1] < 100)).mean()
        if red > 0.05 and blue > 0.05:
            return
    raise AssertionError(f"red on {red:.1%}, blue on {blue:.1%} of the page")


def test_the_page_of_a_plan_shows_meshes_or_certified_spheres(browser: Chromium, tmp_path: Path) -> None:
    robot = load_robot("ur5e-2f85")
    q = np.asarray(robot.home) + np.linspace(0.0, 0.5, 14)[:, None] * np.eye(6)[0]
    plan = JointTrajectory(robot.chain.names, q, 0.1, Certificate(True, 1e-3, 0.0, 0.0, 1))
    model, arm = GaussianModel.empty(), RobotSpheres(robot, T_world_base=np.eye(4))
    parts, field = coarse_appearance(robot), GaussianCollisionField(model)
    (tmp_path / "plan.html").write_text(plan_html(model, arm, field, plan, parts, robot.fk, title="a plan"))
    dark = {"name": "prefers-color-scheme", "value": "dark"}
    browser.call("Emulation.setEmulatedMedia", features=[dark])
    browser.open(f"file://{tmp_path / 'plan.html'}")
    time.sleep(1.0)
    names = browser.evaluate("[...document.querySelectorAll('#legend li')].map((row) => row.textContent).join('; ')")
    assert names == "map, in its own colours; arm, or its certified spheres; path of the tool"
    meshes = browser.screenshot().astype(int)
    browser.evaluate("document.getElementById('toggle').click()")
    time.sleep(0.5)
    spheres = browser.screenshot().astype(int)
    drawn, covered = (image[80:-60].max(axis=2) > 60 for image in (meshes, spheres))
    assert drawn.mean() > 0.01
    assert (drawn & ~covered).sum() < 0.05 * drawn.sum()  # the spheres contain the meshes
    assert covered.sum() > drawn.sum()
    assert browser.evaluate("document.documentElement.scrollWidth <= window.innerWidth")


def test_a_scene_sends_again_only_what_has_changed() -> None:
    server = open_server("127.0.0.1", 0)
    try:
        scene, model = ViewerScene(server), _wall()
        everything = scene.show_map(model)
        assert everything > 5
        assert scene.show_map(model) == 0
        moved = model.clone()
        moved.opacity_logits[0] -= 1.0
        assert scene.show_map(moved) == 1
        assert scene.show_map(model.select(model.means[:, 1] < 0)) < everything
    finally:
        close_server(server)
