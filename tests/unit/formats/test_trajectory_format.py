"""TUM trajectories: round trips and damaged files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatbot.errors import FormatError
from splatbot.geometry import se3_exp
from splatbot.trajectory import Trajectory


def test_a_written_trajectory_reads_back_with_exact_stamps(tmp_path: Path, rng: np.random.Generator) -> None:
    poses = np.array([se3_exp(rng.normal(size=6) * 2) for _ in range(40)])
    stamps = 1305031102.175304 + np.cumsum(rng.uniform(0.01, 0.05, 40))
    Trajectory(stamps, poses).save(tmp_path / "t.tum")
    back = Trajectory.load(tmp_path / "t.tum")
    assert np.array_equal(back.stamps, stamps)
    np.testing.assert_allclose(back.T_world_camera, poses, atol=1e-11)


def test_the_columns_are_translation_then_xyzw(tmp_path: Path) -> None:
    (tmp_path / "t.tum").write_text("# c\n\n1.5 1 2 3 0.1 0.2 0.3 0.9\n2.5,4,5,6,0,0,0,2\n")
    trajectory = Trajectory.load(tmp_path / "t.tum")
    expected = Rotation.from_quat([0.1, 0.2, 0.3, 0.9]).as_matrix()
    assert trajectory.stamps.tolist() == [1.5, 2.5]
    assert trajectory.positions.tolist() == [[1, 2, 3], [4, 5, 6]]
    np.testing.assert_allclose(trajectory.T_world_camera[0, :3, :3], expected, atol=1e-15)
    assert np.array_equal(trajectory.T_world_camera[1, :3, :3], np.eye(3))


@pytest.mark.parametrize(
    "line",
    ["2 0 0 0 0 0 0", "2 0 0 0 0 0 0 one", "2 0 nan 0 0 0 0 1", "2 0 0 0 0 0 0 0", "1 0 0 0 0 0 0 1"],
)
def test_a_malformed_line_is_named(tmp_path: Path, line: str) -> None:
    path = tmp_path / "t.tum"
    path.write_text(f"# heading\n1 0 0 0 0 0 0 1\n{line}\n3 0 0 0 0 0 0 1\n")
    with pytest.raises(FormatError) as caught:
        Trajectory.load(path)
    assert (caught.value.file, caught.value.field) == (str(path), "line 3")
    assert caught.value.hint


def test_a_missing_or_empty_file_is_a_format_error(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="No such file"):
        Trajectory.load(tmp_path / "none.tum")
    Trajectory(np.zeros(0), np.zeros((0, 4, 4))).save(tmp_path / "empty.tum")
    with pytest.raises(FormatError, match="no poses"):
        Trajectory.load(tmp_path / "empty.tum")
