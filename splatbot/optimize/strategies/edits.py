"""Changes of the rows of a model, with the optimizer's moments: the steps that strategies are made of.

Each function returns the changed model and changes ``adam`` in place. New rows begin with moments of zero.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from splatbot.gaussians import GaussianModel
from splatbot.gaussians.model import OPACITY_MAX
from splatbot.gaussians.shape import rotations
from splatbot.optimize.adam import GaussianAdam

_SPLIT_SHRINKS = 1.6  # σ of a half is σ / 1.6 (Kerbl et al. 2023, Sec. 5.2)
_MOST_COPIES = 51  # copies of a Gaussian that one relocation counts, as gsplat's n_max


def duplicate(model: GaussianModel, adam: GaussianAdam, chosen: Tensor) -> GaussianModel:
    """Append a copy of each row that ``chosen`` (N,) marks."""
    grown = GaussianModel.concatenate([model, model.select(chosen)])
    adam.extend(grown)
    return grown


def split(
    model: GaussianModel,
    adam: GaussianAdam,
    chosen: Tensor,
    *,
    random: torch.Generator,
    revised_opacity: bool = False,
) -> GaussianModel:
    """Replace each row that ``chosen`` (N,) marks by two that are drawn from it: μ' = μ + R diag(σ) ξ, σ' = σ / 1.6.

    Args:
        revised_opacity: o' = 1 - √(1 - o), so that two halves cover as the whole did (Bulò et al. 2024).
    """
    whole = model.select(chosen)
    halves = GaussianModel.concatenate([whole, whole])
    noise = torch.randn(len(halves), 3, generator=random)
    halves.means += (rotations(halves) @ (halves.scales * noise)[..., None])[..., 0]
    halves.log_scales -= math.log(_SPLIT_SHRINKS)
    if revised_opacity:
        halves.opacity_logits = torch.logit(1 - (1 - halves.opacities.double()).sqrt()).float()
    adam.select(~chosen)
    changed = GaussianModel.concatenate([model.select(~chosen), halves])
    adam.extend(changed)
    return changed


def remove(model: GaussianModel, adam: GaussianAdam, chosen: Tensor) -> GaussianModel:
    """Remove the rows that ``chosen`` (N,) marks."""
    adam.select(~chosen)
    return model.select(~chosen)


def reset_opacities(model: GaussianModel, adam: GaussianAdam, most: float) -> GaussianModel:
    """Limit opacities to ``most`` and forget their moments (Kerbl et al. 2023, Sec. 5.2)."""
    adam.forget(torch.arange(len(model)), ("opacity_logits",))
    return replace(model, opacity_logits=model.opacity_logits.clamp(max=math.log(most / (1 - most))))


def relocate(
    model: GaussianModel, adam: GaussianAdam, dead: Tensor, *, least_opacity: float, random: torch.Generator
) -> GaussianModel:
    """Move each row that ``dead`` (N,) marks onto a living one, drawn by opacity (Kheradmand et al. 2024, Sec. 4.2).

    The copies are changed by :func:`compute_relocation`, so that together they look as the one did.
    """
    rows, alive = dead.nonzero()[:, 0], (~dead).nonzero()[:, 0]
    if not len(rows) or not len(alive):
        return model
    drawn = alive[_draw(model.opacities[alive], len(rows), random)]
    changed = _share(model, drawn, least_opacity)
    for tensor in (changed.means, changed.quats, changed.log_scales, changed.opacity_logits, changed.sh):
        tensor[rows] = tensor[drawn]
    for bookkeeping in (changed.observations, changed.anchors, changed.uncertainty, changed.misses):
        bookkeeping[rows] = bookkeeping[drawn]
    adam.forget(drawn)
    return changed


def sample_add(
    model: GaussianModel, adam: GaussianAdam, count: int, *, least_opacity: float, random: torch.Generator
) -> GaussianModel:
    """Append ``count`` copies of rows drawn by opacity, changed as in :func:`relocate`."""
    drawn = _draw(model.opacities, count, random)
    shared = _share(model, drawn, least_opacity)
    grown = GaussianModel.concatenate([shared, shared.select(drawn)])
    adam.extend(grown)
    return grown


def grow_harmonics(model: GaussianModel, adam: GaussianAdam, degree: int) -> GaussianModel:
    """Extend the harmonics by zeros up to ``degree``."""
    missing = (degree + 1) ** 2 - model.sh.shape[1]
    if missing <= 0:
        return model

    def pad(tensor: Tensor) -> Tensor:
        return torch.nn.functional.pad(tensor, (0, 0, 0, missing))

    for moments in (adam.first, adam.second):
        moments["sh"] = pad(moments["sh"])
    return replace(model, sh=pad(model.sh))


def compute_relocation(opacities: Tensor, scales: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Compute opacity and scales of n equal Gaussians that look as one (Kheradmand et al. 2024, Eq. 9).

    o' = 1 - (1 - o)^(1/n); σ' = σ o / Σ_{k=0}^{n-1} C(n, k+1) (-1)^k o'^(k+1) / √(k+1), where the inner sums of
    Eq. 9 are summed by Σ_{i=k}^{n-1} C(i, k) = C(n, k+1). Computed in float64.

    Args:
        opacities: (M,) in 0..1.
        scales: (M, 3) [m].
        copies: (M,) n, clamped to 1..51.

    Returns:
        o' (M,) and σ' (M, 3), float32.
    """
    o = opacities.double().clamp(1e-12, OPACITY_MAX)
    n = copies.long().clamp(1, _MOST_COPIES)
    table = torch.tensor([[math.comb(i, k + 1) for k in range(_MOST_COPIES)] for i in range(_MOST_COPIES + 1)]).double()
    k = torch.arange(_MOST_COPIES).double()
    new = -torch.expm1(torch.log1p(-o) / n)
    terms = table[n] * (1 - 2 * (k % 2)) / (k + 1).sqrt() * new[:, None] ** (k + 1)
    return new.float(), (scales.double() * (o / terms.sum(1))[:, None]).float()


