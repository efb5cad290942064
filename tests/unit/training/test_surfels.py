"""Training of surfels on photographs of known Gaussians."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from experiments.trained_solids import judge
from splatbot.cli import main
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.gaussians.surfels import holds_surfels
from splatbot.optimize.adam import PARAMETERS
from splatbot.training.folder import TrainingFolder, TrainingSettings
from splatbot.training.images import ImageCache
from splatbot.training.initialize import initial_model
from splatbot.training.options import USUAL, TrainingOptions
from splatbot.training.scoring import score_held_out, summary
from splatbot.training.session import TrainingSession
from splatbot.training.trainer import Trainer
from tests.unit.training.rendered import rendered_data, write_blender_scene

pytestmark = pytest.mark.usefixtures("default_kernels")


def trainer_of(*, views: int = 8, points: int = 200, **options: Any) -> Trainer:
    data = rendered_data(views, points=points, depth="keep_surfaces" in options)
    given: dict[str, Any] = {"iterations": 1000, "surfels": True, "background": "white"} | options
    settings = TrainingOptions(**given)
    images = ImageCache(data.views)
    return Trainer(initial_model(data, images, most=points, seed=0), images, settings, data.scene_extent)


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_a_restored_trainer_of_surfels_takes_the_same_steps_bit_for_bit(strategy: str) -> None:
    options: dict[str, Any] = {
        "strategy": strategy,
        "refine_poses": True,
        "refine_intrinsics": True,
        "background": "random",
    }
    whole, first, second = (trainer_of(**options) for _ in range(3))
    for trainer in (whole, first):
        trainer.iteration = 596  # a change of the Gaussians is among the steps below
        for i in range(8):
            trainer.step(0.22 + i / 500)  # normals begin to count
    second.restore(first.state())
    for trainer in (whole, second):
        for _ in range(3):
            trainer.step(0.3)
    assert len(whole.model) != 200
    assert all(torch.equal(getattr(whole.model, name), getattr(second.model, name)) for name in PARAMETERS)
    assert torch.equal(whole.poses.viewmats, second.poses.viewmats)
    assert holds_surfels(whole.model)


@pytest.mark.long
@pytest.mark.parametrize("strategy", ["default", "mcmc", "fixed"])
def test_surfels_explain_held_out_views_and_their_collision_field_has_no_false_free(strategy: str) -> None:
    scores = []
    data = rendered_data(points=300)
    train, held_out = data.split()
    for iterations in (1, 400):
        options = TrainingOptions(
            iterations=iterations,
            max_gaussians=1500,
            background="white",
            strategy=strategy,  # type: ignore[arg-type]
            surfels=True,
        )
        images = ImageCache(train)
        start = initial_model(data, images, most=1500, seed=0, surfels=True)
        trainer = Trainer(start, images, options, data.scene_extent)
        for i in range(iterations):
            trainer.step(i / iterations)
        found = score_held_out(trainer.model, ImageCache(held_out), options, data.scene_extent)
        scores.append(float(summary(found)["psnr_db"]))
    assert scores[1] > scores[0] + 6
    assert scores[1] > 25
    for n_sigma in (1.0, 2.0, 3.0):
        verdict = judge(trainer.model, n_sigma, 3000)
        assert verdict.touching > 1500
        assert verdict.false_free == 0
        assert verdict.widest < 1e-4


def test_the_losses_of_surfaces_change_the_training() -> None:
    found = []
    for name, weight in (("normal_weight", 0.05), ("normal_weight", 0.0), ("distortion_weight", 0.0)):
        options: dict[str, Any] = {name: weight}
        trainer = trainer_of(views=2, **options)
        trainer.step(0.5)
        found.append(trainer.adam.first["means"].clone())
    assert not torch.equal(found[0], found[1])
    assert not torch.equal(found[0], found[2])


def test_surfels_stay_flat_where_surfaces_are_kept_and_scales_are_regularized() -> None:
    trainer = trainer_of(views=3, strategy="fixed", keep_surfaces=True, scale_weight=1.0)
    before = trainer.model.log_scales.clone()
    for _ in range(3):
        trainer.step(0.5)
    assert holds_surfels(trainer.model)
    assert not torch.equal(trainer.model.log_scales[:, :2], before[:, :2])


def test_no_surfel_and_surfels_out_of_view_are_trained_without_error() -> None:
    trainer = trainer_of(views=2, points=10)
    far = trainer.model.clone()
    far.means += 1e4
    for model in (GaussianModel.empty(), far):
        other = Trainer(model, trainer.images, trainer.options, 1.0)
        assert np.isfinite([other.step(0.5) for _ in range(2)]).all()


@pytest.mark.parametrize("options", [{"strategy": "absgrad"}, {"antialiased": True}, {"normal_weight": -1.0}])
def test_options_that_surfels_cannot_have_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=r"surfels|normal_weight"):
        TrainingOptions(surfels=True, **options)


def test_surfels_do_not_replace_the_map_of_a_run() -> None:
    usual: dict[str, Any] = {"iterations": 1, **USUAL["run"]}
    assert TrainingOptions(**usual).keeps_frame
    assert not TrainingOptions(**usual, surfels=True).keeps_frame


def test_a_resumed_training_of_surfels_has_the_map_of_one_that_was_not_stopped(tmp_path: Path) -> None:
    data = rendered_data(4, points=100)
    options = TrainingOptions(iterations=12, surfels=True, strategy="default", background="white")
    settings = TrainingSettings(data.folder, 1, 4, options)

    def session(name: str, *, resume: bool = False) -> TrainingSession:
        folder = TrainingFolder(tmp_path / name)
        if not resume:
            folder.begin(settings)
        return TrainingSession(data, folder, settings, resume=resume)

    session("whole").run()
    stopped = session("cut")
    stopped.run(stop=lambda: stopped.trainer.iteration == 5)
    resumed = session("cut", resume=True)
    assert resumed.trainer.iteration == 5
    resumed.run()
    assert (tmp_path / "cut" / "map.ply").read_bytes() == (tmp_path / "whole" / "map.ply").read_bytes()


@pytest.mark.long
def test_the_commands_read_a_trained_map_of_surfels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, out = write_blender_scene(tmp_path, 10), tmp_path / "out"
    words = ["--surfels", "--max-gaussians", "800", "--quiet", "--iterations", "150", "--out", str(out)]
    assert main(["train", str(scene), *words]) == 0
    assert holds_surfels(GaussianModel.load(out / "map.ply"))
    assert main(["eval", str(out), "--json"]) == 0
    scores, saved = json.loads(capsys.readouterr().out), json.loads((out / "scores.json").read_text())
    assert saved | scores == saved
    assert scores["psnr_db"] > 18
    assert main(["render", str(out), "--index", "0", "--out", str(tmp_path / "view.png")]) == 0
    assert main(["info", str(out)]) == 0
    assert "surfels" in capsys.readouterr().out
    for method in ("median", "depth", "poisson"):
        mesh = tmp_path / method
        words = ["--format", "mesh", "--mesh-from", method, "--voxel", "0.2", "--out", str(mesh)]
        assert main(["export", str(out), *words]) == 0
        assert (mesh / "mesh.ply").stat().st_size > 5_000
