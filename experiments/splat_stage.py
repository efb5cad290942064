"""Compare poses from the alpha blend with those of the direct stage: `python -m experiments.splat_stage [URI ...]`.

Each frame of a synthetic log is tracked and mapped as usual. Gauss-Newton then refines its pose on pixels of the
rendered map: colour, depth, and their numerical derivatives with respect to the pose. The refined pose does not enter
the map, so both poses belong to the same frames in the same map.

The reported time is a lower bound of a native stage: per step, one projection of the map and one blend of the chosen
pixels. Derivatives and sums are not counted.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.bench.timing import threads
from splatbot.config import Config, load_config
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, se3_exp, se3_log
from splatbot.logs.synthetic import SyntheticLog
from splatbot.mapping.insertion import view_of
from splatbot.rasterize import Gaussians, Viewpoints, rasterize_pixels
from splatbot.slam import Slam
from splatbot.tracking.prepare import Level, PreparedFrame, normals_of, prepare, smoothed
from splatbot.tracking.reference import sampled_pixels, slopes_of

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

URIS = (
    "synthetic:tabletop?trajectory=arm&frames=30&seed=1&effects=depth_noise;motion_blur",
    "synthetic:room?trajectory=handheld&frames=40&seed=3&effects=motion_blur;depth_noise",
    "synthetic:room?trajectory=loop&frames=30&rate=8&seed=4&effects=depth_noise",
    "synthetic:corridor?trajectory=forward&frames=30&seed=6&effects=depth_noise",
    "synthetic:wall_soft?frames=30&seed=8&effects=depth_noise",
)
STEPS = ((1, 2), (0, 3))  # levels of the pyramid, and Gauss-Newton steps on each
_DIFFERENCE = 2e-4  # [m] and [rad] of the numerical derivatives: a tenth of a pixel
_MIN_ALPHA = 0.9  # of a pixel that contributes a residual
_NU = 4.0  # degrees of freedom of the Student-t weights, as in the direct stage


@dataclass(frozen=True)
class SplatRender:
    """Grey value, depth [m] and alpha of the map at chosen pixels, each (N,)."""

    gray: Array
    depth: Array
    alpha: Array


@dataclass(frozen=True)
class Comparison:
    """RMS error of the translation over the frames [m], and the median time of a frame [ms]."""

    frames: int
    direct_m: float
    splat_m: float
    direct_ms: float
    splat_min_ms: float


def compare(uri: str, config: Config) -> Comparison:
    """Compare the poses of both stages for the frames of a log, each in the map at the time of the frame."""
    log = SyntheticLog(uri)
    truth = log.ground_truth.T_world_camera
    slam, errors, ms = Slam(config), [], []
    for index in range(len(log)):
        frame = log[index]
        model = slam.snapshot().model
        result = slam.process(frame)
        if index == 0 or result.T_world_camera is None:
            continue
        prepared = prepare(frame, config.tracking)
        T, min_ms = align_to_map(model, prepared, result.T_world_camera, config)
        T_true = inverse(truth[0]) @ truth[index]
        errors.append([_translation_error(T_true, result.T_world_camera), _translation_error(T_true, T)])
        ms.append([result.stage_ms["direct"], min_ms])
    direct_m, splat_m = np.sqrt(np.mean(np.square(errors), axis=0))
    return Comparison(len(errors), float(direct_m), float(splat_m), *(float(t) for t in np.median(ms, axis=0)))


def align_to_map(
    model: GaussianModel, prepared: PreparedFrame, T_world_camera: Array, config: Config
) -> tuple[Array, float]:
    """Refine a pose by Gauss-Newton on the rendered map.

    Args:
        model: the map.
        prepared: the image pyramid of the frame.
        T_world_camera: (4, 4), initial pose.
        config: settings of tracking.

    Returns:
        The refined T_world_camera (4, 4), and a lower bound of the time [ms].
    """
    T_camera_world, min_ms = inverse(T_world_camera), 0.0
    for index, steps in STEPS:
        level = prepared.levels[index]
        normals, slopes = normals_of(level.depth, level.camera), slopes_of(level.gray)
        pixels = sampled_pixels(level, normals, slopes, config.tracking.n_pixels)
        exposure = np.array([1.0, 0.0])
        for _ in range(steps):
            min_ms += _min_ms(model, level, pixels, T_camera_world)
            shown = _render(model, level, pixels, T_camera_world)
            moved = [_render(model, level, pixels, se3_exp(_DIFFERENCE * axis) @ T_camera_world) for axis in np.eye(6)]
            step = _solve(level, pixels, shown, moved, exposure, config)
            T_camera_world = se3_exp(step[:6]) @ T_camera_world
            exposure += step[6:]
    return inverse(T_camera_world), min_ms


def _render(model: GaussianModel, level: Level, pixels: Mask, T_camera_world: Array) -> SplatRender:
    view = view_of(model, level.camera, inverse(T_camera_world))
    gray = smoothed((view.rgb @ torch.tensor([0.299, 0.587, 0.114])).numpy())
    return SplatRender(*(image[pixels].astype(np.float64) for image in (gray, view.depth.numpy(), view.alpha.numpy())))


def _min_ms(model: GaussianModel, level: Level, pixels: Mask, T_camera_world: Array) -> float:
    """Measure the time [ms] of one projection of the map and one blend of the chosen pixels."""
    gaussians = Gaussians(model.means, model.quats, model.scales, model.opacities, model.colors)
    camera, at = level.camera, torch.from_numpy(np.argwhere(pixels)[:, ::-1].copy())
    viewmat, K = torch.from_numpy(T_camera_world)[None], torch.from_numpy(camera.K_corner)[None]
    viewpoints = Viewpoints(viewmat, K, camera.width, camera.height)
    start = time.perf_counter()
    rasterize_pixels(gaussians, viewpoints, at, render_mode="RGB+ED", depth_mode="plane")
    return 1e3 * (time.perf_counter() - start)


def _solve(
    level: Level,
    pixels: Mask,
    shown: SplatRender,
    moved: Sequence[SplatRender],
    exposure: Array,
    config: Config,
) -> Array:
    """Solve the Gauss-Newton step H δ = -Jᵀ W r with Student-t weights W.

    δ (8,) is the twist (t, ω) that left-multiplies T_camera_world, then gain and offset of the exposure.
    """
    c = config.tracking
    depth = level.depth[pixels].astype(np.float64)
    sigma_depth = c.sensor.depth_sigma_scale * (c.sensor.sigma_depth_floor + c.sensor.sigma_depth_quad * depth**2)
    r_gray = (exposure[0] * shown.gray + exposure[1] - level.gray[pixels]) / c.sensor.sigma_gray
    r_depth = (shown.depth - depth) / sigma_depth
    J_gray = np.stack([exposure[0] * (m.gray - shown.gray) / _DIFFERENCE for m in moved], 1) / c.sensor.sigma_gray
    J_depth = np.stack([(m.depth - shown.depth) / _DIFFERENCE for m in moved], 1) / sigma_depth[:, None]
    opaque = shown.alpha > _MIN_ALPHA
    near = opaque & (depth > 0) & (np.abs(shown.depth - depth) < c.sensor.max_depth_difference)
    J_exposure = np.stack([shown.gray, np.ones_like(depth)], 1) / c.sensor.sigma_gray
    J = np.concatenate([np.hstack([J_gray, J_exposure])[opaque], np.hstack([J_depth, 0 * J_exposure])[near]])
    r = np.concatenate([r_gray[opaque], r_depth[near]])
    weight = (_NU + 1) / (_NU + r**2)
    H = (J * weight[:, None]).T @ J
    H += np.diag([*[1e-5 * np.trace(H[:6, :6]) / 6] * 6, 1e2, 1e2])
    return np.linalg.solve(H, -(J * weight[:, None]).T @ r)


def _translation_error(T_true: Array, T: Array) -> float:
    return float(np.linalg.norm(se3_log(inverse(T) @ T_true)[:3]))


def main(argv: Sequence[str]) -> None:
    """Print the comparison for URIs of synthetic logs; five are the default."""
    print("RMS error of the translation over the frames, and the median time of a frame")
    with threads(1):
        for uri in argv or URIS:
            found = compare(uri, load_config(environ={}))
            direct = f"direct {1e3 * found.direct_m:.2f} mm, {found.direct_ms:.1f} ms"
            print(f"{uri}\n    {direct}; splat {1e3 * found.splat_m:.2f} mm, more than {found.splat_min_ms:.0f} ms")


if __name__ == "__main__":
    main(sys.argv[1:])
