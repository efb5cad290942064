"""Refinement: the loss decreases, unrefinable parameters do not change, and draws favor the latest keyframes."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatbot.gaussians import GaussianModel
from splatbot.gaussians.shape import rotations
from splatbot.geometry import se3_exp
from splatbot.mapping.insertion import new_gaussians, view_of
from splatbot.mapping.keyframes import Keyframe
from splatbot.mapping.refine import Refiner
from splatbot.optimize.adam import PARAMETERS
from splatbot.rasterize import rasterization
from tests.rgbd import CAMERA, small_config
from tests.unit.mapping.conftest import MakeKeyframe

CONFIG = small_config().mapping


def refiner_for(model: GaussianModel, seed: int = 0, **overrides: object) -> Refiner:
    refiner = Refiner(small_config(**overrides).mapping, seed)
    refiner.adam.extend(model)
    return refiner


def disturbed(keyframe: Keyframe, seed: int = 0) -> GaussianModel:
    """Make the keyframe's Gaussians with colors wrong by a fifth and positions by a centimeter."""
    model = new_gaussians(keyframe, keyframe.depth > 0, CONFIG)
    g = torch.Generator().manual_seed(seed)
    model.sh += 0.7 * torch.randn(model.sh.shape, generator=g)
    model.means[:, 2] += 0.01 * torch.randn(len(model), generator=g)
    return model


def snapshot(model: GaussianModel) -> dict[str, torch.Tensor]:
    return {name: getattr(model, name).clone() for name in PARAMETERS}


def test_the_loss_goes_down_and_so_do_the_errors_of_colour_and_depth(make_keyframe: MakeKeyframe) -> None:
    keyframe = make_keyframe()
    model = disturbed(keyframe)
    refiner = refiner_for(model)

    def errors() -> tuple[float, float]:
        view = view_of(model, CAMERA, np.eye(4))
        color = (view.rgb - keyframe.rgb.float() / 255).abs().mean()
        return float(color), float((view.depth - keyframe.depth).abs().mean())

    before = errors()
    losses = [refiner.step(model, keyframe) for _ in range(60)]
    after = errors()
    assert losses[-1] < 0.6 * losses[0]
    assert max(np.diff(losses)) < 0.05 * losses[0]
    assert after[0] < 0.6 * before[0]
    assert after[1] < 0.8 * before[1]


def test_the_reported_loss_is_that_of_the_render(make_keyframe: MakeKeyframe) -> None:
    keyframe = make_keyframe()
    model = disturbed(keyframe)
    model.sh.clamp_(-1.7, 1.7)  # colours within 0..1, which a view clamps
    render, alpha, _ = rasterization(
        model.means,
        model.quats,
        model.scales,
        model.opacities,
        model.colors,
        keyframe.viewmat,
        keyframe.K,
        CAMERA.width,
        CAMERA.height,
        render_mode="RGB+ED",
    )
    image, covered = render[0].double().numpy(), alpha[0, ..., 0].numpy() > 0.5
    color = np.abs(image[..., :3] - keyframe.rgb.numpy() / 255.0)[covered].mean()
    depth = keyframe.depth.double().numpy()
    relative = (np.abs(image[..., 3] - depth) / depth)[covered].mean()
    loss = refiner_for(model).step(model, keyframe)
    assert loss == pytest.approx(color + CONFIG.depth_weight * relative, rel=1e-4)


def test_a_gaussian_out_of_view_keeps_its_bits(make_keyframe: MakeKeyframe) -> None:
    keyframe = make_keyframe()
    model = disturbed(keyframe)
    model.means[:50, 0] += 10.0
    before = snapshot(model)
    refiner_for(model).step(model, keyframe)
    for name in PARAMETERS:
        assert torch.equal(getattr(model, name)[:50], before[name][:50])
        assert not torch.equal(getattr(model, name), before[name])


def test_an_empty_map_is_left_alone(make_keyframe: MakeKeyframe) -> None:
    model = GaussianModel.empty()
    refiner = refiner_for(model)
    refiner.refine(model, [make_keyframe()], 5)
    refiner.refine_all(model, [make_keyframe()], 5)
    refiner.refine_all(model, [], 5)
    assert len(model) == 0


def test_a_keyframe_without_depth_refines_colour_and_stays_finite(make_keyframe: MakeKeyframe) -> None:
    keyframe = make_keyframe()
    model = disturbed(keyframe)
    blind = replace(keyframe, depth=torch.zeros_like(keyframe.depth))
    losses = [refiner_for(model).step(model, blind) for _ in range(3)]
    assert losses[2] < losses[0]
    for name in PARAMETERS:
        assert torch.isfinite(getattr(model, name)).all()


