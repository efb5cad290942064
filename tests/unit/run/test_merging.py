"""Merged and compared runs: trajectory, map and changed objects against recorded and simulated truth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from splatbot.cli import main
from splatbot.config import Config
from splatbot.errors import FormatError, InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse
from splatbot.logs import open_log
from splatbot.mapping.alignment import MapAlignment
from splatbot.results.folder import RunFolder
from splatbot.run import map_log
from splatbot.run.comparing import compare_runs
from splatbot.run.merging import align_runs, merge_runs, merged_slam
from splatbot.run.state import SavedRun
from splatbot.slam import Slam
from tests.changed_scenes import SceneLog, matches, reported_places, scene_pair

pytestmark = pytest.mark.long

REDKITCHEN = Path(__file__).parents[4] / "shared" / "data" / "redkitchen_000_199"
BEFORE = "synthetic:tabletop?frames=30&rate=6&width=160&height=120"
AFTER = "synthetic:tabletop_removed?event=0&frames=30&rate=6&width=160&height=120&trajectory=arm"
QUICK = Config.model_validate({"mapping": {"refine_iterations": 2, "final_iterations": 3}})


def _map(log: str, out: Path, config: Config = QUICK) -> Path:
    map_log(open_log(log), out=out, config=config, save_every=1e9, report=False)
    return out


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Runs of a table top before and after its carton is removed, on two paths."""
    folder = tmp_path_factory.mktemp("runs")
    return _map(BEFORE, folder / "a"), _map(AFTER, folder / "b")


