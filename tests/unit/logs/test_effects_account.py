"""Effects of synthetic logs: equal addresses give equal bits, and recordings keep the records of the effects."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from splatbot.errors import LogError
from splatbot.logs import open_log
from splatbot.logs.effects import read_account, write_account
from splatbot.logs.synthetic import SyntheticLog, SyntheticOptions, synthetic_uri

SMALL = "synthetic:tabletop?frames=12&width=80&height=60"
HARD = f"{SMALL}&effects=motion_blur;exposure:step=2,at=6;depth_noise;depth_holes:share=0.3"


def test_frames_go_through_the_effects_that_the_address_names() -> None:
    plain, hard = open_log(SMALL), open_log(HARD)
    assert hard[3].valid.mean() <= 0.7
    assert plain[3].valid.all()
    assert hard[8].rgb.mean() > 1.4 * plain[8].rgb.mean()
    assert [row["name"] for row in hard.effects] == ["motion_blur", "exposure", "depth_noise", "depth_holes"]
    assert hard.effects[1]["settings"]["at"] == 6
    assert plain.effects == []


def test_a_frame_depends_on_seed_and_index_alone() -> None:
    a, b, other = open_log(HARD), open_log(HARD), open_log(f"{HARD}&seed=1")
    _ = a[2]
    for i in (0, 7):
        assert np.array_equal(a[i].rgb, b[i].rgb)
        assert np.array_equal(a[i].depth, b[i].depth)
        assert not np.array_equal(a[i].depth, other[i].depth)


def test_dropped_frames_leave_a_shorter_log_with_gaps_in_its_stamps() -> None:
    plain = open_log(f"{SMALL}&frames=40")
    log = open_log(f"{SMALL}&frames=40&effects=frame_drops:rate=0.3")
    assert 15 < len(log) < 40
    assert [frame.index for frame in log] == list(range(len(log)))
    stamps = [frame.stamp for frame in log]
    assert set(stamps) < {frame.stamp for frame in plain}
    assert max(np.diff(stamps)) > 1.5 / 30
    assert log.ground_truth is not None
    assert len(log.ground_truth) == 40  # the reference does not know of drops
    assert np.array_equal(log[-1].rgb, next(f for f in plain if f.stamp == stamps[-1]).rgb)


def test_an_address_made_of_options_opens_a_log_with_those_options() -> None:
    options = SyntheticOptions("arm", 33, 64, 48, 15.0, 20.0, 0.5, 7, "exposure:step=2,at=40;depth_noise")
    log = open_log(synthetic_uri("tabletop", options))
    assert isinstance(log, SyntheticLog)
    assert log.options == options
    assert synthetic_uri("room", SyntheticOptions()) == "synthetic:room"


def test_the_account_of_a_recording_is_read_back(make_log: Callable[..., Path]) -> None:
    folder = make_log(3)
    assert open_log(folder).effects == []
    rows = [{"name": "depth_noise", "why": "requested", "settings": {"step": 0.1}, "frames": 3, "ms_per_frame": 1.5}]
    write_account(folder, uri="synthetic:tabletop", effects=rows, blanks_depth=False)
    assert open_log(folder).effects == rows


@pytest.mark.parametrize("content", ["", "[]", '{"effects": [{"name": 3}]}', '{"effects": 1}', '{"effects": [[]]}'])
def test_a_damaged_account_is_named(make_log: Callable[..., Path], content: str) -> None:
    folder = make_log(2)
    (folder / "effects.json").write_text(content)
    with pytest.raises(LogError) as caught:
        open_log(folder)
    assert caught.value.file == str(folder / "effects.json")
    assert caught.value.hint


def test_frames_without_any_depth_are_an_error_unless_the_account_announces_them(make_log: Callable[..., Path]) -> None:
    folder = make_log(3)
    (folder / "depth/000000.png").write_bytes(_blank_png())
    with pytest.raises(LogError, match="no valid depth"):
        open_log(folder).read(0)
    write_account(folder, uri="", effects=[], blanks_depth=True)
    assert not open_log(folder)[0].valid.any()
    assert read_account(folder) == ([], True)
    assert json.loads((folder / "effects.json").read_text())["blanks_depth"] is True


def _blank_png() -> bytes:
    import cv2

    from tests.conftest import HEIGHT, WIDTH

    return bytes(cv2.imencode(".png", np.zeros((HEIGHT, WIDTH), np.uint16))[1])
