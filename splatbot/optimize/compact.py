"""Compaction: groups of Gaussians become one Gaussian each, which encloses its members.

One group of all Gaussians is split, then always the groups that cost most, until their number is reached. The cost of a
group is the square root of its volume times its image error. Thus many Gaussians remain where images show detail, and
few where colours are even. Pruning by the same importance leaves holes, which Mini-Splatting and LightGaussian close by
training. A collision field would miss the removed surface.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from splatbot.collision import GaussianCollisionField
from splatbot.collision.hulls import Array, Hulls, Ints, enclosing_hulls, group_sums
from splatbot.collision.solids import SolidGate
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import quat_to_rotation


@dataclass(frozen=True)
class CompactConstants:
    """Constants of compaction.

    Args:
        least_weight: [px] importance of a Gaussian that no view shows, so that its volume has a cost.
        evenness: [1] squared colour difference that a group of one colour counts, so that blur has a cost too.
        split_share: largest share of the groups that is split at once.
        least_opacity, most_opacity: limits of a group's opacity.
        spheres: number of spheres that compare two fields.
        reach: [m] standard deviation of their distance to Gaussians, and largest radius.
    """

    least_weight: float = 0.01
    evenness: float = 1e-3
    split_share: float = 0.5
    least_opacity: float = 0.01
    most_opacity: float = 0.99
    spheres: int = 100_000
    reach: float = 0.02


CONSTANTS = CompactConstants()


@dataclass(frozen=True)
class FieldChange:
    """Answers of two collision fields to the same spheres near surfaces.

    Args:
        hit: number of spheres that hit the first field.
        missed: number of those that the second one calls free.
        free: number of spheres that are free in the first field.
        blocked: number of those that hit the second one.
        closer_m: mean loss of clearance of the free ones [m].
    """

    hit: int
    missed: int
    free: int
    blocked: int
    closer_m: float


@dataclass(frozen=True, eq=False)
class _Groups:
    """Groups of Gaussians.

    Args:
        of: (N,) group of each Gaussian.
        hulls: of G groups.
        sizes: (G,) number of members.
        costs: (G,) of keeping the group as one Gaussian; 0 for a single member.
    """

    of: Ints
    hulls: Hulls
    sizes: Ints
    costs: Array


def compact(model: GaussianModel, weights: Tensor, count: int) -> GaussianModel:
    """Return a map of at most ``count`` Gaussians.

    Each Gaussian that a collision field counts is enclosed by one of the result at 2 and more standard deviations. So
    the field of the result hits all that the field of the map hits. Single Gaussians are unchanged, and come first.

    Args:
        model: the map, of N Gaussians.
        weights: (N,) importance [px], see :func:`splatbot.optimize.importance.blended_weights`.
        count: largest number of Gaussians.

    Raises:
        InputError: the count is below 1, or the map has no Gaussian that counts.
    """
    if count < 1:
        raise InputError(f"is {count}.", field="count", hint="give 1 or more")
    counted = torch.from_numpy(SolidGate().solid(model)) | (weights > 0)
    if not bool(counted.any()):
        raise InputError(
            "has no Gaussian that images or collision checks count.", field="model", hint="map a log first"
        )
    model, weights = model.select(counted), weights[counted].clamp_min(CONSTANTS.least_weight)
    if len(model) <= count:
        return model
    groups = _grouped(model, weights.double().numpy(), count)
    alone = torch.from_numpy(groups.sizes == 1)
    single = alone[torch.from_numpy(groups.of)]
    return GaussianModel.concatenate([model.select(single), _merged(model, weights, groups).select(~alone)])


def field_change(before: GaussianModel, after: GaussianModel, n_sigma: float = 2.0, *, seed: int = 0) -> FieldChange:
    """Compare the collision fields of two maps by random spheres around the Gaussians of the first one.

    Raises:
        InputError: no Gaussian of the first map is solid.
    """
    rng = np.random.default_rng(seed)
    means = before.means.numpy()[SolidGate().solid(before)]
    if len(means) == 0:
        raise InputError("has no Gaussian that depth supports.", field="model", hint="map a log first")
    points = means[rng.integers(0, len(means), CONSTANTS.spheres)]
    points = points + rng.normal(0.0, CONSTANTS.reach, points.shape)
    spheres = np.c_[points, rng.uniform(0.0, CONSTANTS.reach, len(points))]
    fields = [GaussianCollisionField(model, n_sigma) for model in (before, after)]
    hit, hit_after = (field.in_collision(spheres) for field in fields)
    clearance, clearance_after = (field.clearance(spheres[~hit]).distance for field in fields)
    return FieldChange(
        hit=int(hit.sum()),
        missed=int((hit & ~hit_after).sum()),
        free=int((~hit).sum()),
        blocked=int((hit_after & ~hit).sum()),
        closer_m=float(np.mean(clearance - clearance_after)) if not hit.all() else 0.0,
    )


def _grouped(model: GaussianModel, weights: Array, count: int) -> _Groups:
    """Split the most expensive groups until there are ``count``."""
    means, colors = model.means.double().numpy(), model.colors.double().numpy()
    groups = _assess(model, colors, weights, np.zeros(len(model), np.int64), 1)
    while len(groups.costs) < count:
        n = len(groups.costs)
        most = min(count - n, int(np.ceil(CONSTANTS.split_share * n)))
        chosen = np.argsort(-groups.costs, kind="stable")[:most]
        of, fresh = _split(means, groups, chosen[groups.costs[chosen] > 0])
        if len(fresh) == 0:
            break
        rows = np.flatnonzero(np.isin(of, fresh))
        number = np.full(of.max() + 1, -1)
        number[fresh] = np.arange(len(fresh))
        part = _assess(model.select(torch.from_numpy(rows)), colors[rows], weights[rows], number[of[rows]], len(fresh))
        groups = _updated(groups, of, fresh, part)
    return groups


def _assess(model: GaussianModel, colors: Array, weights: Array, of: Ints, n: int) -> _Groups:
    """Return groups with hulls and costs; the image error is Σ w |c - mean c|², as if all members had one colour."""
    hulls, sizes = enclosing_hulls(model, of, n), np.bincount(of, minlength=n)
    total = np.bincount(of, weights, n)
    mean = group_sums(weights[:, None] * colors, of, n) / total[:, None]
    error = np.bincount(of, weights * ((colors - mean[of]) ** 2).sum(axis=1), n) + CONSTANTS.evenness * total
    costs = np.where(sizes > 1, np.sqrt(hulls.scales.prod(axis=1)) * error, 0.0)
    return _Groups(of, hulls, sizes, costs)


def _split(means: Array, groups: _Groups, chosen: Ints) -> tuple[Ints, Ints]:
    """Split groups across their longest axis; return the group (N,) of each Gaussian, and the changed groups."""
    n, hulls = len(groups.costs), groups.hulls
    rows = np.flatnonzero(np.isin(groups.of, chosen))
    of = groups.of[rows]
    axes = quat_to_rotation(hulls.quats)[np.arange(n), :, hulls.scales.argmax(axis=1)]
    along = ((means[rows] - hulls.means[of]) * axes[of]).sum(axis=1)
    middle = np.bincount(of, along, n) / groups.sizes
    beyond = along > middle[of]
    parted = np.unique(of[beyond])  # members at one place do not part
    number = np.full(n, -1)
    number[parted] = n + np.arange(len(parted))
    changed = groups.of.copy()
    changed[rows[beyond]] = number[of[beyond]]
    return changed, np.concatenate([parted, number[parted]])


def _updated(groups: _Groups, of: Ints, fresh: Ints, part: _Groups) -> _Groups:
    """Return groups for the new groups ``of`` (N,), where the groups ``fresh`` are those of ``part``."""
    n = int(fresh.max()) + 1

    def column(old: Array, new: Array) -> Array:
        values = np.zeros((n, *old.shape[1:]), old.dtype)
        values[: len(old)] = old
        values[fresh] = new
        return values

    pairs = zip(vars(groups.hulls).values(), vars(part.hulls).values(), strict=True)
    hulls = Hulls(*(column(old, new) for old, new in pairs))
    sizes = np.bincount(of, minlength=n)
    return _Groups(of, hulls, sizes, column(groups.costs, part.costs))


def _merged(model: GaussianModel, weights: Tensor, groups: _Groups) -> GaussianModel:
    """Return one Gaussian a group: its hull, the mean colour by importance, and the opacity of equal area."""
    of, n = torch.from_numpy(groups.of), len(groups.costs)
    sh = torch.zeros(n, *model.sh.shape[1:]).index_add_(0, of, model.sh * weights[:, None, None])
    hulls = GaussianModel(
        means=torch.from_numpy(groups.hulls.means).float(),
        quats=torch.from_numpy(groups.hulls.quats).float(),
        log_scales=torch.from_numpy(np.log(groups.hulls.scales)).float(),
        opacity_logits=torch.zeros(n),
        sh=sh / torch.zeros(n).index_add_(0, of, weights)[:, None, None],
        observations=_reduced(model.observations, of, n, "amax"),
        anchors=_reduced(model.anchors, of, n, "amax"),
        uncertainty=_reduced(model.uncertainty, of, n, "amax"),
        misses=_reduced(model.misses, of, n, "amin"),
    )
    covered = torch.zeros(n).index_add_(0, of, model.opacities * _area(model))
    opacities = (covered / _area(hulls)).clamp(CONSTANTS.least_opacity, CONSTANTS.most_opacity)
    return replace(hulls, opacity_logits=torch.logit(opacities))


def _reduced(values: Tensor, of: Tensor, n: int, reduce: str) -> Tensor:
    return torch.zeros(n, dtype=values.dtype).scatter_reduce(0, of.long(), values, reduce, include_self=False)


def _area(model: GaussianModel) -> Tensor:
    """Compute the product of the two largest σ (N,) [m²]."""
    return (model.log_scales.sum(1) - model.log_scales.amin(1)).exp()
