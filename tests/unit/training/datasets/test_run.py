"""Runs of `splatbot map` as datasets."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatbot.config import Config
from splatbot.errors import FormatError, InputError
from splatbot.frame import Frame
from splatbot.gaussians import GaussianModel
from splatbot.geometry import se3_exp
from splatbot.logs import Log, open_log
from splatbot.logs.base import DerivedLog
from splatbot.results.folder import FrameRow, RunFolder
from splatbot.training.datasets import open_dataset
from splatbot.trajectory import Trajectory
from tests.conftest import MakeLog

ROWS = (
    FrameRow(0, 0.0, "ok", keyframe=True),
    FrameRow(1, 1 / 30, "lost"),
    FrameRow(2, 2 / 30, "ok", held_out=True),
    FrameRow(3, 3 / 30, "degraded"),
    FrameRow(4, None, "skipped"),
)


def write_run(folder: Path, log: Path, **source: Any) -> Trajectory:
    """Write a run that tracked frames 0, 2 and 3 of a log, and return its trajectory."""
    tracked = [row for row in ROWS if row.tracked]
    poses = np.array([se3_exp(np.array([0.1 * row.index, 0, 0.02, 0, 0.05 * row.index, 0])) for row in tracked])
    trajectory = Trajectory(np.array([row.stamp for row in tracked]), poses)
    RunFolder.create(folder).save(
        config=Config(),
        rows=ROWS,
        trajectories={"": trajectory},
        model=GaussianModel.empty(),
        metrics={"log": {"uri": str(log), **source}},
    )
    return trajectory


class HalfMasked(DerivedLog):
    """A log whose frames have a masked left half."""

    def _decode(self, index: int) -> Frame:
        frame = self._log[index]
        columns = np.arange(frame.camera.width)
        mask = np.broadcast_to(columns >= frame.camera.width // 2, frame.depth.shape)
        return replace(frame, mask=mask)


@pytest.fixture
def log(make_log: MakeLog) -> Path:
    """A log of five frames."""
    return make_log()


@pytest.fixture
def run(tmp_path: Path, log: Path) -> Path:
    """A run of this log."""
    write_run(tmp_path / "run", log)
    return tmp_path / "run"


def test_views_are_all_tracked_frames_with_images_depth_and_poses(tmp_path: Path, log: Path) -> None:
    trajectory, frames = write_run(tmp_path / "run", log), open_log(log)
    data = open_dataset(tmp_path / "run")
    assert (data.kind, len(data.points)) == ("run", 0)
    assert [view.name for view in data.views] == ["000000", "000002", "000003"]
    for view, index, T in zip(data.views, (0, 2, 3), trajectory.T_world_camera, strict=True):
        np.testing.assert_allclose(view.T_world_camera, T, atol=1e-9)
        assert view.camera == frames.camera
        np.testing.assert_array_equal(view.read(), frames[index].rgb)
        assert view.read_depth is not None
        np.testing.assert_array_equal(view.read_depth(), frames[index].depth)
        assert view.read_mask is not None
        assert not view.read_mask().any()


def test_held_out_frames_of_the_run_are_held_out(run: Path) -> None:
    train, held_out = open_dataset(run).split()
    assert [view.name for view in train] == ["000000", "000003"]
    assert [view.name for view in held_out] == ["000002"]


def test_scaled_depth_keeps_values_and_colour_is_averaged(run: Path, log: Path) -> None:
    frame, view = open_log(log)[2], open_dataset(run, scale=2).views[1]
    assert (view.camera.width, view.camera.height) == (32, 24)
    assert view.camera == frame.camera.resized(32, 24)
    assert view.read_depth is not None
    depth = view.read_depth()
    blocks = frame.depth.reshape(24, 2, 32, 2).swapaxes(1, 2).reshape(24, 32, 4)
    assert (depth[..., None] == blocks).any(axis=2).all()
    means = frame.rgb.reshape(24, 2, 32, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(view.read(), means, atol=0.51)


def test_masked_pixels_of_a_given_log_have_neither_depth_nor_training(run: Path, log: Path) -> None:
    recording: Log = open_log(log)
    view = open_dataset(run, log=HalfMasked(recording)).views[0]
    assert view.read_mask is not None
    assert view.read_depth is not None
    mask = view.read_mask()
    assert mask[:, :32].all()
    assert not mask[:, 32:].any()
    assert not view.read_depth()[mask].any()


def test_pixels_that_undistortion_repeats_are_masked(run: Path, log: Path) -> None:
    intrinsics = log / "intrinsics.json"
    intrinsics.write_text(intrinsics.read_text().replace("}", ', "distortion": [0.3, 0, 0, 0]}'))
    view = open_dataset(run).views[0]
    assert view.read_mask is not None
    assert view.read_mask()[0, 0]
    assert 0 < view.read_mask().mean() < 0.3


def test_run_that_masked_a_robot_needs_its_log(tmp_path: Path, log: Path) -> None:
    write_run(tmp_path / "run", log, robot="panda")
    with pytest.raises(InputError, match=r"metrics\.json: log\.robot: is panda"):
        open_dataset(tmp_path / "run")
    assert len(open_dataset(tmp_path / "run", log=open_log(log)).views) == 3


def test_run_of_another_log_is_refused(run: Path, make_log: MakeLog) -> None:
    with pytest.raises(FormatError, match=r"frames\.jsonl: index: has frame 3, the log .* has only 2"):
        open_dataset(run, log=open_log(make_log(2, name="short")))


def test_log_with_a_scene_of_photographs_is_refused(tmp_path: Path, log: Path) -> None:
    (tmp_path / "transforms.json").touch()
    with pytest.raises(InputError, match="log: is given with a nerfstudio scene"):
        open_dataset(tmp_path, log=open_log(log))
