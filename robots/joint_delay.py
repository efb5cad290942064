"""Delay of a robot's joint states, from the silhouette of its arm in the depth images of a static camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from splatbot.calibration.estimate import Estimate
from splatbot.camera import Camera
from splatbot.errors import InputError, LogError
from splatbot.frame import Frame
from splatbot.logs import Log
from splatbot.logs.joints import select_joints
from splatbot.mapping.selfmask import SelfMask
from splatbot.protocols import Array, RobotKinematics
from splatbot.workspace import NAME, Workspace


@dataclass(frozen=True)
class JointDelayConstants:
    """Constants of the estimate.

    Args:
        frames: most frames that are compared, from the middle of the log.
        spacing: [s] between them, if the log has as many; joints are interpolated between them.
        largest_spacing: [s] beyond which motion between frames is not known.
        least_frames: least number of them.
        width: width [px] to which images are subsampled.
        background: quantile of a pixel's depths that is its background; the arm hides a pixel for less of the time.
        relief: [m] by which the arm is before the background; more than the noise of depth at 2 m.
        max_delay: [s] largest delay.
        step: [s] of the coarse search.
        fine: [s] half width of the parabola through the peak.
        least_overlap: [1] intersection over union of a silhouette that is the robot's.
        blocks: parts of the log of which the jackknife leaves out one at a time.
        largest_sigma: [s] largest standard deviation of a useful estimate; the arm moves 1 cm meanwhile at 1 m/s.
    """

    frames: int = 120
    spacing: float = 0.1
    largest_spacing: float = 0.25
    least_frames: int = 15
    width: int = 80
    background: float = 0.8
    relief: float = 0.03
    max_delay: float = 0.5
    step: float = 0.05
    fine: float = 0.075
    least_overlap: float = 0.3
    blocks: int = 5
    largest_sigma: float = 0.01


CONSTANTS = JointDelayConstants()


@dataclass(frozen=True, eq=False)
class JointDelay:
    """Delay of joint states.

    Args:
        estimate: time by which the stamps of joint states are later than the motion [s].
        overlap: intersection over union [1] of the robot's silhouettes and those in the images at that delay.
        frames: number of images that were compared.
    """

    estimate: Estimate
    overlap: float
    frames: int


def estimate_joint_delay(
    log: Log, robot: RobotKinematics, workspace: Workspace, *, on_share: Callable[[float], None] = lambda _: None
) -> JointDelay:
    """Estimate the delay at which the robot's silhouettes agree best with the moving part of depth images.

    The moving part M of an image is 3 cm or more before the background, the 80 % quantile of each pixel's depths. P(d)
    is the silhouette of the robot's spheres with the joints at the image's stamp plus d, in pixels that M ever covers.
    The delay maximizes Σ|M ∩ P(d)| / Σ|M ∪ P(d)| over all images. A parabola through the peak interpolates it, and a
    jackknife over parts of the log gives its standard deviation.

    Args:
        log: recording of a static camera, opened without a delay of its joints, in which the arm moves to and fro.
        robot: the robot.
        workspace: pose of the camera in the robot's base.
        on_share: called with the share of the work that is done.

    Raises:
        InputError: the camera is not static, or too few frames have joints.
    """
    if workspace.T_link_camera is None or workspace.camera_link != 0:
        hint = "give the camera in the base with camera_link: 0; for a camera on the arm: splatbot calibrate hand-eye"
        raise InputError("describes no static camera.", file=NAME, field="T_link_camera, camera_link", hint=hint)
    names = workspace.joint_names or tuple(robot.chain.names)
    frames = _frames(log, names)
    on_share(0.2)
    stamps, q = np.array([f.stamp for f in frames]), np.stack([np.asarray(f.joints) for f in frames])
    depths = np.stack([f.depth for f in frames])
    background = _background(depths)
    moving = (depths > 0) & (depths < background - CONSTANTS.relief)
    swept = moving.any(axis=0)
    mask = SelfMask(robot, workspace.T_link_camera, link=0, reach=0.0, joint_offsets=workspace.joint_offsets)

    def overlaps(delay: float, every: int = 1) -> Array:
        """Return intersections and unions (F, 2) [px] of every nth image at a delay."""
        counts = np.zeros((len(frames), 2))
        for k, frame in enumerate(frames):
            if k % every:
                continue
            posture = np.array([np.interp(stamps[k] + delay, stamps, column) for column in q.T])
            shown = swept & ~mask.usable(replace(frame, depth=background, joints=posture, joint_names=()))
            counts[k] = (shown & moving[k]).sum(), (shown | moving[k]).sum()
        return counts

    coarse = np.arange(-CONSTANTS.max_delay, CONSTANTS.max_delay + 1e-9, CONSTANTS.step)
    found = []
    for number, delay in enumerate(coarse):
        found.append(overlaps(float(delay), every=2))
        on_share(0.2 + 0.5 * (number + 1) / len(coarse))
    best = int(np.argmax([_ratio(counts) for counts in found]))
    fine = float(coarse[best]) + np.linspace(-CONSTANTS.fine, CONSTANTS.fine, 11)
    table = np.stack([overlaps(float(delay)) for delay in fine])
    on_share(1.0)
    value, top = _peak(fine, table)
    parts = np.array_split(np.arange(len(frames)), CONSTANTS.blocks)
    left_out = np.array([_peak(fine, np.delete(table, part, axis=1))[0] for part in parts])
    n = len(parts)
    sigma = float(np.sqrt((n - 1) / n * ((left_out - left_out.mean()) ** 2).sum()))
    return JointDelay(_judged(value, sigma, top, at_edge=best in (0, len(coarse) - 1)), top, len(frames))


def _judged(value: float, sigma: float, overlap: float, *, at_edge: bool) -> Estimate:
    if overlap < CONSTANTS.least_overlap:
        reason = f"only {overlap:.0%} of robot and silhouette overlap; check T_link_camera, and move only the arm"
        return Estimate(value, sigma, "s", reason)
    if at_edge:
        return Estimate(value, sigma, "s", f"it is {CONSTANTS.max_delay:g} s or more; check the clocks")
    need = "move the arm to and fro, across the image, for 10 s or more"
    return Estimate.limited(value, sigma, "s", CONSTANTS.largest_sigma, need)


def _background(depths: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the depth (H, W) [m] of the background of depths (F, H, W), 0 where no frame has one."""
    ordered = np.sort(np.where(depths > 0, depths, np.inf), axis=0)
    known = (depths > 0).sum(axis=0)
    at = np.maximum(np.ceil(CONSTANTS.background * known).astype(int) - 1, 0)
    found = np.take_along_axis(ordered, at[None], axis=0)[0]
    return np.where(known > 0, found, 0.0).astype(np.float32)


