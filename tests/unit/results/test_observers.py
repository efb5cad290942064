"""Where Gaussians were seen from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from splatbot.config import Config
from splatbot.gaussians import GaussianModel
from splatbot.results.folder import FrameRow, RunFolder
from splatbot.results.observers import observers
from splatbot.trajectory import Trajectory


def test_a_gaussian_was_seen_by_the_keyframe_that_made_it(tmp_path: Path) -> None:
    """Keyframes are frames 0 and 2; frame 1 is lost."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [0.0, 2.0, 3.0]
    rows = [
        FrameRow(0, 0.0, "ok", keyframe=True),
        FrameRow(1, 0.1, "lost"),
        FrameRow(2, 0.2, "ok", keyframe=True),
        FrameRow(3, 0.3, "ok"),
    ]
    model = GaussianModel.from_activated(
        means=np.zeros((4, 3)),
        quats=np.tile([1.0, 0, 0, 0], (4, 1)),
        scales=np.full((4, 3), 0.01),
        opacities=np.full(4, 0.9),
        colors=np.full((4, 3), 0.5),
    )
    model.anchors[:] = torch.tensor([1, 0, -1, 7], dtype=torch.int32)
    run = RunFolder.create(tmp_path / "run")
    run.save(
        config=Config(),
        rows=rows,
        trajectories={"": Trajectory(np.array([0.0, 0.2, 0.3]), poses)},
        model=model,
        metrics={},
    )
    found = observers(run, model)
    np.testing.assert_array_equal(found[:2], [[2.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert np.isnan(found[2:]).all()
