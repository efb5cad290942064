"""The report: self-contained, consistent with the metrics, and explicit about missing data."""

from __future__ import annotations

import base64
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.errors import LogError
from splatbot.logs import Log, open_log
from splatbot.report.figures import bands
from splatbot.report.images import MAX_WIDTH, colour_png, depth_png, difference_png
from splatbot.results.folder import FrameRow, RunFolder
from splatbot.results.units import decibels
from splatbot.run import RunResult, map_log
from splatbot.sim.effects.base import Effects
from splatbot.sim.effects.depth_noise import DepthNoise
from tests.unit.oracle import OracleSlam

MakeLog = Callable[..., Path]
VOID = {"meta", "img", "br", "link", "input", "hr"}


class Page(HTMLParser):
    """Content of a page as a browser finds it: text, images, addresses and unclosed tags."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.text: list[str] = []
        self.images: list[str] = []
        self.addresses: list[str] = []
        self.tags: list[str] = []
        self.open: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag not in VOID:
            self.open.append(tag)
        for name, value in attrs:
            if name in ("src", "href", "action", "data") and value is not None:
                (self.images if value.startswith("data:") else self.addresses).append(value)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)

    @property
    def all_text(self) -> str:
        return " ".join(self.text)


def decode(uri: str) -> NDArray[np.uint8]:
    kind, _, data = uri.partition(",")
    assert kind == "data:image/png;base64"
    return decode_png(base64.b64decode(data))


def decode_png(data: bytes) -> NDArray[np.uint8]:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return np.asarray(image, dtype=np.uint8)


def report(log: Log, out: Path, **kwargs: Any) -> tuple[RunResult, Page]:
    assert log.ground_truth is not None
    result = map_log(log, out=out, slam=OracleSlam(log.ground_truth, **kwargs))
    assert result.signal is None  # else the report is left out
    return result, Page(RunFolder(out).report.read_text())


@pytest.fixture
def log(make_log: MakeLog) -> Log:
    return open_log(make_log(24))


def test_nothing_is_fetched_and_every_picture_is_inside(log: Log, tmp_path: Path) -> None:
    _, page = report(log, tmp_path / "run")
    assert page.addresses == []
    assert "script" not in page.tags
    assert "link" not in page.tags
    assert "url(" not in (tmp_path / "run" / "report.html").read_text()
    assert page.open == []
    assert len(page.images) == 2 + 3 * 5 + 3  # trajectory and error, three views of five pictures, stages, map, audit
    for uri in page.images:
        assert decode(uri).std() > 0


def test_the_headline_numbers_are_those_of_the_metrics(log: Log, tmp_path: Path) -> None:
    result, page = report(log, tmp_path / "run", lost=(4,))
    assert "23/24" in page.all_text
    assert decibels(result.metrics["psnr_holdout_db"]) in page.all_text
    assert f"{result.metrics['gaussians']:,}" in page.all_text
    for text in ("track", "map", "holdout_every: 8", "torch", "lost: told to be lost"):
        assert text in page.all_text


def test_names_and_messages_cannot_inject_markup(make_log: MakeLog, tmp_path: Path) -> None:
    folder = make_log(12, name="<img src=x onerror=alert(1)>")
    log = open_log(folder)
    (folder / "rgb" / "000009.png").write_bytes(b"")
    result, page = report(log, tmp_path / "run")
    assert isinstance(result.error, LogError)
    assert page.addresses == []
    assert "<img src=x onerror=alert(1)>" in page.all_text
    assert "The log ended early." in page.all_text


def test_without_a_reference_the_page_says_so_and_shows_no_error(make_log: MakeLog, tmp_path: Path) -> None:
    folder = make_log(8)
    truth = open_log(folder).ground_truth
    assert truth is not None
    (folder / "groundtruth.txt").unlink()
    map_log(open_log(folder), out=tmp_path / "run", slam=OracleSlam(truth))
    page = Page((tmp_path / "run" / "report.html").read_text())
    assert "Without reference poses" in page.all_text
    assert "Error over time" not in page.all_text


def test_a_run_without_held_out_frames_says_so(make_log: MakeLog, tmp_path: Path) -> None:
    _, page = report(open_log(make_log(5)), tmp_path / "run")
    assert "No held-out view was scored." in page.all_text


def test_a_run_of_one_frame_has_a_report(make_log: MakeLog, tmp_path: Path) -> None:
    _, page = report(open_log(make_log(1)), tmp_path / "run")
    assert "1/1" in page.all_text


def test_simulated_effects_are_named_with_the_reason_and_a_real_sensor_has_none(log: Log, tmp_path: Path) -> None:
    effects = Effects([DepthNoise(why="requested by a test")])
    effects(log.read(0))
    assert log.ground_truth is not None
    for name, account in (("simulated", effects.report()), ("real", [])):
        map_log(log, out=tmp_path / name, slam=OracleSlam(log.ground_truth), effects=account)
    simulated, real = (Page(RunFolder(tmp_path / name).report.read_text()).all_text for name in ("simulated", "real"))
    assert "Simulated sensor effects" in simulated
    assert "requested by a test" in simulated
    assert "Simulated sensor effects" not in real


def test_bands_span_neighbouring_frames_that_are_not_ok() -> None:
    verdicts = ["ok", "lost", "lost", "ok", "degraded", "ok"]
    rows = [FrameRow(i, float(i), verdict) for i, verdict in enumerate(verdicts)]  # type: ignore[arg-type]
    assert bands(rows) == [("lost", 0.5, 2.5), ("degraded", 3.5, 4.5)]


def test_unreadable_frames_fill_the_gap_between_those_with_a_stamp() -> None:
    rows = [
        FrameRow(0, 10.0, "ok"),
        FrameRow(1, None, "skipped"),
        FrameRow(2, None, "skipped"),
        FrameRow(3, 13.0, "ok"),
    ]
    assert bands(rows) == [("skipped", 10.5, 12.5)]
    assert bands([FrameRow(0, None, "skipped")]) == []


def test_missing_depth_is_transparent_and_near_is_red() -> None:
    depth = np.array([[0.0, 1.0, 2.0, 3.0]], dtype=np.float32)
    image = decode_png(depth_png(depth, (1.0, 3.0)))
    assert image[0, :, 3].tolist() == [0, 255, 255, 255]
    near, far = image[0, 1], image[0, 3]
    assert near[2] > near[0]  # OpenCV reads BGRA
    assert far[0] > far[2]


def test_equal_images_differ_by_darkness_and_opposite_ones_by_light() -> None:
    black, white = np.zeros((4, 4, 3), np.uint8), np.full((4, 4, 3), 255, np.uint8)
    assert decode_png(difference_png(white, white)).max() < 10
    assert decode_png(difference_png(black, white)).min() > 120


def test_wide_images_are_made_smaller_and_keep_their_shape_and_colour() -> None:
    wide = np.zeros((720, 1280, 3), np.uint8)
    wide[..., 0] = 200
    image = decode_png(colour_png(wide))
    assert image.shape == (round(720 * MAX_WIDTH / 1280), MAX_WIDTH, 3)
    assert image[0, 0].tolist() == [0, 0, 200]  # red, as BGR
