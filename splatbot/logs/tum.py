"""The TUM RGB-D layout: rgb.txt, depth.txt, groundtruth.txt and `intrinsics.json`."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from splatbot.errors import CameraError, LogError
from splatbot.frame import Frame
from splatbot.logs.address import PAIR_WITHIN, join_address, seconds_of_option
from splatbot.logs.base import StampedLog
from splatbot.logs.calibration import Calibration, read_calibration
from splatbot.logs.effects import read_account
from splatbot.logs.index import MAX_STAMP_DIFFERENCE_S, IndexEntry, associate, read_index
from splatbot.logs.joints import find_joints
from splatbot.logs.masks import find_masks
from splatbot.logs.presets import PRESETS, find_calibration
from splatbot.logs.rgbd import FolderLog, RgbdReader
from splatbot.trajectory import Trajectory

Missing = Literal["auto", "error", "skip"]

_SYNCHRONIZED_S = 1e-3  # maximum difference of stamps between synchronized streams

_log = logging.getLogger(__name__)


class TumLog(FolderLog, StampedLog):
    """A recording in TUM layout; frames are the colour images, each with the depth image nearest in time.

    ``missing`` defines the treatment of a colour image without a depth image within 0.02 s:

    - "skip": the frame is left out.
    - "error": reading the frame raises LogError.
    - "auto": "error" if all other pairs differ by less than 1 ms, since the streams are then synchronized and depth.txt
      lost a line. Otherwise "skip", since drop-outs are normal for free-running streams such as TUM's own.

    Such images are counted in ``unpaired`` and logged. A depth image without colour is only logged.

    Masks mark valid pixels in white and excluded pixels in black, such as the gripper or the robot's own arm. They are
    read from `mask.png` for all frames, or from `mask.txt` (lines `stamp path`) for single frames.

    `joints.txt` (lines `stamp q1 q2 ...`) holds the joint positions, which are interpolated to the stamps of colour and
    depth.

    Args:
        folder: of the log.
        camera: intrinsics that replace the log's own.
        missing: see above.
        joint_delay: time [s] by which the stamps of joint positions are later than their motion.
        options: `pair_within` is the largest difference [s] of the stamps of a pair.

    Raises:
        LogError: a list is missing, empty or malformed, nothing can be associated, or `effects.json` is damaged.
        CameraError: there are no usable intrinsics.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        camera: str | Path | Calibration | None = None,
        missing: Missing = "auto",
        joint_delay: float = 0.0,
        options: dict[str, str] | None = None,
    ) -> None:
        super().__init__(folder)
        self._pair_within = seconds_of_option(self.folder, options or {}, MAX_STAMP_DIFFERENCE_S)
        self.uri = join_address(self.folder, options or {})
        colors, self._depths = read_index(self.folder / "rgb.txt"), read_index(self.folder / "depth.txt")
        pairs = self._pair(colors)
        self.unpaired = len(colors) - len(pairs)
        if missing == "auto":
            lockstep = all(abs(colors[i].stamp - depth.stamp) < _SYNCHRONIZED_S for i, depth in pairs.items())
            missing = "error" if lockstep else "skip"
        kept = [i for i in range(len(colors)) if i in pairs or missing == "error"]
        self._frames: list[tuple[IndexEntry, IndexEntry | None]] = [(colors[i], pairs.get(i)) for i in kept]
        self.stamps = [color.stamp for color, _ in self._frames]
        self._masks = find_masks(self.folder)
        self._joints, self._joint_delay = find_joints(self.folder), joint_delay
        self._effects, blanks_depth = read_account(self.folder)
        self._reader = RgbdReader(self._calibration(camera), empty_depth=blanks_depth)
        self._report(len(colors), len(pairs))

    @property
    def effects(self) -> list[dict[str, Any]]:
        """The account in `effects.json`, which `splatbot simulate` writes; empty for a real sensor."""
        return self._effects

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """Poses of groundtruth.txt as recorded, T_world_camera; None where there is no such file.

        Raises:
            FormatError: the file is damaged.
        """
        path = self.folder / "groundtruth.txt"
        return Trajectory.load(path) if path.exists() else None

    def _decode(self, index: int) -> Frame:
        color, depth = self._frames[index]
        if depth is None:
            raise self._no_partner(color)
        mask = None if self._masks is None else self._masks.at(color.stamp)
        frame = self._reader.read(index, color.stamp, self.folder / color.path, self.folder / depth.path, mask)
        frame = replace(frame, depth_delay=depth.stamp - color.stamp)
        if self._joints is None:
            return frame
        joints = self._joints.at(color.stamp + self._joint_delay)
        later = None if joints is None or not frame.depth_delay else self._joints.at(depth.stamp + self._joint_delay)
        return replace(frame, joints=joints, joint_names=self._joints.names, depth_joints=later)

    def _pair(self, colors: list[IndexEntry]) -> dict[int, IndexEntry]:
        a, b = (np.array([entry.stamp for entry in entries]) for entries in (colors, self._depths))
        pairs = {i: self._depths[j] for i, j in associate(a, b, self._pair_within)}
        if not pairs:
            raise LogError(
                f"no stamp is within {self._pair_within:g} s of one in rgb.txt (colour {a[0]:.3f}..{a[-1]:.3f} s, "
                f"depth {b[0]:.3f}..{b[-1]:.3f} s).",
                file=self.folder / "depth.txt",
                field="stamps",
                hint=f"write both lists in seconds of the same clock, or pair more loosely: ?{PAIR_WITHIN}=0.05",
            )
        return pairs

    def _no_partner(self, color: IndexEntry) -> LogError:
        before = [entry.line for entry in self._depths if entry.stamp < color.stamp]
        return LogError(
            f"no depth image within {self._pair_within:g} s of stamp {color.stamp:.6f} "
            f"({color.path}, line {color.line} of rgb.txt).",
            file=self.folder / "depth.txt",
            field=f"after line {before[-1]}" if before else "first line",
            hint="restore the line, remove that image from rgb.txt, or leave such frames out: --on-bad-frame skip",
        )

    def _calibration(self, camera: str | Path | Calibration | None) -> Calibration:
        if camera is not None:
            return find_calibration(camera)
        path = self.folder / "intrinsics.json"
        if path.exists():
            return read_calibration(path)
        raise CameraError(
            "the log has no intrinsics.",
            file=path,
            field="camera",
            hint="write it with fx, fy, cx, cy, width, height [px] and depth_scale [units/m], or name the camera: "
            f"--camera {'|'.join(PRESETS)} or --camera FILE",
        )

    def _report(self, colors: int, pairs: int) -> None:
        if self.unpaired:
            _log.warning("%s: %d of %d colour images have no depth image", self.uri, self.unpaired, colors)
        if len(self._depths) > pairs:
            _log.warning(
                "%s: %d of %d depth images have no colour image", self.uri, len(self._depths) - pairs, len(self._depths)
            )
