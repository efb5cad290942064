"""Refined intrinsics of the cameras of photographs."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from splatbot.camera import Camera
from splatbot.errors import FormatError
from splatbot.geometry import look_at, se3_exp
from splatbot.rasterize import Gaussians, Viewpoints, rasterization, rasterization_reference
from splatbot.training.datasets import TrainingData, TrainingView
from splatbot.training.folder import TrainingFolder
from splatbot.training.images import ImageCache
from splatbot.training.initialize import initial_model
from splatbot.training.intrinsics import CameraIntrinsics, RefinedCamera, matrix, prior, with_refined
from splatbot.training.options import TrainingOptions
from splatbot.training.scoring import score_held_out, summary
from splatbot.training.trainer import Trainer
from splatbot.trajectory import Trajectory
from tests.unit.training.rendered import CAMERA, photograph, rendered_data, true_model

pytestmark = pytest.mark.usefixtures("default_kernels")


def view_of(camera: Camera, name: str = "") -> TrainingView:
    return TrainingView("0", camera, np.eye(4), lambda: np.zeros((1, 1, 3), np.uint8), camera_name=name)


def test_an_unchanged_camera_has_the_matrix_of_its_size() -> None:
    for camera in (CAMERA, CAMERA.resized(64, 48), CAMERA.resized(33, 23)):
        found = matrix(CAMERA, torch.zeros(4, dtype=torch.float64), camera)
        np.testing.assert_allclose(found, camera.K_corner, rtol=1e-14)


def test_changes_are_relative_to_the_focal_length() -> None:
    camera = Camera(200.0, 100.0, 49.5, 29.5, 100, 60)
    found = matrix(camera, torch.tensor([np.log(1.02), 0.0, 0.01, -0.02], dtype=torch.float64), camera)
    np.testing.assert_allclose(found, [[204.0, 0.0, 52.0], [0.0, 100.0, 28.0], [0.0, 0.0, 1.0]], rtol=1e-14)


@pytest.mark.parametrize("size", [(40, 30), (20, 15)])
def test_the_gradient_of_a_render_equals_finite_differences_of_the_float64_reference(
    size: tuple[int, int], rng: np.random.Generator
) -> None:
    camera, n = Camera(40.0, 38.0, 20.3, 14.1, 40, 30), 12
    reduced = camera.resized(*size)
    means = rng.uniform(-0.5, 0.5, (n, 3)) + np.array([0.0, 0.0, 2.0])
    quats, scales = rng.normal(size=(n, 4)), rng.uniform(0.05, 0.3, (n, 3))
    opacities, colors = rng.uniform(0.2, 0.9, n), rng.uniform(0.0, 1.0, (n, 3))
    m, q, s, o, c = (torch.from_numpy(array) for array in (means, quats, scales, opacities, colors))
    pose, weights = torch.eye(4, dtype=torch.float64)[None], torch.from_numpy(rng.normal(size=(size[1], size[0], 3)))

    def reference(change: Tensor) -> float:
        viewpoints = Viewpoints(pose, matrix(camera, change, reduced)[None], *size)
        return float((weights * rasterization_reference(Gaussians(m, q, s, o, c), viewpoints)[0][0]).sum())

    change = torch.tensor([0.02, -0.01, 0.015, -0.005], dtype=torch.float64, requires_grad=True)
    Ks = matrix(camera, change, reduced)[None]
    render = rasterization(m.float(), q.float(), s.float(), o.float(), c.float(), pose, Ks, *size)[0][0]
    (found,) = torch.autograd.grad((weights.float() * render).sum(), [change])
    steps = 1e-6 * torch.eye(4, dtype=torch.float64)
    numeric = [(reference(change.detach() + step) - reference(change.detach() - step)) / 2e-6 for step in steps]
    np.testing.assert_allclose(found, numeric, rtol=2e-3, atol=1e-3 * np.abs(numeric).max())


def test_the_prior_of_one_sigma_in_each_change_is_half_its_weight_each() -> None:
    assert float(prior(torch.full((4,), 0.05, dtype=torch.float64))) == pytest.approx(4 * 0.5e-3)


def test_views_of_one_camera_share_its_changes_and_other_cameras_stay() -> None:
    wide = replace(CAMERA, fx=90.0)
    views = [view_of(CAMERA, "a"), view_of(wide, "a"), view_of(CAMERA, "b"), view_of(CAMERA, "a")]
    intrinsics = CameraIntrinsics(views)
    assert [(camera.name, camera.given, camera.views) for camera in intrinsics.cameras()] == [
        ("a", CAMERA, 2),
        ("a", wide, 1),
        ("b", CAMERA, 1),
    ]
    intrinsics.step([0, 3], torch.tensor([[1.0, 0, 0, -1], [1.0, 0, 0, -1]], dtype=torch.float64), 0.01)
    shared, *others = intrinsics.cameras()
    assert shared.refined.fx == pytest.approx(CAMERA.fx * np.exp(-0.01))
    assert shared.refined.cy == pytest.approx(CAMERA.cy + 0.01 * CAMERA.fy)
    assert all(other.refined == other.given for other in others)
    held_out = with_refined([view_of(CAMERA, "a"), view_of(CAMERA, "c")], intrinsics.cameras())
    assert [view.camera for view in held_out] == [shared.refined, CAMERA]


def test_refined_cameras_are_read_as_they_were_written_and_damage_is_named(tmp_path: Path) -> None:
    cameras = [RefinedCamera("camera 1", CAMERA, replace(CAMERA, fx=110.1 / 3, cx=1 / 7), 5)]
    folder = TrainingFolder(tmp_path)
    assert folder.load_cameras() == []
    folder.save_map(true_model(), Trajectory(np.zeros(1), np.eye(4)[None]), cameras)
    assert folder.load_cameras() == cameras
    for text in ("{", '{"cameras": [{"name": "a"}]}', folder.cameras.read_text().replace("110.0", "-1.0")):
        folder.cameras.write_text(text)
        with pytest.raises(FormatError, match=r"cameras.json.*--resume"):
            folder.load_cameras()


def scattered_data(camera: Camera) -> TrainingData:
    """Return 24 photographs of :data:`CAMERA`, rolled and aimed at places around the ball, as those of a camera.

    If all looked at the centre, a smaller ball would look as a shorter focal length does.
    """
    rng, views = np.random.default_rng(3), []
    for index in range(24):
        direction = rng.normal(size=3)
        eye = rng.uniform(1.1, 1.8) * direction / np.linalg.norm(direction)
        roll = se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, rng.uniform(-3.0, 3.0)]))
        T = look_at(eye, rng.uniform(-0.4, 0.4, 3)) @ roll
        views.append(TrainingView(f"{index:03d}", camera, T, partial(np.copy, photograph(true_model(), T)[0])))
    return replace(rendered_data(1, points=300), views=tuple(views))


def trained(camera: Camera, *, refine_intrinsics: bool) -> tuple[list[RefinedCamera], float]:
    """Train with given intrinsics; return the refined cameras, and the PSNR of the held-out views [dB]."""
    data = scattered_data(camera)
    train, held_out = data.split()
    options = TrainingOptions(
        iterations=500, max_gaussians=1500, background="white", refine_intrinsics=refine_intrinsics
    )
    images = ImageCache(train)
    trainer = Trainer(initial_model(data, images, most=1500, seed=0), images, options, data.scene_extent)
    for step in range(500):
        trainer.step(step / 500)
    cameras = [] if trainer.intrinsics is None else trainer.intrinsics.cameras()
    scored = ImageCache(with_refined(held_out, cameras))
    return cameras, float(summary(score_held_out(trainer.model, scored, options, data.scene_extent))["psnr_db"])


@pytest.mark.long
def test_a_wrong_focal_length_and_centre_are_recovered() -> None:
    wrong = replace(CAMERA, fx=1.02 * CAMERA.fx, fy=1.02 * CAMERA.fy, cx=CAMERA.cx + 3.0, cy=CAMERA.cy - 3.0)
    _, true = trained(CAMERA, refine_intrinsics=False)
    _, as_given = trained(wrong, refine_intrinsics=False)
    (found,), refined = trained(wrong, refine_intrinsics=True)
    print(f"held-out PSNR: {true:.1f} dB true, {as_given:.1f} dB wrong, {refined:.1f} dB refined; {found.refined}")
    assert found.refined.fx == pytest.approx(CAMERA.fx, rel=0.007)
    assert found.refined.fy == pytest.approx(CAMERA.fy, rel=0.007)
    assert found.refined.cx == pytest.approx(CAMERA.cx, abs=0.2)
    assert found.refined.cy == pytest.approx(CAMERA.cy, abs=0.2)
    assert as_given < true - 5
    assert refined > true - 1
