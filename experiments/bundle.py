"""Assess the reference trajectory of a recording by bundle adjustment: `python -m experiments.bundle LOG RUN`.

COLMAP (Schoenberger and Frahm 2016; pycolmap is in the extra `dev`) extracts SIFT features of all colour images and
matches them between all pairs. It then triangulates points and adjusts them together with all poses. Depth images are
not used; the run supplies the initial poses and the scale, which images alone cannot determine.

A trajectory that agrees with the result is consistent with the images. If the reference deviates more from the result
than the run does, the ATE against that reference measures the reference rather than the run.
"""

from __future__ import annotations

import importlib
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.evaluation import absolute_error
from splatbot.formats.trajectory import load_trajectory
from splatbot.frame import Frame
from splatbot.geometry import inverse, rotation_to_quat
from splatbot.logs import open_log
from splatbot.results.folder import RunFolder
from splatbot.trajectory import Trajectory

Array = NDArray[np.float64]

_ROUNDS = 3  # each triangulates and adjusts
_MIN_ANGLE = 0.7  # [deg] between the rays to a point; the camera at a table top moves by centimetres


def bundle_adjusted(frames: Sequence[Frame], T_world_camera: Array, folder: Path) -> tuple[Array, float]:
    """Adjust poses of frames by bundle adjustment.

    Args:
        frames: N frames of one camera.
        T_world_camera: (N, 4, 4), initial poses; they determine the scale of the result.
        folder: empty folder for the database of COLMAP.

    Returns:
        Poses (N, 4, 4) in an arbitrary world frame, and the mean reprojection error [px].

    Raises:
        InputError: pycolmap is not installed.
    """
    colmap = _colmap()
    images = folder / "images"
    images.mkdir()
    names = [f"{k:06d}.png" for k in range(len(frames))]
    for name, frame in zip(names, frames, strict=True):
        colmap.Bitmap.from_array(frame.rgb).write(str(images / name))
    c = frames[0].camera
    reader = colmap.ImageReaderOptions()
    reader.camera_model, reader.camera_params = "PINHOLE", f"{c.fx},{c.fy},{c.cx + 0.5},{c.cy + 0.5}"
    database = folder / "database.db"
    colmap.extract_features(database, images, camera_mode=colmap.CameraMode.SINGLE, reader_options=reader)
    colmap.match_exhaustive(database)
    model = _initial_model(colmap, database, folder, names, T_world_camera)
    options = colmap.IncrementalPipelineOptions()
    options.mapper.filter_min_tri_angle = options.triangulation.min_angle = _MIN_ANGLE
    fixed = colmap.BundleAdjustmentOptions()
    fixed.refine_focal_length = fixed.refine_principal_point = fixed.refine_extra_params = False
    for _ in range(_ROUNDS):
        model = colmap.triangulate_points(model, database, images, folder, clear_points=True, options=options)
        colmap.bundle_adjustment(model, fixed)
    by_name = {image.name: image for image in model.images.values()}
    found = np.tile(np.eye(4), (len(names), 1, 1))
    for k, name in enumerate(names):
        found[k, :3] = by_name[name].cam_from_world().inverse().matrix()
    found[:, :3, 3] *= umeyama_scale(found[:, :3, 3], T_world_camera[:, :3, 3])
    return found, float(model.compute_mean_reprojection_error())


def _colmap() -> Any:
    try:
        colmap = importlib.import_module("pycolmap")
    except ImportError as error:
        raise InputError(
            "pycolmap is not installed.", field="pycolmap", hint="pip install pycolmap, or splatbot[dev]"
        ) from error
    colmap.logging.minloglevel = colmap.logging.ERROR.value  # INFO prints a line per image
    return colmap


def _initial_model(colmap: Any, database: Path, folder: Path, names: Sequence[str], T_world_camera: Array) -> Any:
    """Build a reconstruction with the given poses and no points, through the text format of COLMAP."""
    known = colmap.Database.open(database)
    ids, camera = {image.name: image.image_id for image in known.read_all_images()}, known.read_all_cameras()[0]
    known.close()
    params = " ".join(str(value) for value in camera.params)
    (folder / "cameras.txt").write_text(f"{camera.camera_id} PINHOLE {camera.width} {camera.height} {params}\n")
    lines = []
    for name, T in zip(names, T_world_camera, strict=True):
        T_camera_world = inverse(T)
        pose = [*rotation_to_quat(T_camera_world[:3, :3]), *T_camera_world[:3, 3]]
        numbers = " ".join(str(value) for value in pose)
        lines.append(f"{ids[name]} {numbers} {camera.camera_id} {name}\n\n")
    (folder / "images.txt").write_text("".join(lines))
    (folder / "points3D.txt").write_text("")
    model = colmap.Reconstruction()
    model.read_text(str(folder))
    return model


def umeyama_scale(positions: Array, target: Array) -> float:
    """Return the least-squares scale that aligns positions (N, 3) with target (N, 3) (Umeyama 1991, eq. 42)."""
    a, b = positions - positions.mean(axis=0), target - target.mean(axis=0)
    U, s, Vt = np.linalg.svd(b.T @ a)
    s[2] *= np.sign(np.linalg.det(U @ Vt))
    return float(s.sum() / (a**2).sum())


def main(argv: Sequence[str]) -> None:
    """Print the ATE [mm] between a run, the references of its log, and bundle adjustment."""
    if len(argv) != 2:
        raise SystemExit("usage: python -m experiments.bundle LOG RUN")
    log, run = open_log(argv[0]), RunFolder(argv[1])
    track, indices = run.load_trajectory(), sorted(run.load_poses())
    with tempfile.TemporaryDirectory() as folder:
        poses, pixels = bundle_adjusted([log[k] for k in indices], track.T_world_camera, Path(folder))
    adjusted = Trajectory(track.stamps, poses)
    print(f"{len(indices)} images, reprojection {pixels:.2f} px")
    for path in sorted(Path(argv[0]).glob("groundtruth*.txt")):
        reference = load_trajectory(path)
        print(f"{path.name} to bundle adjustment: {_ate(adjusted, reference)}")
        print(f"the run to {path.name}: {_ate(reference, track)}")
    print(f"the run to bundle adjustment: {_ate(adjusted, track)}")


def _ate(reference: Trajectory, estimate: Trajectory) -> str:
    found = absolute_error(reference, estimate)
    return f"ATE {1e3 * found.rmse:.1f} mm, median {1e3 * found.median:.1f} mm"


if __name__ == "__main__":
    main(sys.argv[1:])
