"""Kinds of recordings and maps, recognized by their names before any library is loaded."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

from splatbot.errors import FormatError, InputError, LogError

LogKind = Literal[
    "synthetic",
    "bag",
    "tum",
    "replica",
    "7scenes",
    "images",
    "transforms",
    "scannet",
    "record3d",
    "lerobot",
    "realsense",
    "rig",
    "consecutive",
    "colmap",
]

DatasetKind = Literal["colmap", "blender", "nerfstudio", "run"]

REPLAY, OAK, REALSENSE = "replay:", "oak://", "realsense://"
ORBBEC, OPENCV = "orbbec://", "opencv://"
"""Beginnings of the addresses of cameras, which splatbot.robots.cameras opens."""

COLMAP_DEPTH = ("depth", "depths")
"""Folders of the depth images of a COLMAP scene, the preferred one first."""

MAP_NAME = "map.ply"
TILES_NAME = "tiles.json"
RECORDING = "recording.mcap"
TRAINING_NAME = "training.json"
MAP_SUFFIXES = (".ply", ".splat", ".ksplat", ".spz", ".sbz", ".sog", ".glb", ".usd", ".usda", ".usdc", ".usdz")
"""Ends of the names of map files that splatbot.formats reads."""

_SOG_NAME = "meta.json"  # of a map in a folder of WebP images
_LAYOUTS_HINT = (
    "known folders: rgb.txt with depth.txt (TUM), results/ with traj.txt (Replica), metadata.yaml (ROS 2), 7-Scenes. "
    "More folders: color/ with depth/ (Open3D, ScanNet), meta/info.json (LeRobot), Nerfstudio or COLMAP with depth/. "
    "Known files: .mcap, .bag, .sens, .r3d, .db3 (RealSense), .yaml (several cameras or recordings). "
    "`synthetic:tabletop` needs no files"
)
_LIBREALSENSE = b"/device_0/sensor_"  # beginning of the topics of librealsense
_FILES: dict[str, LogKind] = {".mcap": "bag", ".bag": "bag", ".sens": "scannet", ".r3d": "record3d"}
_WITH_OPTIONS = ("bag", "lerobot", "tum", "colmap")  # kinds whose path may be followed by ?KEY=VALUE&KEY=VALUE
_COLMAP_MODELS = ("sparse/0", "sparse", ".", "0")  # in the folder of a scene, the preferred one first
_HEAD = 2**20  # bytes of a JSON file that hold its description, or its first frames
_AS_TUM = "write rgb/, depth/ (16-bit PNG), rgb.txt, depth.txt and intrinsics.json (docs/guide/mapping.md)"
_DATASET_HINT = (
    "give a folder with sparse/0/{cameras,images,points3D}.bin or .txt (COLMAP), transforms_train.json (Blender), "
    "transforms.json (Nerfstudio, instant-ngp), or one that `splatbot map` wrote"
)
_DATASET_OF_RUN = (MAP_NAME, "trajectory.tum", "config.yaml")
_RUN_HINT = "give a folder that `splatbot map` wrote"
_MAP_HINT = f"give a map file ({', '.join(MAP_SUFFIXES)}), or a folder that `splatbot map` wrote"
_FROM_A_LOG = f"map a recording; splatbot reads files of Gaussians ({', '.join(MAP_SUFFIXES)})"

_PACKED = {
    ".zip": ("a ZIP archive", "unzip"),
    ".tar": ("a tar archive", "tar xf"),
    ".tgz": ("a tar archive", "tar xf"),
    ".gz": ("a gzip file", "tar xf (.tar.gz) or gunzip"),
    ".bz2": ("a bzip2 file", "tar xf (.tar.bz2) or bunzip2"),
    ".xz": ("an xz file", "tar xf (.tar.xz) or unxz"),
    ".zst": ("a zstd file", "tar xf (.tar.zst) or unzstd"),
    ".7z": ("a 7-Zip archive", "7z x"),
    ".rar": ("a RAR archive", "unrar x"),
}
_PICTURES = (".png", ".jpg", ".jpeg")
_FOREIGN_LOGS = {
    **dict.fromkeys(_PICTURES, ("a picture", "give the folder or the file of its recording")),
    ".db3": ("one file of a rosbag2 recording", "name the folder that holds it and metadata.yaml"),
    ".mkv": (
        "an Azure Kinect recording",
        f"extract it with Open3D's AzureKinectMKVReader, then {_AS_TUM}",
    ),
    ".oni": ("an OpenNI recording", f"extract its frames with OpenNI2, then {_AS_TUM}"),
    ".svo": ("a ZED recording", f"export it with ZED_SVO_Export of the ZED SDK, then {_AS_TUM}"),
    ".svo2": ("a ZED recording", f"export it with ZED_SVO_Export of the ZED SDK, then {_AS_TUM}"),
    ".klg": ("an ElasticFusion recording", f"extract its frames, then {_AS_TUM}"),
    ".rrd": ("a Rerun recording", f"export its images with the Rerun SDK, then {_AS_TUM}"),
    **dict.fromkeys((".mp4", ".mov", ".avi"), ("a video without depth", "record colour and depth of an RGB-D camera")),
    **dict.fromkeys(
        MAP_SUFFIXES, ("a map or a point cloud", "give the recording; `splatbot info FILE` describes a map")
    ),
}
_FOREIGN_MAPS = {
    ".gltf": ("a glTF file in several parts", "pack it as one .glb file"),
    **dict.fromkeys((".pcd", ".las", ".e57"), ("a point cloud", _FROM_A_LOG)),
    **dict.fromkeys((".obj", ".stl"), ("a mesh", _FROM_A_LOG)),
    ".bt": ("an OctoMap", _FROM_A_LOG),
}
_NO_MAPS = {
    **dict.fromkeys(_PICTURES, ("a picture, no map", _MAP_HINT)),
    **dict.fromkeys((".txt", ".csv", ".html", ".json", ".jsonl", ".yaml", ".yml", ".tum"), ("no map", _MAP_HINT)),
    **dict.fromkeys(_FILES, ("a recording, no map", "map it first: splatbot map LOG")),
}


def is_camera(uri: str) -> bool:
    """Return whether a URI names a camera, not a recording."""
    return uri.startswith((REPLAY, OAK, REALSENSE, ORBBEC, OPENCV))


def log_kind(uri: str | Path) -> LogKind:
    """Return the kind of a recording by the names of its files.

    Raises:
        LogError: it does not exist, or is of no supported kind.
    """
    text = str(uri)
    if text.startswith("synthetic:"):
        return "synthetic"
    place = Path(text)
    kind = _kind(place if place.exists() else Path(text.partition("?")[0]))
    if kind is not None and (kind in _WITH_OPTIONS or place.exists()):
        return kind
    if not place.exists():
        raise LogError("does not exist.", file=place, field="log", hint=f"check the path; {_LAYOUTS_HINT}")
    if not place.is_dir():
        what, hint = _foreign(place, _FOREIGN_LOGS) or ("a file of no known kind", f"check the path; {_LAYOUTS_HINT}")
        raise LogError(f"is {what}.", file=place, field="log", hint=hint)
    what, hint = _foreign_folder(place)
    raise LogError(f"{what}.", file=place, field="log", hint=hint)


def _kind(path: Path) -> LogKind | None:
    """Return the kind of the recording at a path by its names, or None."""
    if not path.is_dir():
        suffix = path.suffix.lower()
        if suffix in (".bag", ".db3") and _names(path, _LIBREALSENSE):
            return "realsense"
        if suffix in (".yaml", ".yml") and _names(path, b"cameras:"):
            return "rig"
        if suffix in (".yaml", ".yml") and _names(path, b"recordings:"):
            return "consecutive"
        return _FILES.get(suffix) if path.exists() else None
    if (path / "metadata.yaml").exists():
        return "bag"
    if any((path / name).exists() for name in ("rgb.txt", "depth.txt")):
        return "tum"
    if _names(path / "meta/info.json", b'"codebase_version"'):
        return "lerobot"
    if (path / "results").is_dir() and (path / "traj.txt").exists():
        return "replica"
    if any(path.glob("frame-*.color.png")):
        return "7scenes"
    if (path / "color").is_dir() and (path / "depth").is_dir():
        return "images"
    if _names(path / "transforms.json", b'"depth_file_path"'):
        return "transforms"
    has_depth = (path / "images").is_dir() and any((path / name).is_dir() for name in COLMAP_DEPTH)
    return "colmap" if has_depth and colmap_model(path) is not None else None


def colmap_model(folder: Path) -> Path | None:
    """Return the folder of the first COLMAP model of a scene, or None."""
    places = [folder / name for name in _COLMAP_MODELS]
    return next((place for place in places if any((place / f"cameras{s}").is_file() for s in (".bin", ".txt"))), None)


def _names(file: Path, key: bytes) -> bool:
    """Return whether a file exists and its beginning or its end, where bags list their topics, has a key."""
    if not file.is_file():
        return False
    with file.open("rb") as opened:
        head = opened.read(_HEAD)
        opened.seek(max(0, file.stat().st_size - _HEAD))
        return key in head or key in opened.read(_HEAD)


def map_file(path: str | Path) -> Path:
    """Return the map file that a path names: itself, map.ply in the folder of a run, or meta.json in that of a SOG.

    Raises:
        FormatError: it does not exist, or is of a format that is not supported.
    """
    place = Path(path)
    if place.is_dir():
        if (place / MAP_NAME).is_file():
            return place / MAP_NAME
        if _is_sog(place):
            return place / _SOG_NAME
        raise FormatError(f"has no {MAP_NAME}.", file=place, field="map", hint=_map_hint(place))
    if not place.exists():
        hint = "check the path; give a map file, or a folder that `splatbot map` wrote"
        raise FormatError("does not exist.", file=place, field="map", hint=hint)
    found = None if place.name == _SOG_NAME else _foreign(place, _FOREIGN_MAPS | _NO_MAPS)
    if found is not None:
        raise FormatError(f"is {found[0]}.", file=place, field="map", hint=found[1])
    return place


def is_map(path: str | Path) -> bool:
    """Return whether a path names a map, or the folder of a run or of a SOG, rather than a recording."""
    place = Path(path)
    if place.is_dir():
        return (place / MAP_NAME).is_file() or _is_sog(place)
    return place.is_file() and (place.suffix.lower() in MAP_SUFFIXES or place.suffix.lower() in _FOREIGN_MAPS)


def is_tiled_map(path: str | Path) -> bool:
    """Return whether a path names the folder of a tiled map."""
    return (Path(path) / TILES_NAME).is_file()


def check_run_folder(run: str | Path, field: str = "run") -> None:
    """Check that a path is a folder, and not that of a training.

    Raises:
        FormatError: it is not.
    """
    place = Path(run)
    if not place.exists():
        raise FormatError("does not exist.", file=place, field=field, hint=_RUN_HINT)
    if not place.is_dir():
        what = "a map file" if is_map(place) else "a file"
        raise FormatError(f"is {what}.", file=place, field=field, hint="give its run folder")
    if (place / TRAINING_NAME).is_file():
        hint = f"{_run_of_training(place)}; `splatbot train --resume {place}` continues the training"
        raise FormatError("is a training, which has no recording.", file=place, field=field, hint=hint)


def _run_of_training(folder: Path) -> str:
    """Return the fix that names the run of a training; the settings of a damaged one do not name it."""
    try:
        dataset = Path(json.loads((folder / TRAINING_NAME).read_text(encoding="utf-8"))["dataset"])
    except (OSError, ValueError, KeyError, TypeError):
        return "give the run of its log"
    is_run = (dataset / "metrics.json").is_file()
    return f"give the run of its log: {dataset}" if is_run else f"{_RUN_HINT}: this training is of photographs"


def dataset_kind(folder: Path) -> DatasetKind:
    """Return the kind of a dataset of `splatbot train` by the names of its files.

    Raises:
        InputError: the folder does not exist or is of no known kind.
    """
    if not folder.is_dir():
        problem = "is no folder" if folder.exists() else "does not exist"
        raise InputError(f"{problem}.", file=folder, field="dataset", hint=_DATASET_HINT)
    if colmap_model(folder) is not None:
        return "colmap"
    if (folder / "transforms_train.json").is_file():
        return "blender"
    if (folder / "transforms.json").is_file():
        return "nerfstudio"
    if all((folder / name).is_file() for name in _DATASET_OF_RUN):
        return "run"
    check_run_folder(folder, "dataset")
    raise InputError("holds no dataset of a known kind.", file=folder, field="dataset", hint=_DATASET_HINT)


def _is_sog(folder: Path) -> bool:
    return (folder / _SOG_NAME).is_file() and any(folder.glob("*.webp"))


def _foreign(file: Path, kinds: dict[str, tuple[str, str]]) -> tuple[str, str] | None:
    """Return the kind of a file that is not supported, and a fix; or None."""
    suffix = file.suffix.lower()
    if suffix in _PACKED:
        what, command = _PACKED[suffix]
        return what, f"unpack it ({command}) and name the folder or file in it"
    return kinds.get(suffix)


def _foreign_folder(folder: Path) -> tuple[str, str]:
    """Return the kind of a folder that is no supported log, and a fix."""
    if (folder / MAP_NAME).is_file():
        return "is the folder of a run", "give the recording; `splatbot info RUN` describes the map"
    if _is_sog(folder):
        return "is a SOG map", "give the recording; `splatbot info FOLDER` describes the map"
    if any((folder / name).exists() for name in ("transforms.json", "transforms_train.json")):
        return (
            "is a Nerfstudio or NeRF scene, which has no depth",
            f"train a map from its images: splatbot train {folder}",
        )
    if any((folder / name).exists() for name in ("sparse", "database.db", "cameras.bin", "cameras.txt")):
        return "is a COLMAP scene, which has no folder depth", f"train a map from its images: splatbot train {folder}"
    if any(folder.glob("*.db3")) or any(folder.glob("*.mcap")):
        return "holds a rosbag2 without metadata.yaml", "run `ros2 bag reindex`, or name the .mcap file itself"
    inside = sorted(path.name for path in folder.iterdir() if log_layout(path)) if folder.is_dir() else []
    if inside:
        more = f" and {len(inside) - 4} more" if len(inside) > 4 else ""
        return "holds no log of a known layout itself", f"name one of the logs in it: {', '.join(inside[:4])}{more}"
    return "holds no log of a known layout", _LAYOUTS_HINT


def log_layout(path: Path) -> bool:
    """Return whether a path has the names of a log in one of the supported layouts."""
    return _kind(path) is not None


def _map_hint(folder: Path) -> str:
    if is_tiled_map(folder):
        return "it is a tiled map, for `splatbot render`, `view`, `info` and `serve`; give the map that it was made of"
    if log_layout(folder):
        return f"it is a recording; map it first: splatbot map {folder}"
    if (folder / "state").is_dir():
        return f"its run was cut off before it wrote one; continue it: splatbot map --resume {folder}"
    return "give a map file, or a folder that `splatbot map` wrote"
