"""Renders and collision queries of one fixed scene, written by one machine and compared by another.

``answers.py write FILE`` computes them with the splatbot of its Python; ``answers.py compare FILE`` computes them again
and prints the largest difference of each array. The inputs are uniform random numbers and exact arithmetic, so that
every architecture has the same bits. Both need torch, numpy and the native module alone.
"""

from __future__ import annotations

import sys

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot import rasterization
from splatbot.rasterize.native import native

Arrays = dict[str, NDArray[np.generic]]

BOUNDS = {
    "colors": 1e-5,
    "depth": 5e-5,  # [m]
    "alpha": 1e-5,
    "gradient": 1e-4,  # of the L2 norm
    "distance": 1e-6,  # [m]
    "mahalanobis": 1e-5,
    "hits": 0.0,
}
"""Largest absolute differences between two machines; that of the gradient is relative."""
SPHERE_BOUND = 1e-5
"""[m] largest difference of a distance from spheres to its closed form."""
WIDTH, HEIGHT, GAUSSIANS, POINTS = 75, 53, 300, 400


def render(rng: np.random.Generator) -> Arrays:
    """Return an image with depth, and the gradient of a weighted sum of its values with respect to the means."""
    uniform = torch.from_numpy(rng.random((GAUSSIANS, 14), dtype=np.float32))
    means, quats, scales, colors, opacities = (part.contiguous() for part in uniform.split((3, 4, 3, 3, 1), dim=1))
    means = (2.0 * means + torch.tensor([-1.0, -1.0, 2.0])).requires_grad_()
    image, alpha, _ = rasterization(
        means,
        2.0 * quats - 1.0,
        0.01 + 0.1 * scales,
        opacities[:, 0],
        colors,
        torch.eye(4)[None],
        torch.tensor([[[60.0, 0.0, 0.5 * WIDTH], [0.0, 60.0, 0.5 * HEIGHT], [0.0, 0.0, 1.0]]]),
        WIDTH,
        HEIGHT,
        render_mode="RGB+ED",
    )
    weights = torch.from_numpy(rng.random(image.shape, dtype=np.float32))
    (gradient,) = torch.autograd.grad((image * weights).sum(), means)
    pixels = image.detach().numpy()
    return {
        "colors": pixels[..., :3],
        "depth": pixels[..., 3],
        "alpha": alpha.detach().numpy(),
        "gradient": gradient.numpy(),
    }


def query(rng: np.random.Generator) -> Arrays:
    """Return distances [m], Mahalanobis distances and hits of points near ellipsoids.

    ``spheres`` is the difference [m] of distances near spheres from their closed form, |p - μ| - 2σ.
    """
    means = rng.random((GAUSSIANS, 3), dtype=np.float32)
    quats = rng.random((GAUSSIANS, 4), dtype=np.float32) + np.float32(0.1)
    scales = rng.random((GAUSSIANS, 3), dtype=np.float32) * np.float32(0.02) + np.float32(0.001)
    points = rng.random((POINTS, 3)) * 1.2 - 0.1
    ids = np.arange(GAUSSIANS, dtype=np.int32)
    options = {"n_sigma": 2.0, "voxel": 0.02, "max_voxels": 2_000_000}
    field = native().CollisionField(means, quats, scales, ids, **options)
    sigmas = np.repeat(scales[:, :1], 3, axis=1)
    spheres = native().CollisionField(means, quats, sigmas, ids, **options)
    closed = np.linalg.norm(points[:, None] - means.astype(np.float64), axis=2) - 2.0 * sigmas[:, 0].astype(np.float64)
    return {
        "distance": field.nearest(points, None, np.inf)[0],
        "mahalanobis": field.mahalanobis(points)[0],
        "hits": field.hits(points, np.full(POINTS, 0.02, dtype=np.float32)),
        "spheres": spheres.nearest(points, None, np.inf)[0] - closed.min(axis=1),
    }


def answers() -> Arrays:
    """Return all arrays of the scene."""
    rng = np.random.default_rng(0)
    return render(rng) | query(rng)


def write(path: str) -> int:
    """Write the answers of this machine to a file, and print that they are not empty."""
    found = answers()
    np.savez(path, **found)  # type: ignore[arg-type]
    covered, hits = np.count_nonzero(found["alpha"] > np.float32(0.5)), np.count_nonzero(found["hits"])
    print(f"kernels {native().isa()}: {covered} of {WIDTH * HEIGHT} pixels covered, {hits} of {POINTS} points hit")
    return 0


def compare(path: str) -> int:
    """Print the largest differences of a file from the answers of this machine; 1 if one exceeds its bound."""
    ours, theirs = answers(), np.load(path)

    def largest(name: str) -> float:
        a, b = theirs[name].astype(np.float64), ours[name].astype(np.float64)
        return float(np.linalg.norm(a - b) / np.linalg.norm(b) if name == "gradient" else np.abs(a - b).max())

    rows = {name: (largest(name), bound) for name, bound in BOUNDS.items()}
    rows["spheres"] = (float(np.abs(theirs["spheres"]).max()), SPHERE_BOUND)
    print(f"largest differences from kernels {native().isa()} of this machine; spheres: from the closed form")
    for name, (value, bound) in rows.items():
        print(f"  {name:12} {value:8.1e}  bound {bound:.0e}")
    return 0 if all(value <= bound for value, bound in rows.values()) else 1


if __name__ == "__main__":
    task, file = sys.argv[1:]
    sys.exit({"write": write, "compare": compare}[task](file))