def inject_noise(model: GaussianModel, scale: float, *, random: torch.Generator) -> None:
    """Add noise to the means, in place: Σ ξ times ``scale`` and a gate (Kheradmand et al. 2024, Eq. 6).

    The gate 1 / (1 + exp(-100 (0.005 - o))) is below 1e-6 for opacities above 0.15, which are left alone.
    """
    faint = (model.opacity_logits < math.log(0.15 / 0.85)).nonzero()[:, 0]
    quats, log_scales, logits = (
        tensor.index_select(0, faint) for tensor in (model.quats, model.log_scales, model.opacity_logits)
    )
    gate = torch.sigmoid(100 * (0.005 - torch.sigmoid(logits)))
    noise = torch.randn(len(faint), 3, generator=random) * (gate * scale)[:, None]
    quats = torch.nn.functional.normalize(quats, dim=1)
    w, v = quats[:, :1], quats[:, 1:]
    local = _rotate(w, -v, noise) * (2 * log_scales).exp()
    model.means.index_add_(0, faint, _rotate(w, v, local))


def _rotate(w: Tensor, v: Tensor, x: Tensor) -> Tensor:
    """Rotate vectors (N, 3) by unit quaternions w (N, 1), v (N, 3): x + 2 w v × x + 2 v × (v × x)."""
    twice = 2 * torch.linalg.cross(v, x)
    return x + w * twice + torch.linalg.cross(v, twice)


def _draw(opacities: Tensor, count: int, random: torch.Generator) -> Tensor:
    """Draw ``count`` indices with probabilities in proportion to ``opacities``; any number of Gaussians."""
    cumulative = opacities.double().cumsum(0)
    draws = torch.rand(count, generator=random, dtype=torch.float64) * cumulative[-1]
    return torch.searchsorted(cumulative, draws, right=True).clamp_max(len(opacities) - 1)


def _share(model: GaussianModel, drawn: Tensor, least_opacity: float) -> GaussianModel:
    """Return a copy where the rows in ``drawn`` are changed to be one of their copies."""
    copies = torch.bincount(drawn, minlength=len(model)) + 1
    rows = (copies > 1).nonzero()[:, 0]
    opacities, scales = compute_relocation(model.opacities[rows], model.scales[rows], copies[rows])
    shared = model.clone()
    shared.opacity_logits[rows] = torch.logit(opacities.double().clamp(least_opacity, OPACITY_MAX)).float()
    shared.log_scales[rows] = scales.log()
    return shared
