"""Completion: confirmed depth of keyframes that the collision field of the map misses becomes Gaussians."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.collision.confirmed import CONSTANTS as CONFIRMED
from splatbot.collision.field import GaussianCollisionField
from splatbot.collision.visibility import measured_depths, passing_distance
from splatbot.config import MappingConfig
from splatbot.gaussians import GaussianModel
from splatbot.geometry import transform_points
from splatbot.mapping.culling import view_distances
from splatbot.mapping.depth_fusion import DepthNoiseModel, initial_uncertainty
from splatbot.mapping.insertion import new_gaussians
from splatbot.mapping.keyframes import Keyframe

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class DepthCompletionConstants:
    """Constants of completion.

    Args:
        explained_distance: [m] depth within this distance of an ellipsoid is explained, even if its noise is smaller.
        explained_sigma: [σ of depth] the same, relative to the noise.
        opacity: of an added Gaussian. Images mostly show the surface there already, and a higher opacity costs up to
            0.2 dB; segmentation requires 0.3.
        neighbours: number of nearest keyframes that may confirm depth, or see through it.
    """

    explained_distance: float = 0.003
    explained_sigma: float = 1.5
    opacity: float = 0.31
    neighbours: int = 16


CONSTANTS = DepthCompletionConstants()


def missing_gaussians(
    model: GaussianModel, keyframes: Sequence[Keyframe], config: MappingConfig, noise: DepthNoiseModel
) -> GaussianModel:
    """Return Gaussians for the confirmed depth of all keyframes that the map does not explain.

    Depth is explained if an ellipsoid of the collision field is within max(3 mm, 1.5 σ_z) of its point. It is confirmed
    as in :mod:`splatbot.collision.confirmed`, by the nearest 16 keyframes. Each keyframe proposes the pixels that
    insertion uses. Gaussians that an earlier keyframe added explain the depth of later ones.
    """
    field = GaussianCollisionField(model)
    added = GaussianModel.empty()
    distances = view_distances(keyframes)
    for row, keyframe in enumerate(keyframes):
        v, u, points = _proposed(keyframe, config)
        allowed = _explained_distance(keyframe.depth.numpy()[v, u], noise)
        open_rows = np.flatnonzero(~field.in_collision(np.c_[points, allowed]))
        if len(added):
            again = GaussianCollisionField(added).in_collision(np.c_[points, allowed][open_rows])
            open_rows = open_rows[~again]
        near = np.argsort(distances[row], kind="stable")[: CONSTANTS.neighbours]
        others = [keyframes[k] for k in near if k != row]
        confirmed = open_rows[confirmed_by(points[open_rows], others, noise)]
        where = np.zeros(keyframe.depth.shape, np.bool_)
        where[v[confirmed], u[confirmed]] = True
        new = new_gaussians(keyframe, torch.from_numpy(where), config)
        new.opacity_logits.fill_(math.log(CONSTANTS.opacity / (1 - CONSTANTS.opacity)))
        new.uncertainty = initial_uncertainty(new, keyframe.T_world_camera, noise)
        added = GaussianModel.concatenate([added, new])
    return added


def confirmed_by(points: NDArray[np.float64], others: Sequence[Keyframe], noise: DepthNoiseModel) -> Mask:
    """Return which points (P, 3) [m, world] the depth of two other keyframes confirms and hardly any sees through."""
    agreeing, passing, measuring = (np.zeros(len(points), np.int32) for _ in range(3))
    for other in others:
        rows, measured, own = measured_depths(points, other.depth.numpy(), other.camera, other.T_world_camera)
        agreeing[rows[np.abs(measured - own) <= CONFIRMED.agreement_sigma * noise(torch.from_numpy(own)).numpy()]] += 1
        passing[rows[measured - own > passing_distance(own)]] += 1
        measuring[rows] += 1
    return (agreeing >= CONFIRMED.agreeing_views) & (passing <= CONFIRMED.through_share * measuring)


def _proposed(
    keyframe: Keyframe, config: MappingConfig
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return rows, columns (P,) and points (P, 3) [m, world] of the pixels with depth on the grid of insertion."""
    s, depth = config.stride, keyframe.depth.numpy()
    v, u = np.mgrid[s // 2 : depth.shape[0] : s, s // 2 : depth.shape[1] : s].reshape(2, -1)
    known = depth[v, u] > 0
    v, u = v[known], u[known]
    z, camera = depth[v, u].astype(np.float64), keyframe.camera
    ray = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(z))], axis=1)
    return v, u, transform_points(keyframe.T_world_camera, ray * z[:, None])


def _explained_distance(depth: NDArray[np.float32], noise: DepthNoiseModel) -> NDArray[np.float64]:
    sigma = noise(torch.from_numpy(depth)).numpy().astype(np.float64)
    return np.maximum(CONSTANTS.explained_distance, CONSTANTS.explained_sigma * sigma)
