"""ATE and RPE against evo, which runs as a program of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.evaluation import absolute_error, align, relative_error
from splatbot.evaluation.trajectory import associate
from splatbot.geometry import inverse, se3_exp, so3_exp
from splatbot.trajectory import Trajectory


def walk(rng: np.random.Generator, n: int = 120, noise: float = 0.0) -> Trajectory:
    """Return a random walk from a random start at 30 Hz."""
    T = se3_exp(rng.normal(size=6))
    poses = []
    for _ in range(n):
        T = T @ se3_exp(rng.normal(size=6) * np.array([0.03] * 3 + [0.05] * 3))
        poses.append(T)
    return Trajectory(1700000000.25 + np.arange(n) / 30, np.array(poses))


def disturbed(trajectory: Trajectory, rng: np.random.Generator) -> Trajectory:
    """Return a trajectory in another world frame, with pose noise of 2 cm and 0.02 rad and stamp noise up to 4 ms."""
    T_other = se3_exp(rng.normal(size=6))
    sigma = np.array([0.02] * 6)
    poses = [T_other @ T @ se3_exp(rng.normal(size=6) * sigma) for T in trajectory.T_world_camera]
    return Trajectory(trajectory.stamps + rng.uniform(-4e-3, 4e-3, len(poses)), np.array(poses))


def evo(tmp_path: Path, command: str, reference: Trajectory, estimate: Trajectory, *flags: str) -> dict[str, float]:
    """Return the statistics that `evo_ape` or `evo_rpe` prints, with all digits."""
    reference.save(tmp_path / "reference.tum")
    estimate.save(tmp_path / "estimate.tum")
    result = tmp_path / f"{command}{len(list(tmp_path.iterdir()))}.zip"
    program = Path(sys.executable).with_name(command)
    files = [str(tmp_path / "reference.tum"), str(tmp_path / "estimate.tum")]
    subprocess.run(
        [str(program), "tum", *files, *flags, "--save_results", str(result), "--no_warnings"],
        check=True,
        capture_output=True,
        env=os.environ | {"HOME": str(tmp_path), "MPLBACKEND": "agg"},
    )
    with zipfile.ZipFile(result) as archive:
        return json.loads(archive.read("stats.json"))


CASES = ["same_frames", "estimate_misses_frames", "reference_misses_frames", "both_miss_frames", "dense_reference"]


def pair(case: str, rng: np.random.Generator) -> tuple[Trajectory, Trajectory]:
    reference = walk(rng)
    estimate = disturbed(reference, rng)
    keep = {True: np.ones(120, bool), False: rng.random(120) < 0.7}
    if case == "dense_reference":  # motion capture: several reference poses within reach of each estimate
        fine = reference.stamps[0] + np.arange(0, 4, 0.007)
        between = np.clip(np.searchsorted(reference.stamps, fine), 0, 119)
        return Trajectory(fine, reference.T_world_camera[between]), estimate
    other = rng.random(120) < 0.6
    return (
        reference.select(keep[case not in ("reference_misses_frames", "both_miss_frames")]),
        estimate.select(other if case in ("estimate_misses_frames", "both_miss_frames") else keep[True]),
    )


@pytest.mark.parametrize("case", CASES)
def test_ate_equals_evo_ape(tmp_path: Path, rng: np.random.Generator, case: str) -> None:
    reference, estimate = pair(case, rng)
    theirs = evo(tmp_path, "evo_ape", reference, estimate, "-a")
    ours = absolute_error(reference, estimate)
    for name in ("rmse", "mean", "median", "max"):
        assert getattr(ours, name) == pytest.approx(theirs[name], abs=1e-9), name
    assert ours.rmse > 0.01  # the noise is there: the agreement is not one of zeros
    assert np.sqrt(np.mean(ours.errors**2)) == pytest.approx(ours.rmse)


@pytest.mark.parametrize("case", CASES)
def test_rpe_equals_evo_rpe(tmp_path: Path, rng: np.random.Generator, case: str) -> None:
    reference, estimate = pair(case, rng)
    flags = ("--delta", "1", "--delta_unit", "f", "-r")
    trans = evo(tmp_path, "evo_rpe", reference, estimate, *flags, "trans_part")
    rot = evo(tmp_path, "evo_rpe", reference, estimate, *flags, "angle_rad")
    ours = relative_error(reference, estimate)
    assert ours.trans_rmse == pytest.approx(trans["rmse"], abs=1e-9)
    assert ours.rot_rmse == pytest.approx(rot["rmse"], abs=1e-9)
    assert len(ours.trans) == len(ours.stamps)


def test_ate_on_a_real_reference_equals_evo_ape(tmp_path: Path, data_root: Path) -> None:
    folder = data_root / "redkitchen_000_199"
    names = ("groundtruth.txt", "groundtruth_kinectfusion.txt")
    reference, estimate = (Trajectory.load(folder / name) for name in names)
    theirs = evo(tmp_path, "evo_ape", reference, estimate, "-a")
    assert absolute_error(reference, estimate).rmse == pytest.approx(theirs["rmse"], abs=1e-9)


def test_another_world_frame_costs_nothing(rng: np.random.Generator) -> None:
    reference = walk(rng)
    T = se3_exp([5.0, -3.0, 2.0, 0.5, -2.0, 1.0])
    estimate = Trajectory(reference.stamps, T @ reference.T_world_camera)
    ate, rpe = absolute_error(reference, estimate), relative_error(reference, estimate)
    assert ate.max < 1e-12
    assert rpe.trans_rmse < 1e-12
    assert rpe.rot_rmse < 1e-12
    np.testing.assert_allclose(ate.T_reference_estimate, inverse(T), atol=1e-12)


def test_scale_is_not_corrected(rng: np.random.Generator) -> None:
    reference = walk(rng)
    scaled = reference.T_world_camera.copy()
    scaled[:, :3, 3] *= 1.1
    spread = np.sqrt(np.mean(np.sum((reference.positions - reference.positions.mean(0)) ** 2, axis=1)))
    ours = absolute_error(reference, Trajectory(reference.stamps, scaled))
    assert ours.rmse == pytest.approx(0.1 * spread, rel=1e-9)


def test_alignment_never_mirrors(rng: np.random.Generator) -> None:
    points = rng.normal(size=(30, 3))
    T = align(points, points * [1, 1, -1])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0, abs=1e-12)
    flat = points * [1, 1, 0]  # a plane leaves the mirror image as good a fit: it must still be a rotation
    R = so3_exp([0.3, -0.2, 0.9])
    T = align(flat @ R.T, flat)
    np.testing.assert_allclose(T[:3, :3], R, atol=1e-12)


def test_each_pose_is_associated_with_the_nearest_within_reach() -> None:
    def at(*stamps: float) -> Trajectory:
        return Trajectory(np.array(stamps), np.tile(np.eye(4), (len(stamps), 1, 1)))

    reference, estimate = associate(at(0.0, 0.1, 0.2, 0.3), at(0.104, 0.305, 0.35))
    assert reference.tolist() == [1, 3]
    assert estimate.tolist() == [0, 1]
    longer, shorter = associate(at(0.5), at(0.1, 0.495, 0.502))
    assert longer.tolist() == [0]
    assert shorter.tolist() == [2]


def test_trajectories_of_different_clocks_are_refused(rng: np.random.Generator) -> None:
    reference = walk(rng)
    other = Trajectory(reference.stamps - 1e9, reference.T_world_camera)
    with pytest.raises(InputError, match="same clock"):
        absolute_error(reference, other)
    with pytest.raises(InputError, match="no poses"):
        absolute_error(reference, Trajectory(np.zeros(0), np.zeros((0, 4, 4))))
    with pytest.raises(InputError, match="needs two"):
        relative_error(reference.select([0]), reference)
