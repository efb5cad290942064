"""Recorded and generated RGB-D streams."""

from __future__ import annotations

from pathlib import Path

from splatbot.errors import LogError
from splatbot.logs.base import Log
from splatbot.logs.calibration import Calibration
from splatbot.logs.record import record
from splatbot.logs.replica import ReplicaLog
from splatbot.logs.tum import Missing, TumLog

__all__ = ["Calibration", "Log", "open_log", "record"]

_LAYOUTS_HINT = (
    "known layouts: rgb.txt with depth.txt (TUM), results/ with traj.txt (Replica), metadata.yaml (ROS 2), "
    "a .mcap or .bag file; "
    "`synthetic:tabletop` needs no files"
)


def open_log(uri: str | Path, *, camera: str | Path | Calibration | None = None, missing: Missing = "auto") -> Log:
    """Open the log that ``uri`` names; frames are decoded only when read.

    Args:
        uri: a folder in TUM or Replica layout, or a recording of ROS topics (`.mcap`, rosbag2 folder, `.bag`). Select
            one of several cameras by `FILE?color=TOPIC&depth=TOPIC&info=TOPIC`. Generated logs have the form
            `synthetic:SCENE?trajectory=NAME&frames=N&effects=SPEC;SPEC&...` with the keys of
            :class:`splatbot.logs.synthetic.SyntheticOptions`.
        camera: a preset (tum_fr1, tum_fr2, tum_fr3), an `intrinsics.json` or a calibration that replaces the log's own.
        missing: treatment of colour images without depth in a TUM log, see :class:`splatbot.logs.tum.TumLog`.

    Raises:
        LogError: the log does not exist, has an unknown layout, or is damaged.
        CameraError: there are no usable intrinsics.
    """
    if str(uri).startswith("synthetic:"):
        return _open_synthetic(str(uri), camera)
    if _is_bag(Path(str(uri).partition("?")[0])):
        return _open_bag(str(uri), camera)
    folder = Path(uri)
    if not folder.is_dir():
        problem = "is a file of no known kind" if folder.exists() else "does not exist"
        raise LogError(f"{problem}.", file=folder, field="log", hint=f"check the path; {_LAYOUTS_HINT}")
    if any((folder / name).exists() for name in ("rgb.txt", "depth.txt")):
        return TumLog(folder, camera=camera, missing=missing)
    if (folder / "results").is_dir() and (folder / "traj.txt").exists():
        return ReplicaLog(folder, camera=camera)
    raise LogError("holds no log of a known layout.", file=folder, field="log", hint=_LAYOUTS_HINT)


def _open_synthetic(uri: str, camera: str | Path | Calibration | None) -> Log:
    from splatbot.logs.synthetic import SyntheticLog  # imports open3d, which takes a second

    if camera is not None:
        raise LogError("a synthetic log has its own camera.", file=uri, field="camera", hint="leave --camera out")
    return SyntheticLog(uri)


def _is_bag(path: Path) -> bool:
    return path.suffix in (".mcap", ".bag") or (path.is_dir() and (path / "metadata.yaml").exists())


def _open_bag(uri: str, camera: str | Path | Calibration | None) -> Log:
    from splatbot.logs.bag import BagLog, split_query  # rosbags builds its message classes when imported

    path, topics = split_query(uri)
    return BagLog(path, camera=camera, topics=topics)
