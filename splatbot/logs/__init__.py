"""Recorded and generated RGB-D streams."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from splatbot.errors import LogError
from splatbot.layouts import LogKind, log_kind
from splatbot.logs.address import PAIR_WITHIN, split_address
from splatbot.logs.base import Log
from splatbot.logs.calibration import Calibration
from splatbot.logs.colmap import OPTIONS as COLMAP_OPTIONS
from splatbot.logs.colmap import ColmapLog
from splatbot.logs.consecutive import ConsecutiveLog
from splatbot.logs.image_folder import ImageFolderLog
from splatbot.logs.record import record
from splatbot.logs.record3d import Record3dLog
from splatbot.logs.replica import ReplicaLog
from splatbot.logs.rig import RigLog
from splatbot.logs.scannet import ScanNetLog
from splatbot.logs.seven_scenes import SevenScenesLog
from splatbot.logs.transforms import TransformsLog
from splatbot.logs.tum import Missing, TumLog

__all__ = ["Calibration", "Log", "open_log", "record"]

_FOLDERS: dict[LogKind, Callable[..., Log]] = {
    "replica": ReplicaLog,
    "7scenes": SevenScenesLog,
    "images": ImageFolderLog,
    "transforms": TransformsLog,
}


def open_log(
    uri: str | Path,
    *,
    camera: str | Path | Calibration | None = None,
    missing: Missing = "auto",
    joint_delay: float = 0.0,
) -> Log:
    """Open the log that ``uri`` names; frames are decoded only when read.

    Args:
        uri: a folder in TUM, Replica, 7-Scenes, Open3D, ScanNet, Nerfstudio or COLMAP layout, or a `.sens` or `.r3d`
            file. A recording of RealSense is a `.db3` or `.bag`. A recording of ROS topics is an `.mcap`, a rosbag2
            folder or a `.bag`. A `.yaml` file lists several cameras (:mod:`splatbot.logs.rig`) or recordings that
            follow each other (:mod:`splatbot.logs.consecutive`). In a COLMAP folder,
            `?depth_scale=5000` gives units of depth per metre. Select one of several cameras by
            `FILE?color=TOPIC&depth=TOPIC&info=TOPIC`. In a LeRobot dataset, `FOLDER?episode=N&color=KEY&depth=KEY`
            selects an episode and a camera. In TUM folders and recordings of ROS topics, `?pair_within=0.05` is the
            largest difference [s] of the stamps of colour and depth, 0.02 by default. Generated logs have the form
            `synthetic:SCENE?trajectory=NAME&frames=N&effects=SPEC;SPEC&...` with the keys of
            :class:`splatbot.logs.synthetic.SyntheticOptions`.
        camera: a preset (tum_fr1, tum_fr2, tum_fr3), an `intrinsics.json` or a calibration that replaces the log's own.
        missing: treatment of colour images without depth in a TUM log, see :class:`splatbot.logs.tum.TumLog`.
        joint_delay: time [s] by which the stamps of recorded joint positions are later than their motion.

    Raises:
        LogError: the log does not exist, has an unknown layout, or is damaged.
        CameraError: there are no usable intrinsics.
    """
    kind = log_kind(uri)
    if kind in _LISTS:
        if camera is not None:
            hint = "write `camera: FILE` to each entry of the file"
            raise LogError("each recording has its own.", file=uri, field="camera", hint=hint)
        return _LISTS[kind](
            uri, lambda address, own: open_log(address, camera=own, missing=missing, joint_delay=joint_delay)
        )
    if kind in _OWN_CAMERAS:
        if camera is not None:
            raise LogError("the log has its own camera.", file=uri, field="camera", hint="leave --camera out")
        return _OWN_CAMERAS[kind](str(uri))
    if kind == "bag":
        return _open_bag(str(uri), camera, joint_delay)
    if kind == "lerobot":
        return _open_lerobot(str(uri), camera, joint_delay)
    if kind == "colmap":
        folder, options = split_address(str(uri), COLMAP_OPTIONS)
        return ColmapLog(folder, camera=camera, options=options)
    if kind == "tum":
        folder, options = split_address(str(uri), (PAIR_WITHIN,))
        return TumLog(folder, camera=camera, missing=missing, joint_delay=joint_delay, options=options)
    return _FOLDERS[kind](Path(uri), camera=camera)


def _open_synthetic(uri: str) -> Log:
    from splatbot.logs.synthetic import SyntheticLog  # imports open3d, which takes a second

    return SyntheticLog(uri)


def _open_bag(uri: str, camera: str | Path | Calibration | None, joint_delay: float) -> Log:
    from splatbot.logs.bag import KEYS, BagLog  # rosbags builds its message classes when imported

    path, options = split_address(uri, KEYS)
    return BagLog(path, camera=camera, options=options, joint_delay=joint_delay)


def _open_realsense(path: str) -> Log:
    from splatbot.logs.realsense import RealSenseLog  # imports rosbags

    return RealSenseLog(path)


def _open_lerobot(uri: str, camera: str | Path | Calibration | None, joint_delay: float) -> Log:
    from splatbot.logs.lerobot_packages import require_lerobot

    require_lerobot(uri)
    from splatbot.logs.lerobot import OPTIONS, LeRobotLog  # imports the optional packages pyarrow and av

    folder, options = split_address(uri, OPTIONS)
    return LeRobotLog(folder, options=options, camera=camera, joint_delay=joint_delay)


_LISTS: dict[LogKind, Callable[[str | Path, Callable[[str, str | None], Log]], Log]] = {
    "rig": RigLog,
    "consecutive": ConsecutiveLog,
}
_OWN_CAMERAS: dict[LogKind, Callable[[str], Log]] = {
    "synthetic": _open_synthetic,
    "scannet": ScanNetLog,
    "record3d": Record3dLog,
    "realsense": _open_realsense,
}
