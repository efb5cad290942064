"""Runs of `splatbot map`: all tracked frames, with the poses that the run estimated."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import FormatError, InputError
from splatbot.frame import Frame
from splatbot.logs import Log, open_log
from splatbot.results.folder import RunFolder
from splatbot.results.views import rectified_log
from splatbot.training.datasets.base import TrainingData, TrainingView
from splatbot.training.datasets.images import Lens, scaled, scaled_depth, scaled_mask, scaled_size, unseen


def run_dataset(folder: Path, log: Log, scale: int = 1) -> TrainingData:
    """Open the tracked frames of a run, rectified as they were mapped; held-out frames are marked.

    Args:
        folder: a folder that `splatbot map` wrote.
        log: the log that it mapped, with the same masks.
        scale: factor by which width and height of the images are reduced.

    Raises:
        FormatError: the folder is damaged, has no tracked frame, or belongs to another log.
    """
    run = RunFolder(folder)
    rows, poses = run.load_frames(), run.load_poses()
    if not poses:
        raise FormatError("has no tracked frame.", file=run.frames, field="verdict", hint="map the log again")
    if max(poses) >= len(log):
        raise FormatError(
            f"has frame {max(poses)}, the log {log.name} has only {len(log)} frames.",
            file=run.frames,
            field="index",
            hint="name the log that was mapped",
        )
    frames = RunFrames(rectified_log(run, log), scale)
    views = tuple(frames.view(index, poses[index]) for index in sorted(poses))
    held_out = tuple(_name(row.index) for row in rows if row.held_out and row.index in poses)
    return TrainingData("run", folder, views, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), held_out)


def open_run_log(folder: Path) -> Log:
    """Open the log that a run names, with the intrinsics that it used.

    Raises:
        FormatError: the folder does not name the log.
        InputError: the run masked a robot; a log with this mask must be given to :func:`run_dataset`.
        LogError: the log is missing or damaged.
    """
    run = RunFolder(folder)
    source = run.load_metrics().get("log")
    if not isinstance(source, dict) or not isinstance(source.get("uri"), str):
        raise FormatError("does not name the log.", file=run.metrics, field="log.uri", hint="give the log")
    if source.get("robot") is not None:
        raise InputError(
            f"is {source['robot']}, which the run masked.",
            file=run.metrics,
            field="log.robot",
            hint="give the log with the robot masked",
        )
    return open_log(source["uri"], camera=source.get("camera"))


class RunFrames:
    """The frames of a run as images for training. The last frame stays in memory, since a view reads it three times.

    Args:
        log: the rectified log.
        scale: factor by which width and height of the images are reduced.
    """

    def __init__(self, log: Log, scale: int) -> None:
        self._read: Callable[[int], Frame] = lru_cache(maxsize=1)(log.read)
        self._scale = scale
        self._camera = None if log.cameras else log.camera
        self._lens = Lens(log.calibration.camera)

    def view(self, index: int, T_world_camera: NDArray[np.float64]) -> TrainingView:
        """Return the view of frame ``index`` of the log, with its pose (4, 4)."""
        color, depth, mask = partial(self.color, index), partial(self.depth, index), partial(self.mask, index)
        camera, camera_name = self._camera, ""
        if camera is None:
            frame = self._read(index)
            camera, camera_name = frame.camera, frame.camera_name
        camera = camera.resized(*scaled_size(camera, self._scale))
        return TrainingView(_name(index), camera, T_world_camera, color, depth, mask, camera_name)

    def color(self, index: int) -> NDArray[np.uint8]:
        """Read the colour image (H, W, 3) of a frame."""
        frame = self._read(index)
        return np.asarray(scaled(frame.rgb, scaled_size(frame.camera, self._scale)), dtype=np.uint8)

    def depth(self, index: int) -> NDArray[np.float32]:
        """Read depth (H, W) [m] of a frame, 0 where masked."""
        frame = self._read(index)
        depth = np.where(frame.valid, frame.depth, np.float32(0))
        return scaled_depth(depth, scaled_size(frame.camera, self._scale))

    def mask(self, index: int) -> NDArray[np.bool_]:
        """Read the mask (H, W) of a frame, True where it is masked or the recorded image had no pixel."""
        frame = self._read(index)
        mask = np.zeros(frame.depth.shape, bool) if frame.mask is None else ~frame.mask
        if self._lens.distorts and not frame.camera_name:
            mask = mask | unseen(self._lens)
        return scaled_mask(mask, scaled_size(frame.camera, self._scale))


def _name(index: int) -> str:
    return f"{index:06d}"
