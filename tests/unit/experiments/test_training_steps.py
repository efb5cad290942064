"""Steps of training that share views or leave out tiles."""

from __future__ import annotations

import pytest
import torch

from experiments.training_steps import (
    KINDS,
    CallsTrainer,
    OneCallTrainer,
    Scene,
    TilesTrainer,
    _tile_means,
    at_random,
    below_mean,
    by_loss,
    run,
)
from splatbot.optimize.adam import PARAMETERS
from splatbot.training.images import ImageCache
from splatbot.training.options import TrainingOptions
from splatbot.training.surface import SurfaceWeights
from tests.unit.training.rendered import rendered_data


@pytest.fixture(scope="module")
def scene() -> Scene:
    data = rendered_data(8, points=200)
    train, held_out = data.split(8)
    options = TrainingOptions(strategy="mcmc", max_gaussians=200, background="white", sh_degree=1)
    return Scene(data, ImageCache(train), ImageCache(held_out), options)


def test_one_call_for_all_views_has_the_gradients_of_a_call_each(scene: Scene) -> None:
    each, one = CallsTrainer(scene, 0, 3), OneCallTrainer(scene, 0, 3)
    views = [(index, torch.ones(3)) for index in (0, 2, 5)]
    weights = SurfaceWeights.at(each.options, 0.5, each.extent)
    found, expected = (trainer._gradients(views, 1, 0, weights) for trainer in (one, each))
    assert float(found.loss) == pytest.approx(float(expected.loss), rel=1e-5)
    for name in PARAMETERS:
        of_round = 1e-8  # gradient of a rotation, which is 0 but for rounding
        difference = float((found.grads[name] - expected.grads[name]).norm())
        assert difference < max(of_round, 1e-4 * float(expected.grads[name].norm()))


def test_tiles_that_a_rule_leaves_out_are_rendered_again_at_the_fourth_visit(scene: Scene) -> None:
    trainer = TilesTrainer(scene, 0, lambda losses, draws: losses < 0, counts_all=True)
    views = len(scene.images.views)
    for _ in range(5 * views):
        trainer.step(0.5)
    assert trainer.rendered == [1.0] * views + [0.0] * 3 * views + [1.0] * views


def test_rules_keep_tiles_by_their_loss() -> None:
    draws = torch.Generator().manual_seed(0)
    losses = torch.tensor([[0.1, 1.0], [1.0, 1.9]])
    assert below_mean(0.5)(losses, draws).tolist() == [[False, True], [True, True]]
    shares = {rule: torch.stack([rule(losses, draws) for _ in range(4000)]).float().mean(0) for rule in RULES}
    torch.testing.assert_close(shares[RULES[0]], torch.full((2, 2), 0.5), rtol=0, atol=0.04)
    torch.testing.assert_close(shares[RULES[1]], torch.tensor([[0.1, 0.5], [0.5, 0.95]]), rtol=0, atol=0.04)


RULES = at_random(0.5), by_loss(0.5)


def test_the_mean_of_a_tile_at_the_border_counts_its_own_pixels() -> None:
    means = _tile_means(torch.cat([torch.zeros(40, 32), torch.ones(40, 8)], 1))
    torch.testing.assert_close(means, torch.tensor([[0.0, 1.0], [0.0, 1.0]]))


@pytest.mark.parametrize("kind", [(group, name) for group, makes in KINDS.items() for name in makes])
def test_each_kind_of_step_trains_and_is_scored_at_half_and_all_of_the_time(
    scene: Scene, kind: tuple[str, str]
) -> None:
    trainer = KINDS[kind[0]][kind[1]](scene, 0)
    half, end = run(scene, trainer, 1e-9)
    assert half == end
    assert trainer.iteration == 1