def test_a_keyframe_that_sees_nothing_of_the_map_changes_nothing_though_it_was_in_motion(
    make_keyframe: MakeKeyframe,
) -> None:
    model = disturbed(make_keyframe())
    refiner = refiner_for(model)
    refiner.step(model, make_keyframe())  # from here on, Adam has momentum
    before = snapshot(model)
    away = make_keyframe(se3_exp([0, 0, 0, 0, np.pi, 0]), normal=(0, 0, -1))
    assert refiner.step(model, away) == 0.0
    for name in PARAMETERS:
        assert torch.equal(getattr(model, name), before[name])


def test_no_iterations_change_nothing(make_keyframe: MakeKeyframe) -> None:
    model = disturbed(make_keyframe())
    before = snapshot(model)
    refiner_for(model).refine(model, [make_keyframe()], 0)
    for name in PARAMETERS:
        assert torch.equal(getattr(model, name), before[name])


def test_the_number_of_torch_threads_is_the_callers_again(make_keyframe: MakeKeyframe) -> None:
    model = disturbed(make_keyframe())
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        refiner_for(model).step(model, make_keyframe())
        assert torch.get_num_threads() == 2
        broken = replace(make_keyframe(), camera=None)  # type: ignore[arg-type]
        with pytest.raises(AttributeError):
            refiner_for(model).step(model, broken)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)


def drawn(iterations: int, monkeypatch: pytest.MonkeyPatch, make: MakeKeyframe, seed: int = 0) -> list[int]:
    """Return the numbers of the keyframes that a refinement over 20 of them visits, with a window of 4."""
    model = disturbed(make())
    refiner = refiner_for(model, seed, mapping__window=4)
    visited: list[int] = []
    monkeypatch.setattr(refiner, "step", lambda _, keyframe: visited.append(keyframe.number))
    refiner.refine(model, [replace(make(), number=i) for i in range(20)], iterations)
    return visited


def test_the_latest_keyframe_comes_first_then_half_the_draws_from_the_window(
    monkeypatch: pytest.MonkeyPatch, make_keyframe: MakeKeyframe
) -> None:
    visited = drawn(2001, monkeypatch, make_keyframe)
    assert visited[0] == 19
    counts = Counter(visited[1:])
    share = sum(counts[i] for i in range(16, 20)) / 2000
    assert share == pytest.approx(0.5 + 0.5 * 4 / 20, abs=0.05)  # four standard deviations
    assert min(counts[i] for i in range(16)) > 20  # of 50 expected: none is forgotten


def test_draws_are_those_of_the_seed(monkeypatch: pytest.MonkeyPatch, make_keyframe: MakeKeyframe) -> None:
    first, again, other = (drawn(30, monkeypatch, make_keyframe, seed) for seed in (1, 1, 2))
    assert first == again != other


def test_a_visible_needle_shrinks_to_the_resolution_of_a_keyframe(make_keyframe: MakeKeyframe) -> None:
    keyframe = make_keyframe()
    model = disturbed(keyframe)
    model.log_scales[:50, 0] = np.log(0.4)
    refiner = refiner_for(model, mapping__max_pixels=3.0)
    refiner.step(model, keyframe)
    rows = torch.arange(50)
    z = (keyframe.viewmat[0, 2, :3].double() @ model.means[rows].double().T) + keyframe.viewmat[0, 2, 3].double()
    limit = 3.0 * z / float(keyframe.K[0, 0, 0])
    seen = z > 0.1
    assert int(seen.sum()) > 20
    assert (model.scales[rows].double().amax(1)[seen] <= 1.001 * limit[seen]).all()


def test_a_blob_becomes_a_disc_of_the_same_extent(make_keyframe: MakeKeyframe) -> None:
    keyframe = make_keyframe()
    model = disturbed(keyframe)
    model.log_scales[:] = np.log(0.004)
    refiner_for(model, mapping__scales_lr=0.0).step(model, keyframe)
    sizes = model.scales.double().sort(1).values
    changed = sizes[:, 0] < 0.0039
    assert float(changed.double().mean()) > 0.9
    np.testing.assert_allclose(sizes[changed].numpy(), [[0.2 * 0.004, 0.004, 0.004]] * int(changed.sum()), rtol=1e-4)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_step_moves_means_along_their_normals_by_the_stated_share_and_along_the_surface_in_full(
    make_keyframe: MakeKeyframe, share: float
) -> None:
    keyframe = make_keyframe()
    moves = []
    for one in (1.0, share):
        model = disturbed(keyframe)
        before, normals = model.means.clone(), rotations(model)[:, :, 2]  # of a new Gaussian, z is the normal
        refiner_for(model, mapping__normal_step_scale=one).step(model, keyframe)
        moves.append(model.means - before)
    along, across = [], []
    for move in moves:
        part = (move * normals).sum(1, keepdim=True) * normals
        along.append(part)
        across.append(move - part)
    assert along[0].norm(dim=1).max() > 1e-4
    torch.testing.assert_close(along[1], share * along[0], atol=1e-6, rtol=0)
    torch.testing.assert_close(across[1], across[0], atol=1e-6, rtol=0)
