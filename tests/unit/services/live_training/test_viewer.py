"""A training with its page: the account of time, the same bits, and images of known content."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.geometry import inverse
from splatbot.rasterize import Gaussians, Viewpoints, rasterization_reference
from splatbot.services.live_training import server as serving
from splatbot.services.live_training import viewer as viewing
from splatbot.services.live_training.budget import CONSTANTS as BUDGET
from splatbot.services.live_training.images import draw
from splatbot.services.live_training.requests import LiveRequest
from splatbot.services.live_training.server import LivePage
from splatbot.services.live_training.viewer import LiveTraining
from splatbot.training.datasets import TrainingData
from splatbot.training.folder import TrainingFolder, TrainingSettings
from splatbot.training.options import TrainingOptions
from splatbot.training.session import TrainingSession
from tests.unit.services.live_training.browsers import connect, read_all, receive, want
from tests.unit.training.rendered import CAMERA, rendered_data, true_model
from tests.waiting import until

STEP_S = 0.05


class WorkClock:
    """A clock that moves with the work: a step of the training, and the pixels of a picture."""

    def __init__(self) -> None:
        self.now = 0.0
        self.viewer_s = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture(scope="module")
def data() -> TrainingData:
    return rendered_data(6, points=100)


@pytest.fixture
def page() -> Iterator[LivePage]:
    with LivePage(0) as opened:
        yield opened


def session_of(folder: Path, data: TrainingData, **options: Any) -> TrainingSession:
    given: dict[str, Any] = {"iterations": 60, "background": "random", "strategy": "mcmc", "max_gaussians": 150}
    settings = TrainingSettings(data.folder, 1, 3, TrainingOptions(**given | options))
    place = TrainingFolder(folder)
    place.begin(settings)
    return TrainingSession(data, place, settings)


def pixels(message: dict[str, Any]) -> NDArray[np.uint8]:
    """Decode the image of a message as RGB."""
    image = cv2.imdecode(np.frombuffer(base64.b64decode(message["image"]), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return np.asarray(image[..., ::-1], dtype=np.uint8)


def test_the_share_is_kept_at_each_step_and_pictures_come_and_grow_when_the_camera_rests(
    data: TrainingData, page: LivePage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A picture takes 4 µs a pixel on the clock: 49 ms at the full width of 128, and 28 ms at 96."""
    clock, session = WorkClock(), session_of(tmp_path, data)
    real = viewing.draw

    def slow(session: TrainingSession, request: LiveRequest, width: int) -> Any:
        clock.now += 4e-6 * width * width * CAMERA.height / CAMERA.width
        return real(session, request, width)

    monkeypatch.setattr(viewing, "draw", slow)
    monkeypatch.setattr(serving.time, "thread_time", lambda: 0.0)  # the server runs on another clock
    live = LiveTraining(session, page, "ball", clock=clock)
    widths = []
    with connect(page) as browser:
        receive(browser, "scene")
        want(browser, 0, 640)
        until(lambda: page.clients[0].request is not None, 10)
        for _ in range(400):
            clock.now += STEP_S
            before = clock.now
            session.trainer.step(0.5)
            session.seconds += STEP_S
            live(0.1)
            clock.viewer_s += clock.now - before
            assert clock.viewer_s <= BUDGET.share * clock.now + 1e-9
            if clock.now > before:
                widths.append(receive(browser, "picture")["width"])
            until(lambda: not page.clients[0].waits, 10)
    assert clock.viewer_s > 0.6 * BUDGET.share * clock.now  # the credit is used
    assert (widths[0], max(widths)) == (96, CAMERA.width)
    assert live.budget.spent_s == pytest.approx(clock.viewer_s)
    assert live.budget.used == pytest.approx(live.budget.spent_s / clock.now)


def test_without_a_browser_nothing_is_drawn_or_charged(data: TrainingData, page: LivePage, tmp_path: Path) -> None:
    clock, session = WorkClock(), session_of(tmp_path, data)
    live = LiveTraining(session, page, "ball", clock=clock)
    for _ in range(20):
        clock.now += STEP_S
        session.seconds += STEP_S
        live(0.1)
    assert live.budget.spent_s == 0.0


def test_the_time_of_the_servers_thread_counts(data: TrainingData, page: LivePage, tmp_path: Path) -> None:
    clock = WorkClock()
    live = LiveTraining(session_of(tmp_path, data), page, "ball", clock=clock)
    clock.now += 10
    page.busy_s += 0.25
    live(0.1)
    assert live.budget.spent_s == pytest.approx(0.25)
    assert live.budget.used == pytest.approx(0.025)