@pytest.fixture(scope="module")
def merged(runs: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The merged run."""
    out = tmp_path_factory.mktemp("merged") / "c"
    assert main(["merge", *map(str, runs), "--out", str(out), "--no-report", "--quiet"]) == 0
    return out


def _carton_in(run: Path) -> int:
    """Count the Gaussians of a map that lie in the carton, above the table."""
    T_scene_first = _first_pose(BEFORE)
    means = GaussianModel.load(run / "map.ply").means.numpy() @ T_scene_first[:3, :3].T + T_scene_first[:3, 3]
    return int(((means > [-0.31, -0.04, 0.02]) & (means < [-0.13, 0.14, 0.14])).all(axis=1).sum())


def _first_pose(log: str) -> np.ndarray:
    truth = open_log(log).ground_truth
    assert truth is not None
    return truth.T_world_camera[0]


def test_the_merged_map_has_no_object_that_the_later_run_saw_through(runs: tuple[Path, Path], merged: Path) -> None:
    assert _carton_in(runs[0]) > 100
    assert _carton_in(merged) <= 0.02 * _carton_in(runs[0])


def test_the_merged_trajectory_is_that_of_both_runs_in_one_world(merged: Path) -> None:
    poses = RunFolder(merged).load_poses()
    T_first_scene = inverse(_first_pose(BEFORE))
    for log, begin in ((BEFORE, 0), (AFTER, 30)):
        truth = open_log(log).ground_truth
        assert truth is not None
        for index, T in enumerate(truth.T_world_camera):
            assert np.linalg.norm((T_first_scene @ T)[:3, 3] - poses[begin + index][:3, 3]) < 0.01


def test_the_merged_run_is_a_run_for_every_other_command(
    merged: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["info", str(merged)]) == 0
    assert main(["eval", str(merged)]) == 0
    assert main(["audit", str(merged), "--json"]) == 0
    assert main(["render", str(merged), "--size", "80x60", "--out", str(tmp_path / "a.png")]) == 0
    capsys.readouterr()
    summary = json.loads((merged / "merge.json").read_text())
    assert summary["keyframes_agreeing"] >= 3
    assert summary["gaussians_removed"] > 40
    assert 0.3 < summary["overlap"] <= 1.0
    assert 0 < summary["T_a_b"]["translation_sigma_m"] < 0.02


def test_a_new_log_is_localised_in_the_merged_map_and_a_merged_run_is_merged_again(
    runs: tuple[Path, Path], merged: Path, tmp_path: Path
) -> None:
    result = map_log(
        open_log(AFTER + "&seed=3"), out=tmp_path / "localised", localise=SavedRun.load(merged), report=False
    )
    assert result.metrics["tracked"] >= 28
    again = merge_runs(align_runs(merged, runs[1]), out=tmp_path / "again", report=False)
    assert again.run.metrics["tracked"] == 90
    assert again.joined.overlap > 0.9  # the merged map has all of it


def test_the_difference_of_two_runs_is_the_removed_carton(
    runs: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["diff", *map(str, runs), "--json", "--quiet", "--out", str(tmp_path / "a.png")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [change["kind"] for change in found["objects"]] == ["removed"]
    center = _first_pose(BEFORE) @ [*found["objects"][0]["center_m"], 1.0]
    assert np.linalg.norm(center[:3] - [-0.22, 0.05, 0.06]) < 0.05
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert main(["diff", str(runs[0]), str(runs[0]), "--aligned", "--out", str(tmp_path / "b.png")]) == 0
    assert "no object differs" in capsys.readouterr().out


def test_wrong_runs_are_refused_and_nothing_is_written(
    runs: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    room = _map("synthetic:room?frames=8&rate=6&width=160&height=120", tmp_path / "room")
    out = tmp_path / "out"
    assert main(["merge", str(runs[0]), str(room), "--out", str(out), "--quiet"]) == 2
    assert "overlap: only" in capsys.readouterr().err
    assert not out.exists()
    with pytest.raises(FormatError):
        align_runs(tmp_path, runs[0])
    with pytest.raises(InputError, match="holds a run already"):
        merge_runs(align_runs(*runs), out=room)
    assert main(["diff", str(tmp_path), str(runs[0])]) == 2


def test_a_joined_map_has_the_stamp_of_the_last_keyframe_of_the_later_map(tmp_path: Path) -> None:
    log = "synthetic:tabletop?frames=3&width=160&height=120"
    a, b = (SavedRun.load(_map(log, tmp_path / name)) for name in ("a", "b"))
    alignment = MapAlignment(np.eye(4), np.zeros((6, 6)), {}, 1, 1)
    slam, _ = merged_slam(a, b, alignment, first_index=3, time_offset=100.0)
    last = max(result.stamp for result in slam.results if result.keyframe)
    assert last >= 100.0
    assert slam.snapshot().stamp == pytest.approx(last)


def test_a_merged_state_has_the_keyframes_of_both(runs: tuple[Path, Path], merged: Path) -> None:
    slams: list[Slam] = [SavedRun.load(run).slam for run in (*runs, merged)]
    counts = [len(slam.keyframes) for slam in slams]
    assert counts[2] == counts[0] + counts[1]
    numbers = [keyframe.number for keyframe in slams[2].keyframes]
    assert numbers == sorted(set(numbers))
    anchors = set(slams[2].snapshot().model.anchors.tolist())
    assert anchors & {n for n in numbers if n > slams[0].keyframes[-1].number}


def test_changed_objects_of_mapped_pairs_have_precision_and_recall_of_95_percent(tmp_path: Path) -> None:
    right, reported, true = 0, 0, 0
    for seed in range(4):
        pair = scene_pair(seed)
        a = SceneLog(pair.before, "orbit", seed=seed, frames=45)
        b = SceneLog(pair.after, "arm", seed=seed + 100, start=1.0, frames=45)
        before, after = tmp_path / f"{seed}a", tmp_path / f"{seed}b"
        for log, folder in ((a, before), (b, after)):
            map_log(log, out=folder, config=QUICK, save_every=1e9, report=False)
        found = reported_places(compare_runs(before, after).objects, a.ground_truth.T_world_camera[0])
        right, reported, true = right + matches(found, pair.places), reported + len(found), true + len(pair.places)
    print(f"precision {right / reported:.3f}, recall {right / true:.3f} of {true} places")
    assert right / reported >= 0.95
    assert right / true >= 0.95


@pytest.mark.skipif(not REDKITCHEN.is_dir(), reason="needs ../shared/data/redkitchen_000_199")
def test_the_error_of_two_merged_halves_of_redkitchen_is_within_1_2_times_that_of_one_run(tmp_path: Path) -> None:
    one = _map(str(_part(tmp_path / "all", slice(0, 200, 2))), tmp_path / "one")
    halves = [
        _map(str(_part(tmp_path / f"log{n}", slice(100 * n, 100 * n + 100, 2))), tmp_path / f"half{n}") for n in (0, 1)
    ]
    found = merge_runs(align_runs(halves[0], halves[1]), out=tmp_path / "merged", report=False)
    errors = RunFolder(one).load_metrics()["ate_rmse_m"], found.run.metrics["ate_rmse_m"]
    print(f"ATE of one run {1e3 * errors[0]:.2f} mm, merged {1e3 * errors[1]:.2f} mm")
    assert found.run.metrics["ate_frames"] == 100
    assert errors[1] <= 1.2 * errors[0]


def _part(folder: Path, rows: slice) -> Path:
    """Write a log of some frames of redkitchen."""
    folder.mkdir()
    for name in ("rgb", "depth", "intrinsics.json", "groundtruth.txt"):
        (folder / name).symlink_to((REDKITCHEN / name).resolve())
    for name in ("rgb.txt", "depth.txt"):
        lines = [line for line in (REDKITCHEN / name).read_text().splitlines() if not line.startswith("#")]
        (folder / name).write_text("\n".join([*lines[rows], ""]))
    return folder