def _ratio(counts: Array) -> float:
    """Return the intersection over union of all images; ``counts`` is (F, 2)."""
    intersection, union = counts.sum(axis=0)
    return float(intersection / max(union, 1.0))


def _peak(delays: Array, table: Array) -> tuple[float, float]:
    """Return the top of the parabola through the overlaps (D,) near their largest, and the largest."""
    scores = np.array([_ratio(counts) for counts in table])
    a, b, _ = np.polyfit(delays - delays.mean(), scores, 2)
    top = -b / (2 * a) if a < 0 else np.nan
    inside = abs(top) <= 2 * CONSTANTS.fine
    return float(delays.mean() + (top if inside else np.nan)), float(scores.max())


def _frames(log: Log, names: tuple[str, ...]) -> list[Frame]:
    """Return frames with joints in the robot's order, subsampled to a small size, without gaps in time."""
    middle = len(log) // 2
    period = max(1e-3, abs(log[min(middle + 1, len(log) - 1)].stamp - log[middle].stamp))
    every = max(1, int(CONSTANTS.spacing / period + 1e-6))
    first = max(0, middle - CONSTANTS.frames * every // 2)
    chosen = range(first, len(log), every)[: CONSTANTS.frames]
    kept: list[Frame] = []
    for k in chosen:
        try:
            frame = log[k]
        except LogError:
            continue  # damaged; too few are refused below
        if frame.joints is not None:
            small = _subsampled(frame, max(1, frame.camera.width // CONSTANTS.width))
            kept.append(replace(small, joints=select_joints(frame.joint_names, frame.joints, names), joint_names=()))
    if len(kept) < CONSTANTS.least_frames:
        hint = "record joint states with the images, at 10 Hz or more"
        raise InputError(f"has {len(kept)} frames with joints.", file=log.uri, field="joints", hint=hint)
    gap = max(b.stamp - a.stamp for a, b in pairwise(kept))
    if gap > CONSTANTS.largest_spacing:
        hint = "record frames and joint states without pauses, at 5 Hz or more"
        raise InputError(f"has {gap:.2f} s between frames with joints.", file=log.uri, field="joints", hint=hint)
    return kept


def _subsampled(frame: Frame, every: int) -> Frame:
    depth: NDArray[np.float32] = np.ascontiguousarray(frame.depth[::every, ::every])
    c, (height, width) = frame.camera, depth.shape
    camera = Camera(c.fx / every, c.fy / every, c.cx / every, c.cy / every, width, height)
    rgb = np.ascontiguousarray(frame.rgb[::every, ::every])
    return Frame(frame.stamp, rgb, depth, camera, frame.index, joints=frame.joints, joint_names=frame.joint_names)
