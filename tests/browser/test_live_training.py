"""The page of a training in Chromium: the map next to the photograph, the mouse, the curves, the end."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatbot.service_key import key_file, read_key
from splatbot.services.live_training.budget import ViewerBudgetConstants
from splatbot.services.live_training.server import LivePage
from splatbot.services.live_training.viewer import LiveTraining
from splatbot.training.folder import TrainingFolder, TrainingSettings
from splatbot.training.options import TrainingOptions
from splatbot.training.session import TrainingSession
from tests.browser.chromium import Chromium
from tests.unit.training.rendered import rendered_data, true_model
from tests.waiting import until

pytestmark = [pytest.mark.long, pytest.mark.alone]


class RunningTraining:
    """A training of the true Gaussians in a thread, until :meth:`end`."""

    def __init__(self, folder: Path, page: LivePage) -> None:
        data = rendered_data(16)
        options = TrainingOptions(iterations=10**6, strategy="fixed", background="white", coarse_share=0.0)
        settings, place = TrainingSettings(data.folder, 1, 8, options), TrainingFolder(folder)
        place.begin(settings)
        self._session = TrainingSession(data, place, settings, start=true_model())
        self._live, self._ended = LiveTraining(self._session, page, "<ball>"), threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        self._session.run(stop=self._ended.is_set, observe=self._live)
        self._live.end()

    def end(self) -> None:
        """End the training, and announce it."""
        self._ended.set()
        self._thread.join()


@pytest.fixture
def shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[RunningTraining, Chromium]]:
    """A training and the browser that shows it, with half of the time: the browser takes processors from both."""
    monkeypatch.setattr("splatbot.services.live_training.budget.CONSTANTS", ViewerBudgetConstants(share=0.5))
    with LivePage(0) as page, Chromium(tmp_path / "profile", width=1100, height=900) as browser:
        training = RunningTraining(tmp_path / "training", page)
        try:
            browser.open(f"http://127.0.0.1:{page.port}/?key={read_key(key_file())}")
            ready = "typeof at == 'function' && typeof drawn != 'undefined' && drawn != null && !at('photo').hidden"
            until(lambda: browser.evaluate(ready))
            yield training, browser
        finally:
            training.end()


def drag(browser: Chromium, right: int, down: int) -> None:
    """Move the mouse over the map with the left button pressed [px]."""
    x, y = browser.evaluate(
        "(({x, y, width, height}) => [x + width / 2, y + height / 2])(orbit.getBoundingClientRect())"
    )
    browser.call("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, button="left", clickCount=1)
    for share in (0.5, 1.0):
        place = {"x": x + share * right, "y": y + share * down}
        browser.call("Input.dispatchMouseEvent", type="mouseMoved", button="left", buttons=1, **place)
    browser.call("Input.dispatchMouseEvent", type="mouseReleased", button="left", clickCount=1, **place)


def pose(browser: Chromium, expression: str) -> Any:
    return np.reshape(browser.evaluate(expression), (4, 4))


def test_the_map_is_next_to_its_photograph_and_nothing_comes_from_elsewhere(
    shown: tuple[RunningTraining, Chromium],
) -> None:
    _, browser = shown
    until(lambda: browser.evaluate("drawn.width") == 128)
    script = """(() => [...document.querySelectorAll(".frame img")].map((image) => {
      const canvas = Object.assign(document.createElement("canvas"), {width: 64, height: 48});
      const pen = canvas.getContext("2d");
      pen.drawImage(image, 0, 0, 64, 48);
      return [...pen.getImageData(0, 0, 64, 48).data];
    }))()"""
    picture, photo = np.array(browser.evaluate(script), dtype=float)
    assert np.abs(picture - photo).mean() < 6
    assert photo.std() > 20
    assert browser.evaluate("at('name').textContent") == "Training <ball>"
    groups = browser.evaluate("[...document.querySelectorAll('optgroup')].map((g) => g.label)")
    assert groups == ["training (14)", "held out (2)"]
    origins = browser.evaluate("performance.getEntriesByType('resource').map((e) => new URL(e.name).origin)")
    assert set(origins) <= {browser.evaluate("location.origin")}
    until(lambda: browser.evaluate("document.querySelectorAll('#loss-chart .curve').length") == 1)


def test_the_mouse_turns_the_camera_about_the_surface_and_the_button_brings_it_back(
    shown: tuple[RunningTraining, Chromium],
) -> None:
    _, browser = shown
    before, distance = pose(browser, "drawn.pose"), browser.evaluate("drawn.distance")
    pivot = before[:3, 3] + distance * before[:3, 2]
    drag(browser, 120, 40)  # the surface follows the mouse: the camera goes left and up
    until(
        lambda: browser.evaluate("drawn.own_pose === false && drawn.pose.every((v, i) => Math.abs(v - pose[i]) < 1e-9)")
    )
    after = pose(browser, "drawn.pose")
    motion = after[:3, 3] - before[:3, 3]
    assert motion @ before[:3, 0] < -0.1
    assert motion @ before[:3, 1] < -0.05
    np.testing.assert_allclose(after[:3, :3] @ after[:3, :3].T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(after[:3, 3] + distance * after[:3, 2], pivot, atol=1e-6)
    browser.evaluate("at('reset').click()")
    until(lambda: browser.evaluate("drawn.own_pose"))
    np.testing.assert_allclose(pose(browser, "drawn.pose"), before)
    browser.evaluate("at('next').click()")
    until(lambda: browser.evaluate("drawn != null && drawn.view === 15 && !at('photo').hidden"))


def test_a_hidden_page_leaves_and_comes_back_and_the_end_is_shown(shown: tuple[RunningTraining, Chromium]) -> None:
    training, browser = shown
    browser.evaluate("Object.defineProperty(document, 'hidden', {value: true, configurable: true})")
    browser.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    until(lambda: browser.evaluate("socket === null"))
    browser.evaluate("Object.defineProperty(document, 'hidden', {value: false})")
    browser.evaluate("drawn = null")
    browser.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    until(lambda: browser.evaluate("drawn != null"))
    training.end()
    until(lambda: "has ended" in browser.evaluate("at('state').textContent"))
    assert browser.evaluate("at('state').classList.contains('lost')") is False


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_fits_a_phone_and_its_text_is_legible(shown: tuple[RunningTraining, Chromium], scheme: str) -> None:
    _, browser = shown
    browser.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
    browser.call("Emulation.setDeviceMetricsOverride", width=360, height=780, deviceScaleFactor=1, mobile=True)
    assert browser.evaluate("document.documentElement.scrollWidth") <= 360
    script = "getComputedStyle(document.{0}).{1}.match(/\\d+/g).slice(0, 3).map(Number)"
    ink, paper = (
        np.array(browser.evaluate(script.format(*of))) for of in (("body", "color"), ("body", "backgroundColor"))
    )
    assert np.abs(ink - paper).min() > 150
    assert (ink < paper).all() == (scheme == "light")