@pytest.mark.parametrize("strategy", ["mcmc", "default"])
def test_a_training_has_the_same_bits_with_and_without_a_browser(
    strategy: str, data: TrainingData, page: LivePage, tmp_path: Path
) -> None:
    alone = session_of(tmp_path / "alone", data, strategy=strategy)
    torch.manual_seed(3)
    alone.run()
    seen = session_of(tmp_path / "seen", data, strategy=strategy)
    clock = WorkClock()
    live = LiveTraining(seen, page, "ball", clock=clock)
    drawn = set()
    with connect(page) as browser:
        receive(browser, "scene")
        poses = [view.T_world_camera.ravel().tolist() for view in data.views]

        def observe(loss: float) -> None:
            """Request another view at each third step: its photograph comes, and pictures follow."""
            clock.now += 10.0  # so that each step may draw
            client, step = page.clients[0], seen.trainer.iteration
            earlier = client.request
            want(browser, step // 3 % 6, 128, poses[step % 5] if step % 2 else None)
            until(lambda: client.request is not earlier and not client.waits)
            live(loss)
            read_all(browser)
            drawn.add(client.shown_iteration)

        torch.manual_seed(3)
        seen.run(observe=observe)
    assert drawn - {-1} == {step for step in range(2, 60) if step % 3}
    first, second = alone.trainer.state(), seen.trainer.state()
    assert_same(first, second)
    assert (tmp_path / "alone" / "map.ply").read_bytes() == (tmp_path / "seen" / "map.ply").read_bytes()


def assert_same(first: Any, second: Any) -> None:
    """Compare all tensors and numbers of two states bit for bit."""
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for name in first:
            assert_same(first[name], second[name])
    elif isinstance(first, list | tuple):
        assert len(first) == len(second)
        for a, b in zip(first, second, strict=True):
            assert_same(a, b)
    elif isinstance(first, torch.Tensor):
        assert torch.equal(first, second)
    else:
        assert first == second


def test_a_picture_is_the_map_as_the_float64_reference_renders_it(data: TrainingData, tmp_path: Path) -> None:
    session = session_of(tmp_path, data, background="white")
    session.trainer.model = model = true_model()
    pose = data.views[2].T_world_camera
    picture = draw(session, LiveRequest(0, 96, pose), 96)
    camera = CAMERA.resized(96, 72)
    renders, alphas, _ = rasterization_reference(
        Gaussians(
            model.means.double(),
            model.quats.double(),
            model.scales.double(),
            model.opacities.double(),
            model.colors.double(),
        ),
        Viewpoints(torch.from_numpy(inverse(pose))[None], torch.from_numpy(camera.K_corner)[None], 96, 72),
        render_mode="RGB+ED",
    )
    expected = renders[0, ..., :3] + (1 - alphas[0])
    np.testing.assert_allclose(picture.image / 255, expected.clamp(0, 1).numpy(), atol=1.5 / 255)
    np.testing.assert_allclose(picture.pose, pose, atol=1e-12)
    assert picture.distance == pytest.approx(float(renders[0, 24:48, 32:64, 3].median()), abs=0.1)


def test_a_view_beyond_the_map_turns_about_the_extent_of_the_scene(data: TrainingData, tmp_path: Path) -> None:
    session = session_of(tmp_path, data)
    away = np.eye(4)
    away[:3, 3] = 500.0
    picture = draw(session, LiveRequest(0, 64, away), 64)
    assert picture.distance == session.trainer.extent
    assert picture.image.max() == 0


def test_a_browser_gets_the_photograph_the_curves_and_at_last_the_end(
    data: TrainingData, page: LivePage, tmp_path: Path
) -> None:
    clock = WorkClock()
    session = session_of(tmp_path, data, background="white")
    live = LiveTraining(session, page, "ball", clock=clock)
    with connect(page) as browser:
        scene = receive(browser, "scene")
        assert [row[0] for row in scene["views"]] == ["001", "002", "004", "005", "000", "003"]
        assert (scene["trained"], scene["views"][0][1:]) == (4, [CAMERA.width, CAMERA.height, CAMERA.fx])
        np.testing.assert_allclose(scene["up"], np.array([0, 0, 1]), atol=0.05)
        want(browser, 5, 640)  # the held-out view 003
        until(lambda: page.clients[0].request is not None, 10)

        def observe(loss: float) -> None:
            clock.now += 1.0
            live(loss)

        session.seconds = 5.0
        session.run(observe=observe)
        photo = receive(browser, "photo")
        straight = data.views[3].read().astype(float)
        alpha = straight[..., 3:] / 255
        error = pixels(photo).astype(float) - (straight[..., :3] * alpha + 255 * (1 - alpha))
        assert np.abs(error).mean() < 4  # of JPEG
        live.end()
        last = receive(browser, "status")
        while not last["ended"]:
            last = receive(browser, "status")
    assert (last["iteration"], last["share"], last["remaining_s"]) == (60, 1.0, 0.0)
    assert last["gaussians"] == len(session.trainer.model)
    assert last["most_viewer_share"] == BUDGET.share
    assert [row[1] for row in last["psnr"]] == [row.psnr_db for row in session.rows]


def test_a_photograph_that_cannot_be_read_is_named_and_the_map_is_drawn(
    data: TrainingData, page: LivePage, tmp_path: Path
) -> None:
    def broken() -> NDArray[np.uint8]:
        raise InputError("is damaged.", file="000.png", hint="restore it")

    session = session_of(tmp_path, replace(data, views=(replace(data.views[0], read=broken), *data.views[1:])))
    clock = WorkClock()
    live = LiveTraining(session, page, "ball", clock=clock)
    with connect(page) as browser:
        receive(browser, "scene")
        want(browser, 4, 128)
        until(lambda: page.clients[0].request is not None, 10)
        for _ in range(4):
            clock.now += 10.0
            session.trainer.step(0.5)
            live(0.1)
            until(lambda: not page.clients[0].waits, 10)
        assert "000.png: is damaged." in receive(browser, "problem")["text"]
        assert pixels(receive(browser, "picture")).shape == (96, 128, 3)


def test_the_pose_of_a_training_view_is_the_refined_one(data: TrainingData, tmp_path: Path) -> None:
    session = session_of(tmp_path, data, refine_poses=True)
    moved = np.eye(4)
    moved[0, 3] = 0.1
    session.trainer.poses.viewmats[1] = torch.from_numpy(moved)
    picture = draw(session, LiveRequest(1, 64, None), 64)
    np.testing.assert_allclose(picture.pose, inverse(moved), atol=1e-12)
    held_out = draw(session, LiveRequest(4, 64, None), 64)
    np.testing.assert_allclose(held_out.pose, data.views[0].T_world_camera, atol=1e-12)
