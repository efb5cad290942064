"""Merging: similar neighbors become one Gaussian of the same moments, to keep the map below its size limit."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from splatbot.gaussians import GaussianModel
from splatbot.gaussians.shape import covariances, shortest_axes
from splatbot.geometry import rotation_to_quat


@dataclass(frozen=True)
class MergeConstants:
    """Constants of merging.

    Args:
        cell_size: [median of the largest σ] side of the cells in which pairs are formed.
        largest_distance: [σ] distance of the centers of a pair. New neighbors are 2 σ apart, so a map above its limit
            becomes coarser and not sparser.
        color_difference: [0..1] largest difference of a color channel within a pair.
        parallel_cosine: least cosine of the shortest axes of a pair.
        size_ratio: largest ratio of the largest σ within a pair.
        least_opacity, most_opacity: limits of the merged opacity.
    """

    cell_size: float = 4.0
    largest_distance: float = 2.6
    color_difference: float = 0.15
    parallel_cosine: float = 0.9
    size_ratio: float = 2.0
    least_opacity: float = 0.01
    most_opacity: float = 0.99


CONSTANTS = MergeConstants()


def merge_similar(model: GaussianModel, excess: int) -> tuple[GaussianModel, Tensor]:
    """Return the model with up to ``excess`` pairs merged, the most similar first, and the kept rows, ascending.

    With weights w = opacity · area normalized to 1, the merged Gaussian has the moments of the mixture:
    μ = Σ w_i μ_i and Σ = Σ w_i (Σ_i + (μ_i - μ)(μ_i - μ)ᵀ). It takes the row of the first one.
    """
    first, second = _pairs(model)
    cost = _merge_cost(model, first, second)
    chosen = torch.argsort(cost, stable=True)[: min(excess, int(torch.isfinite(cost).sum()))]
    first, second = first[chosen], second[chosen]
    keep = torch.ones(len(model), dtype=torch.bool)
    keep[second] = False
    rows = keep.nonzero()[:, 0]
    merged = model.select(rows)
    _write(merged, torch.searchsorted(rows, first), _merge(model.select(first), model.select(second)))
    return merged, rows


def _pairs(model: GaussianModel) -> tuple[Tensor, Tensor]:
    """Return the rows of disjoint pairs: two successive Gaussians in a cell of space."""
    nothing = torch.zeros(0, dtype=torch.long)
    if len(model) < 2:
        return nothing, nothing
    side = CONSTANTS.cell_size * float(model.scales.amax(1).median())
    cells = torch.floor((model.means.double() - model.means.double().mean(0)) / side + 0.5).long()
    key = (cells[:, 0] * 1_000_003 + cells[:, 1]) * 1_000_003 + cells[:, 2]
    order = torch.argsort(key, stable=True)
    starts = torch.ones(len(order), dtype=torch.bool)
    starts[1:] = key[order][1:] != key[order][:-1]
    place = torch.arange(len(order))
    within = place - torch.cummax(torch.where(starts, place, 0), 0).values
    opens = (within[:-1] % 2 == 0) & ~starts[1:]
    return order[:-1][opens], order[1:][opens]


def _merge_cost(model: GaussianModel, first: Tensor, second: Tensor) -> Tensor:
    """Compute the squared Mahalanobis distance (P,) of the centers; inf for pairs that must not merge."""
    a, b = model.select(first), model.select(second)
    between = a.means - b.means
    spread = (covariances(a) + covariances(b)) / 2
    along = torch.linalg.solve(spread + 1e-12 * torch.eye(3), between[..., None])[..., 0] if len(a) else between
    cost = (between * along).sum(1)
    sizes = a.log_scales.amax(1) - b.log_scales.amax(1)
    similar = (a.colors - b.colors).abs().amax(1) < CONSTANTS.color_difference
    similar &= (shortest_axes(a) * shortest_axes(b)).sum(1).abs() > CONSTANTS.parallel_cosine
    similar &= sizes.abs() < torch.tensor(CONSTANTS.size_ratio).log()
    similar &= (a.observations > 0) == (b.observations > 0)
    return torch.where(similar & (cost < CONSTANTS.largest_distance**2), cost, torch.inf)


def _merge(a: GaussianModel, b: GaussianModel) -> GaussianModel:
    weights = torch.stack([m.opacities * _area(m) for m in (a, b)])
    share = weights / weights.sum(0)
    p, q = share[0][:, None], share[1][:, None]
    means = p * a.means + q * b.means
    spread = torch.zeros(len(a), 3, 3)
    for s, m in ((p, a), (q, b)):
        away = m.means - means
        spread += s[..., None] * (covariances(m) + away[:, :, None] * away[:, None, :])
    values, axes = torch.linalg.eigh(spread.double())
    axes[:, :, 0] *= torch.linalg.det(axes)[:, None]  # eigenvectors may be left-handed
    log_scales = 0.5 * values.clamp_min(1e-18).log().float()
    merged = GaussianModel(
        means=means,
        quats=torch.from_numpy(rotation_to_quat(axes.numpy())).float().reshape(-1, 4),
        log_scales=log_scales,
        opacity_logits=torch.zeros(len(a)),
        sh=p[..., None] * a.sh + q[..., None] * b.sh,
        observations=torch.maximum(a.observations, b.observations),
        anchors=torch.where(share[0] >= share[1], a.anchors, b.anchors),
        uncertainty=(p[:, 0] * a.uncertainty.square() + q[:, 0] * b.uncertainty.square()).sqrt(),
        misses=torch.minimum(a.misses, b.misses),
    )
    opacities = (weights.sum(0) / _area(merged)).clamp(CONSTANTS.least_opacity, CONSTANTS.most_opacity)
    merged.opacity_logits = torch.logit(
        torch.maximum(opacities, torch.minimum(a.opacities, b.opacities)).clamp_max(CONSTANTS.most_opacity)
    )
    return merged


def _area(model: GaussianModel) -> Tensor:
    """Compute the product of the two largest σ (N,) [m²]."""
    return (model.log_scales.sum(1) - model.log_scales.amin(1)).exp()


def _write(model: GaussianModel, rows: Tensor, values: GaussianModel) -> None:
    for field in fields(GaussianModel):
        getattr(model, field.name)[rows] = getattr(values, field.name)
