"""Changes of the map that a look from the wrist shows: a target that moved, and new obstacles."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.collision.moving import with_balls
from splatbot.gaussians import GaussianModel
from splatbot.geometry import quat_multiply, rotation_to_quat, transform_points
from splatbot.grasping.sampler import GraspSampler
from splatbot.grasping.types import Grasp
from splatbot.protocols import Array


def moved_sampler(sampler: GraspSampler, rows: NDArray[np.int64], T_now_before: Array) -> GraspSampler:
    """Return the sampler on a map of which some Gaussians moved; its raw depth remains that of the old place.

    Args:
        sampler: the sampler.
        rows: (M,) Gaussians of the target.
        T_now_before: (4, 4) their motion in the world [m].
    """
    found = copy.copy(sampler)
    found.scene = replace(sampler.scene, model=moved_rows(sampler.scene.model, rows, T_now_before))
    found.field = found.collision_field(found.scene.model)
    return found


def with_obstacles(sampler: GraspSampler, balls: Array) -> GraspSampler:
    """Return the sampler on a map with additional balls (V, 4) = (x, y, z, radius) [m, world]."""
    found = copy.copy(sampler)
    model = with_balls(sampler.scene.model, balls, n_sigma=sampler.n_sigma, observations=sampler.min_observations)
    labels = np.concatenate([sampler.scene.labels, np.full(len(balls), -1, np.int32)])
    found.scene = replace(sampler.scene, model=model, labels=labels)
    if sampler.observers is not None:
        found.observers = np.concatenate([sampler.observers, np.full((len(balls), 3), np.nan)])
    found.field = found.collision_field(model)
    return found


def moved_rows(model: GaussianModel, rows: NDArray[np.int64], T_now_before: Array) -> GaussianModel:
    """Return a model of which some Gaussians (M,) moved by a pose (4, 4) in the world. Colours do not turn."""
    found, index = model.clone(), torch.from_numpy(rows)
    means = transform_points(T_now_before, model.means[index].detach().double().numpy())
    turned = quat_multiply(rotation_to_quat(T_now_before[:3, :3]), model.quats[index].detach().double().numpy())
    found.means[index] = torch.from_numpy(means).to(found.means.dtype)
    found.quats[index] = torch.from_numpy(np.asarray(turned)).to(found.quats.dtype)
    return found


def moved_grasp(grasp: Grasp, T_now_before: Array, q_pregrasp: Array) -> Grasp:
    """Return the grasp of the moved target, to which the arm goes from other joint positions.

    Args:
        grasp: the grasp.
        T_now_before: (4, 4) motion of the target in the world [m].
        q_pregrasp: (J,) joint positions at the moved pre-grasp [rad or m].
    """
    return replace(
        grasp,
        T_world_tcp=T_now_before @ grasp.T_world_tcp,
        T_world_pregrasp=T_now_before @ grasp.T_world_pregrasp,
        contacts=transform_points(T_now_before, grasp.contacts),
        normals=grasp.normals @ T_now_before[:3, :3].T,
        q=None,
        q_pregrasp=q_pregrasp,
        approach_path=None,
    )
