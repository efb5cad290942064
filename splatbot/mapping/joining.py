"""Joining of two maps in one world: common surface is fused, and the later map removes surface that it sees through."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from splatbot.collision.changes import evidence_around
from splatbot.config import MappingConfig
from splatbot.gaussians import GaussianModel
from splatbot.gaussians.shape import rotations
from splatbot.geometry import transform_points
from splatbot.mapping.depth_fusion import (
    DepthNoiseModel,
    compare_with_depth,
    fuse_depth,
    fuse_normals,
    update_visibility,
)
from splatbot.mapping.keyframes import Keyframe
from splatbot.mapping.prune import keep_mask

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class JoiningConstants:
    """Constants of joining.

    Args:
        gap: [m] distance along the normal within which two Gaussians are one surface, plus 3 σ of both.
        reach: [σ] distance across the normal within which a Gaussian covers the centre of another.
        neighbours: number of nearest Gaussians that may cover one.
        step: [px] spacing of the pixels of earlier keyframes that are compared with later depth.
        passing_views: number of later keyframes that see through a pixel of an earlier one, if none measures it.
        views: largest number of later keyframes that a keyframe is compared with.
    """

    gap: float = 0.01
    reach: float = 2.0
    neighbours: int = 16
    step: int = 4
    passing_views: int = 2
    views: int = 40


CONSTANTS = JoiningConstants()


@dataclass(frozen=True, eq=False)
class JoinedModel:
    """The Gaussians of two maps as one map.

    Args:
        model: those of A that remain, then those that B adds.
        kept: number of Gaussians of A that remain.
        removed: number of Gaussians of A that the depth of B sees through.
        added: number of Gaussians of B where A has no surface.
        covered: number of Gaussians of B whose surface A has.
    """

    model: GaussianModel
    kept: int
    removed: int
    added: int
    covered: int

    @property
    def overlap(self) -> float:
        """Share of the Gaussians of B whose surface A has."""
        return self.covered / max(self.covered + self.added, 1)


def join_models(
    a: GaussianModel, b: GaussianModel, keyframes_b: Sequence[Keyframe], config: MappingConfig, noise: DepthNoiseModel
) -> JoinedModel:
    """Join the Gaussians of a map B to those of an earlier map A in the same world.

    The depth of each keyframe of B supports, moves or sees through the Gaussians of A, as that of a new keyframe of A
    (:mod:`splatbot.mapping.depth_fusion`). The Gaussians of B that no remaining Gaussian of A covers are added.

    Args:
        a, b: Gaussians of harmonics of degree 0, in the world of A.
        keyframes_b: keyframes of B in the world of A.
        config: limits of Gaussians.
        noise: of the depth of B.
    """
    for keyframe in keyframes_b:
        comparison = compare_with_depth(a, keyframe.depth, keyframe.camera, keyframe.T_world_camera, noise)
        a = update_visibility(fuse_normals(fuse_depth(a, comparison), comparison), comparison)
    keep = keep_mask(a, config)
    kept = a.select(keep.nonzero()[:, 0])
    new = torch.from_numpy(~covered(b, kept))
    model = GaussianModel.concatenate([kept, b.select(new.nonzero()[:, 0])])
    added = int(new.sum())
    return JoinedModel(model, len(kept), len(keep) - len(kept), added, len(b) - added)


def covered(model: GaussianModel, by: GaussianModel) -> Mask:
    """Return which Gaussians (N,) of a model lie on the surface of another one.

    A Gaussian with the center μ and the normal n covers a point μ + d if |nᵀd| is below the gap. Across the normal, d
    must be within 2 σ.
    """
    if not len(model) or not len(by):
        return np.zeros(len(model), np.bool_)
    points, centers = model.means.numpy().astype(np.float64), by.means.numpy().astype(np.float64)
    axes, scales = rotations(by).numpy().astype(np.float64), by.scales.numpy().astype(np.float64)
    normal = scales.argmin(axis=1)
    found = np.zeros(len(points), np.bool_)
    _, nearest = cKDTree(centers).query(points, k=min(CONSTANTS.neighbours, len(centers)))
    for row in nearest.reshape(len(points), -1).T:
        local = np.abs(np.einsum("nij,ni->nj", axes[row], points - centers[row]))
        through = np.arange(3) == normal[row, None]
        spread = np.hypot(model.uncertainty.numpy(), by.uncertainty.numpy()[row])
        across = np.where(through, 0.0, local / scales[row])
        near = local[through] < CONSTANTS.gap + 3 * spread
        found |= near & (np.linalg.norm(across, axis=1) < CONSTANTS.reach)
    return found


def without_contradicted(keyframe: Keyframe, later: Sequence[Keyframe]) -> Keyframe:
    """Return a keyframe without the pixels whose surface later keyframes see through.

    Refinement and completion would otherwise bring back an object that is gone. Every fourth pixel along both axes
    is compared, with at most 40 evenly spaced later keyframes.
    """
    step, depth = CONSTANTS.step, keyframe.depth.numpy()
    small = depth[::step, ::step]
    points = keyframe.camera.backproject(depth)[::step, ::step].reshape(-1, 3)
    chosen = later[:: max(1, -(-len(later) // CONSTANTS.views))]
    views = [(other.depth.numpy(), other.camera, other.T_world_camera) for other in chosen]
    passes, hits = evidence_around(transform_points(keyframe.T_world_camera, points.astype(np.float64)), views)
    gone = ((passes >= CONSTANTS.passing_views) & (hits == 0)).reshape(small.shape) & (small > 0)
    if not gone.any():
        return keyframe
    around = cv2.dilate(gone.astype(np.uint8), np.ones((3, 3), np.uint8))
    static = torch.from_numpy(np.kron(around, np.ones((step, step), np.uint8))[: depth.shape[0], : depth.shape[1]] == 0)
    mask = static if keyframe.static_mask is None else keyframe.static_mask & static
    return replace(keyframe, static_mask=mask, depth=torch.where(static, keyframe.depth, 0.0))
