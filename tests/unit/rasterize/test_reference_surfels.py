"""The surfel reference against central differences and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from splatbot.geometry import quat_to_rotation
from tests.scenes import Scene, hard_scene, one_gaussian
from tests.surfels import NAMES, RENDERED, loss, reference

STEP = 1e-6

pytestmark = pytest.mark.usefixtures("one_torch_thread")


@pytest.mark.parametrize("image", [*RENDERED, "surf_normals"])
def test_gradients_equal_central_differences(image: str) -> None:
    scene = hard_scene(3, n=40)
    scene.width, scene.height = scene.width // 3, scene.height // 3
    scene.Ks[:, :2] /= 3.0
    scene = scene.to(torch.float64, requires_grad=True)
    images, meta = reference(scene, "RGB+ED", distloss=True)
    # A pixel within the step's reach of a jump has no derivative, nor has a normal next to one.
    jumps = (meta.margins <= 1e-3).double()[:, None]
    safe = (torch.nn.functional.max_pool2d(jumps, 3, stride=1, padding=1)[:, 0] == 0)[..., None]
    loss(images, safe, (image,)).backward()

    def moved(name: str, index: tuple[int, ...], step: float) -> float:
        other = scene.to(torch.float64)
        getattr(other, name)[index] += step
        return float(loss(reference(other, "RGB+ED", distloss=True)[0], safe, (image,)))

    checked = 0
    for name in NAMES:
        leaf = getattr(scene, name)
        if leaf.grad is None or float(leaf.grad.abs().max()) < 1e-6:
            continue
        for k in leaf.grad.abs().flatten().topk(min(3, leaf.numel())).indices.tolist():
            index = tuple(int(i) for i in torch.unravel_index(torch.tensor(k), leaf.shape))
            if name == "viewmats" and (index[1] == 3 or image == "surf_normals"):
                continue  # normals of depth take the pose as rigid: single entries have no derivative
            slope = (moved(name, index, STEP) - moved(name, index, -STEP)) / (2 * STEP)
            assert float(leaf.grad[index]) == pytest.approx(slope, rel=5e-5, abs=5e-6), (name, index)
            checked += 1
    assert checked >= 5


def test_a_disc_that_faces_the_camera_has_the_closed_form() -> None:
    sigma_x, sigma_y, z, opacity, focal = 0.05, 0.08, 2.0, 0.8, 40.0
    scene = one_gaussian(scale=(sigma_x, sigma_y, 9.0), mean=(0.0, 0.0, z), opacity=opacity)
    images, _ = reference(scene.to(torch.float64), "RGB+D")
    u, v = 0.5 * z / focal / sigma_x, 2.5 * z / focal / sigma_y  # pixel (16, 14), from the principal point (16, 12)
    expected = opacity * math.exp(-0.5 * (u * u + v * v))
    assert float(images["alphas"][0, 14, 16, 0]) == pytest.approx(expected, rel=1e-6)
    assert images["colors"][0, 14, 16].tolist() == pytest.approx(
        [expected, 0.5 * expected, 0.25 * expected, z * expected], rel=1e-6
    )
    assert images["normals"][0, 14, 16].tolist() == pytest.approx([0.0, 0.0, -expected], rel=1e-6)


def test_a_disc_smaller_than_a_pixel_is_the_low_pass_filter() -> None:
    scene = one_gaussian(scale=(1e-5, 1e-5, 1e-5), opacity=0.8)
    alpha = reference(scene.to(torch.float64))[0]["alphas"]
    assert float(alpha[0, 12, 16, 0]) == pytest.approx(0.8 * math.exp(-0.5), rel=1e-6)  # half a pixel in x and in y


def test_hits_are_where_the_rays_meet_the_discs() -> None:
    scene: Scene = hard_scene(4, n=40)
    scene.scales = torch.full_like(scene.scales, 0.3)
    R_camera_world, t = scene.viewmats[0, :3, :3].double().numpy(), scene.viewmats[0, :3, 3].double().numpy()
    K = scene.Ks[0].double().numpy()
    checked = 0
    for i in range(40):
        alone = scene.alone(i)
        images, _ = reference(alone.to(torch.float64), "RGB+ED")
        R = R_camera_world @ quat_to_rotation(scene.quats[i].double().numpy())
        p = R_camera_world @ scene.means[i].double().numpy() + t
        for y, x in np.argwhere(images["alphas"][0, ..., 0].numpy() > 0.05)[::37]:
            ray = np.linalg.inv(K) @ [x + 0.5, y + 0.5, 1.0]
            hit = ray * (R[:, 2] @ p) / (R[:, 2] @ ray)
            u, v = R[:, :2].T @ (hit - p) / 0.3
            centre = K @ p / p[2]
            if u * u + v * v < 2.0 * ((x + 0.5 - centre[0]) ** 2 + (y + 0.5 - centre[1]) ** 2) and hit[2] > 0.01:
                alpha = min(0.99, float(scene.opacities[i]) * math.exp(-0.5 * (u * u + v * v)))
                assert float(images["alphas"][0, y, x, 0]) == pytest.approx(alpha, rel=1e-6)
                assert float(images["colors"][0, y, x, 3]) == pytest.approx(hit[2], rel=1e-6)
                assert float(images["median"][0, y, x, 0]) == pytest.approx(hit[2], rel=1e-6)
                checked += 1
    assert checked > 50
