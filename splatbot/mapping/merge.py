"""Making room under the cap: near-identical neighbours become one Gaussian of the same moments."""

from __future__ import annotations

from dataclasses import fields

import torch
from torch import Tensor

from splatbot.gaussians import GaussianModel
from splatbot.gaussians.shape import covariances, shortest_axes
from splatbot.geometry import rotation_to_quat

_CELLS = 4.0  # side of the cells in which partners are sought [median largest σ]
_NEAR = 2.6  # new neighbours lie 2 σ apart: a map over its cap becomes coarser, not thinner [σ]
_COLOUR = 0.15  # [0..1] and their colours differ by at most this
_PARALLEL = 0.9  # cosine of their shortest axes
_SIZE = 2.0  # and their largest σ by at most this factor


def merge_similar(model: GaussianModel, excess: int) -> tuple[GaussianModel, Tensor]:
    """The model with up to ``excess`` pairs merged, most alike first, and the rows (ascending) that it kept.

    A merged Gaussian has the mean and covariance of the two weighted by opacity times size, which also gives its colour
    and its opacity; it takes the first one's row.
    """
    first, second = _pairs(model)
    cost = _unlikeness(model, first, second)
    chosen = torch.argsort(cost, stable=True)[: min(excess, int(torch.isfinite(cost).sum()))]
    first, second = first[chosen], second[chosen]
    keep = torch.ones(len(model), dtype=torch.bool)
    keep[second] = False
    rows = keep.nonzero()[:, 0]
    merged = model.select(rows)
    _write(merged, torch.searchsorted(rows, first), _merge(model.select(first), model.select(second)))
    return merged, rows


def _pairs(model: GaussianModel) -> tuple[Tensor, Tensor]:
    """Rows of neighbours: two that follow each other in a cell of space; no row is in two pairs."""
    nothing = torch.zeros(0, dtype=torch.long)
    if len(model) < 2:
        return nothing, nothing
    side = _CELLS * float(model.scales.amax(1).median())
    cells = torch.floor((model.means.double() - model.means.double().mean(0)) / side + 0.5).long()
    key = (cells[:, 0] * 1_000_003 + cells[:, 1]) * 1_000_003 + cells[:, 2]
    order = torch.argsort(key, stable=True)
    starts = torch.ones(len(order), dtype=torch.bool)
    starts[1:] = key[order][1:] != key[order][:-1]
    place = torch.arange(len(order))
    within = place - torch.cummax(torch.where(starts, place, 0), 0).values
    opens = (within[:-1] % 2 == 0) & ~starts[1:]
    return order[:-1][opens], order[1:][opens]


def _unlikeness(model: GaussianModel, first: Tensor, second: Tensor) -> Tensor:
    """Squared distance of centres in σ (P,); inf for pairs that must not merge."""
    a, b = model.select(first), model.select(second)
    between = a.means - b.means
    spread = (covariances(a) + covariances(b)) / 2
    along = torch.linalg.solve(spread + 1e-12 * torch.eye(3), between[..., None])[..., 0] if len(a) else between
    cost = (between * along).sum(1)
    sizes = a.log_scales.amax(1) - b.log_scales.amax(1)
    alike = (a.colors - b.colors).abs().amax(1) < _COLOUR
    alike &= (shortest_axes(a) * shortest_axes(b)).sum(1).abs() > _PARALLEL
    alike &= sizes.abs() < torch.tensor(_SIZE).log()
    alike &= (a.observations > 0) == (b.observations > 0)
    return torch.where(alike & (cost < _NEAR**2), cost, torch.inf)


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
    opacities = (weights.sum(0) / _area(merged)).clamp(0.01, 0.99)
    merged.opacity_logits = torch.logit(
        torch.maximum(opacities, torch.minimum(a.opacities, b.opacities)).clamp_max(0.99)
    )
    return merged


def _area(model: GaussianModel) -> Tensor:
    """Product of the two largest σ (N,) [m²]."""
    return (model.log_scales.sum(1) - model.log_scales.amin(1)).exp()


def _write(model: GaussianModel, rows: Tensor, values: GaussianModel) -> None:
    for field in fields(GaussianModel):
        getattr(model, field.name)[rows] = getattr(values, field.name)
