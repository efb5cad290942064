"""One recording in each log format: info describes it, and mapping gives the trajectory of its TUM form."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from splatbot.cli import main
from splatbot.frame import Frame
from splatbot.trajectory import Trajectory
from tests.unit.logs.published import (
    Pose,
    encoded,
    intrinsics,
    units,
    write,
    write_colmap,
    write_nerfstudio,
    write_open3d,
    write_record3d,
    write_scannet_export,
    write_sens,
    write_seven_scenes,
)

Scene = tuple[list[Frame], list[Pose]]
FRAMES = 3
EXACT, JPEG, LOSSY = 1e-4, 1e-3, 1e-3  # [m]


def write_tum(folder: Path, frames: list[Frame], _poses: list[Pose]) -> Path:
    """Write the TUM layout, as its documentation defines it."""
    for part in ("rgb", "depth"):
        lines = [f"{frame.stamp!r} {part}/{n}.png" for n, frame in enumerate(frames)]
        write(folder / f"{part}.txt", "\n".join(lines))
        for n, frame in enumerate(frames):
            write(folder / f"{part}/{n}.png", encoded(frame.rgb if part == "rgb" else units(frame)))
    write(folder / "intrinsics.json", json.dumps(intrinsics(frames[0])))
    return folder


def seven_scenes(folder: Path, frames: list[Frame], poses: list[Pose]) -> Path:
    """Write a 7-Scenes sequence with the intrinsics of its small images."""
    write(folder / "intrinsics.json", json.dumps(intrinsics(frames[0])))
    return write_seven_scenes(folder, frames, poses)


def lerobot_images(folder: Path, frames: list[Frame], _poses: list[Pose]) -> Path:
    """Write a LeRobot dataset of images."""
    return lerobot(folder, frames)


def lerobot_videos(folder: Path, frames: list[Frame], _poses: list[Pose]) -> Path:
    """Write a LeRobot dataset of videos, which round depth and colour."""
    return lerobot(folder, frames, video=True)


def lerobot(folder: Path, frames: list[Frame], *, video: bool = False) -> Path:
    for package in ("av", "pyarrow"):
        pytest.importorskip(package, reason=f"{package} (extra lerobot) is not installed")
    from tests.unit.logs.lerobot_dataset import WRIST, write_lerobot

    return write_lerobot(folder, {WRIST: [frames]}, video=video)


def mapped(log: Path, out: Path) -> Trajectory:
    """Map the first frames of a log by the command."""
    options = ["--max-frames", str(FRAMES), "--no-report", "--quiet", "--set", "mapping.final_iterations=0"]
    assert main(["map", str(log), "--out", str(out), *options]) == 0
    return Trajectory.load(out / "trajectory.tum")


@pytest.fixture(scope="module")
def tum_trajectory(tmp_path_factory: pytest.TempPathFactory, scene: Scene) -> Trajectory:
    place = tmp_path_factory.mktemp("tum")
    return mapped(write_tum(place / "log", *scene), place / "run")


@pytest.mark.parametrize(
    ("writer", "tolerance", "has_poses"),
    [
        (seven_scenes, EXACT, True),
        (write_open3d, EXACT, False),
        (write_scannet_export, JPEG, True),
        (write_sens, JPEG, True),
        (write_record3d, JPEG, True),
        (write_nerfstudio, EXACT, True),
        (write_colmap, EXACT, True),
        (lerobot_images, EXACT, False),
        (lerobot_videos, LOSSY, False),
    ],
)
def test_each_format_gives_the_trajectory_of_the_tum_form(
    tmp_path: Path,
    scene: Scene,
    tum_trajectory: Trajectory,
    capsys: pytest.CaptureFixture[str],
    writer: Callable[[Path, list[Frame], list[Pose]], Path],
    tolerance: float,
    has_poses: bool,
) -> None:
    log = writer(tmp_path / "log", *scene)
    assert main(["info", str(log)]) == 0
    described = capsys.readouterr().out
    assert "160x120" in described
    assert ("6, path" in described) == has_poses
    found = mapped(log, tmp_path / "run")
    assert len(found) == len(tum_trajectory) == FRAMES
    errors = np.linalg.norm(found.positions - tum_trajectory.positions, axis=1)
    assert errors.max() <= tolerance
    np.testing.assert_allclose(
        found.T_world_camera[:, :3, :3], tum_trajectory.T_world_camera[:, :3, :3], atol=2 * tolerance
    )
