"""Measure the bias of the depth that a map renders: `python -m experiments.model_depth [URI]`.

Frames of a synthetic log are mapped at their exact poses. The rendered depths are compared with the exact ones, at the
views of the keyframes and at views half-way between them. Errors are signed, because tracking inherits a bias.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.config import Config
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse
from splatbot.logs.synthetic import PREFIX, SyntheticLog
from splatbot.mapping.executor import InlineExecutor
from splatbot.mapping.insertion import model_depth, view_of
from splatbot.mapping.mapper import Mapper
from splatbot.mapping.observation import Observation
from splatbot.rasterize import rasterization
from splatbot.tracking.prepare import prepare

Depth = NDArray[np.float32]

URI = "synthetic:tabletop?frames=120&effects=depth_noise"
_KEYFRAME_PERIOD = 10  # [frames]


@dataclass(frozen=True)
class Bias:
    """Median, mean and mean absolute error of a depth image [m], and the share of pixels compared."""

    median: float
    mean: float
    l1: float
    share: float


def biases(uri: str, config: Config) -> dict[str, dict[str, Bias]]:
    """Compute the errors by kind of view and kind of depth."""
    log = SyntheticLog(uri)
    exact = SyntheticLog(uri.split("&effects=")[0].split("?effects=")[0])
    mapper, poses = Mapper(config), log.ground_truth.T_world_camera
    executor, T_first_world = InlineExecutor(mapper), inverse(poses[0])
    keyframes = list(range(0, len(log), _KEYFRAME_PERIOD))
    for i in keyframes:
        mapper.submit(Observation(prepare(log[i], config.tracking), T_first_world @ poses[i]))
        executor.run()
    views = {"keyframes": keyframes, "between": [i + _KEYFRAME_PERIOD // 2 for i in keyframes[:-1]]}
    found: dict[str, dict[str, list[Bias]]] = {}
    for kind, indices in views.items():
        for i in indices:
            truth, seen = exact[i].depth, prepare(log[i], config.tracking).depth
            shown = _depths(mapper.model, log.camera, T_first_world @ poses[i], seen, config)
            for name, depth in {"measured": seen, **shown}.items():
                found.setdefault(kind, {}).setdefault(name, []).append(_bias(depth, truth))
    return {kind: {name: _mean(rows) for name, rows in table.items()} for kind, table in found.items()}


def _depths(
    model: GaussianModel, camera: Camera, T_world_camera: NDArray[np.float64], seen: Depth, config: Config
) -> dict[str, Depth]:
    def render(mode: str, depth_mode: str = "center") -> Depth:
        renders, alphas, _ = rasterization(
            *(model.means, model.quats, model.scales, model.opacities, None),
            torch.from_numpy(inverse(T_world_camera))[None],
            torch.from_numpy(camera.K_corner)[None],
            camera.width,
            camera.height,
            render_mode=mode,
            depth_mode=depth_mode,  # type: ignore[arg-type]
        )
        return np.asarray(renders[0, ..., 0] * (alphas[0, ..., 0] > 0.5), np.float32)

    view = view_of(model, camera, T_world_camera)
    return {
        "blended, centres": render("ED"),
        "median": render("MD"),
        "blended, planes": render("ED", "plane"),
        "reference of tracking": model_depth(view, seen, config.mapping),
    }


def _bias(depth: Depth, truth: Depth) -> Bias:
    both = (depth > 0) & (truth > 0)
    error = (depth - truth)[both].astype(np.float64)
    return Bias(float(np.median(error)), float(error.mean()), float(np.abs(error).mean()), float(both.mean()))


def _mean(rows: list[Bias]) -> Bias:
    pick: Callable[[str], float] = lambda name: float(np.mean([getattr(row, name) for row in rows]))  # noqa: E731
    return Bias(pick("median"), pick("mean"), pick("l1"), pick("share"))


def main(argv: list[str]) -> None:
    """Print the table for a log URI; the default is a tabletop with noise of a depth camera."""
    uri = argv[0] if argv else URI
    if not uri.startswith(PREFIX):
        raise SystemExit(f"{uri} has no exact depth; give synthetic:SCENE?...")
    print(f"{uri}\n{'views':10} {'depth':22} {'median':>9} {'mean':>9} {'L1':>8}  pixels")
    for kind, table in biases(uri, Config()).items():
        for name, b in table.items():
            errors = " ".join(f"{1e3 * e:+6.2f} mm" for e in (b.median, b.mean))
            print(f"{kind:10} {name:22} {errors} {1e3 * b.l1:5.2f} mm {b.share:6.1%}")


if __name__ == "__main__":
    main(sys.argv[1:])
