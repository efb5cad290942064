"""A scene that is trained in blocks."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.cli import main
from splatbot.errors import FormatError, InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import look_at
from splatbot.training.blocks import Cut, SceneBlock, cut_scene, in_view, merged, start_of
from splatbot.training.datasets import TrainingView
from splatbot.training.folder import TrainingFolder, TrainingSettings
from splatbot.training.options import TrainingOptions
from splatbot.trajectory import Trajectory
from tests.unit.training.wide import write_wide_scene
from tests.waiting import until


def view_of(name: str, target: tuple[float, float, float]) -> TrainingView:
    """Return a camera 1 m from a point, with a field of view of 53 degrees."""
    T = look_at(np.add(target, (0.0, 0.0, 1.0)), np.add(target, (0.0, 1e-3, 0.0)))
    return TrainingView(name, Camera(50.0, 50.0, 24.5, 24.5, 50, 50), T, lambda: np.zeros((50, 50, 3), np.uint8))


EVERYWHERE = [view_of(str(i), (x, y, 0.5)) for i, (x, y) in enumerate(np.ndindex(3, 3))]


@pytest.mark.parametrize("count", [2, 5, 8])
def test_each_point_is_in_one_block_and_the_blocks_hold_as_many(count: int) -> None:
    points = np.random.default_rng(0).uniform(0.0, (2.0, 2.0, 0.5), (1003, 3))
    blocks = cut_scene(points, EVERYWHERE, count)
    held = np.array([block.holds(points) for block in blocks])
    assert (held.sum(axis=0) == 1).all()
    assert np.ptp(held.sum(axis=1)) <= 3
    far = np.random.default_rng(1).normal(scale=100.0, size=(100, 3))  # Gaussians move; the blocks fill all space
    assert (np.array([block.holds(far) for block in blocks]).sum(axis=0) == 1).all()


def test_four_blocks_of_a_square_are_its_quadrants_with_a_margin_of_a_tenth() -> None:
    x, y = np.meshgrid(np.linspace(0.0, 2.0, 40), np.linspace(0.0, 2.001, 40))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(1600)], axis=1)
    blocks = cut_scene(points, EVERYWHERE, 4)
    for block in blocks:
        inside = points[block.holds(points)]
        assert len(inside) == 400
        assert np.ptp(inside, axis=0) == pytest.approx([0.975, 0.975, 0.0], abs=0.01)
        assert block.margin == pytest.approx(0.1, abs=0.01)
        wide = points[block.holds(points, 0.1)]
        assert np.ptp(wide, axis=0) == pytest.approx([1.075, 1.075, 0.0], abs=0.06)


def test_a_block_is_trained_by_the_views_that_show_it() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.3, 0.3, (400, 3)) + np.repeat([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], 200, axis=0)
    views = [view_of("left", (0.0, 0.0, 0.3)), view_of("right", (3.0, 0.0, 0.3)), view_of("away", (9.0, 9.0, 0.0))]
    left, right = cut_scene(points, views, 2)
    assert (left.views, right.views) == (("left",), ("right",))
    with pytest.raises(InputError, match="no view shows enough of block 2"):
        cut_scene(points, views[:1], 2)


def model_at(means: NDArray[np.float64]) -> GaussianModel:
    n = len(means)
    return GaussianModel.from_activated(
        means=means,
        quats=np.tile([1.0, 0, 0, 0], (n, 1)),
        scales=np.full((n, 3), 0.01),
        opacities=np.full(n, 0.5),
        colors=np.full((n, 3), 0.5),
    )


def test_a_block_starts_with_its_margin_and_every_eighth_of_what_else_its_views_see() -> None:
    rng = np.random.default_rng(0)
    means = np.concatenate([rng.uniform(0.0, 2.0, (2000, 3)) * (1, 1, 0), [[50.0, 0.0, 0.0]] * 100])
    model = model_at(means)
    block = SceneBlock((Cut(0, 1.0, False),), 0.25, ("0",))
    views = [view_of("0", (1.0, 1.0, 2.0)), view_of("1", (50.0, 0.0, 0.0))]
    start = start_of(model, block, views, 0)
    near = means[:, 0] < 1.25
    seen = in_view(views[0], means) & ~near
    count = int(near.sum())
    assert len(start) == count + int(seen.sum()) // 8
    assert torch.equal(start.means[:count], model.means[torch.from_numpy(near)])
    assert torch.equal(start.scales[:count], model.scales[:count])
    np.testing.assert_allclose(start.scales[count:], 0.01 * np.sqrt(8), rtol=1e-5)
    assert float(start.means[:, 0].max()) < 2.0  # no view of the block sees the rest


def test_the_merged_map_takes_each_gaussian_from_the_block_that_owns_its_place(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    blocks = [SceneBlock((Cut(1, 0.25, above),), 0.1, ()) for above in (False, True)]
    models = []
    for number, degree in enumerate((1, 2)):
        n = 50
        model = GaussianModel.from_activated(
            means=rng.uniform(-1.0, 1.0, (n, 3)),
            quats=rng.normal(size=(n, 4)),
            scales=rng.uniform(0.01, 0.1, (n, 3)),
            opacities=rng.uniform(0.1, 0.9, n),
            colors=rng.uniform(0.0, 1.0, (n, 3)),
        )
        model.sh = torch.cat([model.sh, torch.randn(n, (degree + 1) ** 2 - 1, 3)], dim=1)
        model.save(tmp_path / f"{number}.ply")
        models.append(model)
    whole = merged([(block, tmp_path / f"{number}.ply", None) for number, block in enumerate(blocks)])
    below, above = models[0].means[:, 1] < 0.25, models[1].means[:, 1] >= 0.25
    assert torch.equal(whole.means, torch.cat([models[0].means[below], models[1].means[above]]))
    assert torch.equal(
        whole.opacity_logits, torch.cat([models[0].opacity_logits[below], models[1].opacity_logits[above]])
    )
    assert whole.sh_degree == 2
    assert torch.equal(whole.sh[: int(below.sum()), :4], models[0].sh[below])
    assert not whole.sh[: int(below.sum()), 4:].any()
    assert torch.equal(whole.sh[int(below.sum()) :], models[1].sh[above])


def test_a_gaussian_that_crosses_a_cut_keeps_its_owner_if_training_keeps_the_rows(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.0, 1.0, (300, 3))
    model = model_at(points)
    view = view_of("all", (0.0, 0.0, 2.0))
    parts: list[tuple[SceneBlock, Path, Path | None]] = []
    for number, block in enumerate(cut_scene(model.means.double().numpy(), [view], 4)):
        start = start_of(model, block, [view], 0)
        file, begun = tmp_path / f"{number}.ply", tmp_path / f"{number}.start.ply"
        start.save(begun)
        start.opacity_logits[:] = start.means[:, 0]  # names the row
        start.means += 0.1 * torch.randn(start.means.shape, generator=torch.Generator().manual_seed(number))
        start.save(file)
        parts.append((block, file, begun))
    whole = merged(parts)
    assert torch.equal(whole.opacity_logits.sort().values, model.means[:, 0].sort().values)
    assert len(merged([(block, file, None) for block, file, _ in parts])) != len(model)  # some did cross
    with pytest.raises(FormatError, match="its start"):
        merged([(parts[0][0], parts[1][1], parts[0][2])])


@pytest.mark.parametrize("count", [2, 5])
def test_points_that_share_a_coordinate_are_cut_at_the_next_one_or_across_another_axis(count: int) -> None:
    rng = np.random.default_rng(0)
    floor = np.concatenate([np.zeros(900), rng.uniform(0.0, 9.0, 100)])
    points = np.stack([floor, rng.uniform(0.0, 1.0, 1000), np.full(1000, 0.5)], axis=1)
    views = [view_of("0", (0.0, 0.5, 2.0)), view_of("1", (5.0, 0.5, 5.0))]
    columns = np.repeat(points[:10], 100, axis=0)  # ten places
    for scene in (points, columns):
        blocks = cut_scene(scene, views, count)
        held = np.array([block.holds(scene) for block in blocks])
        assert (held.sum(axis=0) == 1).all()
        assert (held.sum(axis=1) > 0).all()


def test_points_in_one_place_cannot_be_cut() -> None:
    with pytest.raises(InputError, match=r"--blocks: .*one place"):
        cut_scene(np.ones((100, 3)), EVERYWHERE, 2)


def test_a_view_that_shows_little_of_each_block_trains_the_one_it_shows_most() -> None:
    edges = np.linspace(0.0, 16.0, 17)
    points = np.stack(
        [np.repeat(edges[:-1], 50) + np.tile(np.linspace(0.0, 0.99, 50), 16), *np.zeros((2, 800))], axis=1
    )
    above = view_of("above", (8.2, 0.0, 50.0))
    views = [view_of(f"{i}", (float(x) + 0.5, 0.0, 0.0)) for i, x in enumerate(edges[:-1])]
    blocks = cut_scene(points, [above, *views], 16)
    assert np.count_nonzero(in_view(above, points)) == 800
    assert [("above" in block.views) for block in blocks].count(True) == 1


def test_the_settings_of_a_block_are_read_as_they_were_written(tmp_path: Path) -> None:
    block = SceneBlock((Cut(0, 0.1, True), Cut(2, -3.0, False)), 0.5, ("a.png", "b.png"))
    settings = TrainingSettings(tmp_path, 2, 8, TrainingOptions(), blocks=1, block=block)
    TrainingFolder(tmp_path).save_settings(settings)
    assert TrainingFolder(tmp_path).load_settings() == settings


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--blocks", "0"), "--blocks"),
        (("--blocks", "300", "--max-gaussians", "150"), "give 1 to 150"),
        (("--blocks", "2", "--refine-poses"), "refine poses"),
        (("--blocks", "2", "--refine-intrinsics"), "refine intrinsics"),
        (("--blocks", "2", "--exposure"), "compensate exposures"),
    ],
)
def test_blocks_that_are_not_possible_are_named_with_a_fix(
    words: tuple[str, ...], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = write_wide_scene(tmp_path / "scene", points=200, rows=2)
    assert main(["train", str(scene), "--out", str(tmp_path / "out"), *words]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert "Fix:" in err
    assert not (tmp_path / "out").exists()


def start(*words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "splatbot", "train", *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def scores_of(folder: Path) -> dict[str, float]:
    scores: dict[str, float] = json.loads((folder / "scores.json").read_text())
    return scores


@pytest.mark.long
def test_two_blocks_look_as_one_scene_and_an_interrupted_training_of_them_ends_with_the_same_map(
    tmp_path: Path,
) -> None:
    scene = write_wide_scene(tmp_path / "scene", points=4000, side=2.5, rows=6)
    words = (str(scene), "--iterations", "800", "--max-gaussians", "4000", "--checkpoint-every", "0.2")
    undivided, whole, cut = tmp_path / "undivided", tmp_path / "whole", tmp_path / "cut"
    for out, more in ((undivided, ()), (whole, ("--blocks", "2"))):
        process = start(*words, *more, "--out", str(out))
        _, err = process.communicate(timeout=240)
        assert process.returncode == 0, err
        assert scores_of(out)["complete"] is True
    print(
        f"held-out PSNR: {scores_of(undivided)['psnr_db']} dB undivided, {scores_of(whole)['psnr_db']} dB in 2 blocks"
    )
    assert scores_of(undivided)["psnr_db"] > 15  # 8 dB after a step
    assert scores_of(whole)["psnr_db"] == pytest.approx(scores_of(undivided)["psnr_db"], abs=0.5)
    assert scores_of(whole)["gaussians"] == pytest.approx(scores_of(undivided)["gaussians"], rel=0.05)
    for name in ("course.png", "held_out.jpg", "progress.jsonl"):
        assert (whole / name).is_file()
    assert len(Trajectory.load(whole / "trajectory.tum").stamps) == 31
    process = start(*words, "--blocks", "2", "--processes", "2", "--out", str(cut))
    until((cut / "blocks" / "1" / "checkpoint.pt").is_file)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=240)
    assert process.returncode == 130
    assert f"--resume {cut}" in err
    assert not (cut / "map.ply").exists()
    process = start("--resume", str(cut))
    _, err = process.communicate(timeout=240)
    assert process.returncode == 0, err
    assert (cut / "map.ply").read_bytes() == (whole / "map.ply").read_bytes()


@pytest.mark.long
def test_blocks_of_fixed_gaussians_keep_their_number_and_use_all_views(tmp_path: Path) -> None:
    scene = write_wide_scene(tmp_path / "scene", points=1000, rows=4)
    out = tmp_path / "out"
    words = ("--iterations", "60", "--blocks", "4", "--strategy", "fixed", "--max-gaussians", "1000")
    process = start(str(scene), *words, "--out", str(out))
    _, err = process.communicate(timeout=240)
    assert process.returncode == 0, err
    assert scores_of(out)["gaussians"] == 1000
    blocks = [TrainingFolder(out / "blocks" / str(number)).load_settings().block for number in range(4)]
    assert len({name for block in blocks if block is not None for name in block.views}) == 14  # two are held out


@pytest.mark.long
def test_a_killed_block_ends_the_command_with_one_error(tmp_path: Path) -> None:
    scene = write_wide_scene(tmp_path / "scene", points=1000, rows=4)
    out = tmp_path / "out"
    process = start(str(scene), "--iterations", "1000000", "--blocks", "2", "--out", str(out), "--quiet")
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    until(lambda: (out / "blocks" / "0").exists() and children.read_text().split())
    os.kill(int(children.read_text()), signal.SIGKILL)
    _, err = process.communicate(timeout=240)
    assert process.returncode == 1
    assert err.startswith("error: block 1 of 2 was ended by SIGKILL.")
    assert len(err.splitlines()) == 1


@pytest.mark.long
@pytest.mark.alone
def test_blocks_lower_the_peak_memory_of_each_process(tmp_path: Path) -> None:
    scene = write_wide_scene(tmp_path / "scene", points=2_000_000, side=8.0, rows=6)
    words = ["--iterations", "3", "--max-gaussians", "2000000", "--strategy", "fixed", "--quiet"]
    code = (
        "import resource, subprocess, sys\n"
        "subprocess.run([sys.executable, '-m', 'splatbot', 'train', *sys.argv[1:]], check=True)\n"
        "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"  # of the largest process below this one
    )
    peaks = []
    for more in (["--out", str(tmp_path / "1")], ["--out", str(tmp_path / "4"), "--blocks", "4", "--processes", "2"]):
        command = [sys.executable, "-c", code, str(scene), *words, *more]
        peaks.append(int(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout))
    assert scores_of(tmp_path / "4")["gaussians"] == 2_000_000  # none lost, none doubled
    print(f"peak memory of a process: {peaks[0] / 2**20:.2f} GiB undivided, {peaks[1] / 2**20:.2f} GiB in 4 blocks")
    assert peaks[1] <= 0.6 * peaks[0]
