"""Writers of log formats by their published layouts, independent of the readers under test."""

from __future__ import annotations

import json
import struct
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.frame import Frame

Pose = NDArray[np.float64]
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # between the camera axes of OpenCV and those of OpenGL and ARKit


def encoded(image: NDArray[Any], suffix: str = ".png") -> bytes:
    """Encode an RGB or grey image."""
    pixels = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    ok, data = cv2.imencode(suffix, pixels, [cv2.IMWRITE_JPEG_QUALITY, 98] if suffix == ".jpg" else [])
    assert ok
    return data.tobytes()


def units(frame: Frame, scale: float = 1000.0) -> NDArray[np.uint16]:
    """Return depth in integer units."""
    return np.rint(frame.depth.astype(np.float64) * scale).astype(np.uint16)


def text(matrix: NDArray[Any]) -> str:
    """Return a matrix as lines of numbers."""
    return "\n".join(" ".join(f"{value:.12g}" for value in row) for row in matrix) + "\n"


def write(path: Path, data: bytes | str) -> None:
    """Write a file and its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data.encode() if isinstance(data, str) else data)


def intrinsics(frame: Frame) -> dict[str, float]:
    """Return splatbot's intrinsics.json."""
    c = frame.camera
    return {"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "width": c.width, "height": c.height, "depth_scale": 1000}


def write_seven_scenes(folder: Path, frames: Sequence[Frame], poses: Sequence[Pose]) -> Path:
    """Write a sequence of 7-Scenes; missing depth is 65535."""
    for n, (frame, T) in enumerate(zip(frames, poses, strict=True)):
        depth = units(frame)
        write(folder / f"frame-{n:06d}.color.png", encoded(frame.rgb))
        write(folder / f"frame-{n:06d}.depth.png", encoded(np.where(depth == 0, 65535, depth).astype(np.uint16)))
        write(folder / f"frame-{n:06d}.pose.txt", text(T))
    return folder


def write_open3d(folder: Path, frames: Sequence[Frame], _poses: Sequence[Pose]) -> Path:
    """Write the folder of Open3D's recorder of RealSense cameras."""
    for n, frame in enumerate(frames):
        write(folder / f"color/{n:06d}.png", encoded(frame.rgb))
        write(folder / f"depth/{n:06d}.png", encoded(units(frame)))
    c = frames[0].camera
    K = [c.fx, 0, 0, 0, c.fy, 0, c.cx, c.cy, 1]
    values = {"width": c.width, "height": c.height, "intrinsic_matrix": K}
    write(folder / "camera_intrinsic.json", json.dumps(values))
    return folder


def write_scannet_export(folder: Path, frames: Sequence[Frame], poses: Sequence[Pose]) -> Path:
    """Write the folder of ScanNet's SensReader: names without leading zeros, JPEG colour."""
    for n, (frame, T) in enumerate(zip(frames, poses, strict=True)):
        write(folder / f"color/{n}.jpg", encoded(frame.rgb, ".jpg"))
        write(folder / f"depth/{n}.png", encoded(units(frame)))
        write(folder / f"pose/{n}.txt", text(T))
    K = np.eye(4)
    K[:3, :3] = frames[0].camera.K
    for part in ("color", "depth"):
        write(folder / f"intrinsic/intrinsic_{part}.txt", text(K))
        write(folder / f"intrinsic/extrinsic_{part}.txt", text(np.eye(4)))
    return folder


def matrix_bytes(matrix: NDArray[Any]) -> bytes:
    """Return the 64 bytes of a matrix (4, 4) of float32, row by row."""
    return matrix.astype("<f4").tobytes()


def sens_header(
    color: NDArray[Any],
    depth: NDArray[Any],
    color_size: tuple[int, int],
    depth_size: tuple[int, int],
    count: int,
    *,
    version: int = 4,
    kinds: tuple[int, int] = (2, 1),
    T_color: NDArray[Any] | None = None,
) -> bytes:
    """Return the header of a .sens file, as SensReader reads it."""
    name = b"StructureSensor"
    data = struct.pack("<IQ", version, len(name)) + name
    for matrix in (color, np.eye(4) if T_color is None else T_color, depth, np.eye(4)):
        data += matrix_bytes(matrix)
    return data + struct.pack("<iiIIIIfQ", *kinds, *color_size, *depth_size, 1000.0, count)


def sens_frame(color: bytes, depth: bytes, T_world_camera: NDArray[Any], stamp_us: int) -> bytes:
    """Return one frame of a .sens file."""
    head = struct.pack("<QQQQ", stamp_us, stamp_us, len(color), len(depth))
    return matrix_bytes(T_world_camera) + head + color + depth


def write_sens(folder: Path, frames: Sequence[Frame], poses: Sequence[Pose], *, raw: bool = False) -> Path:
    """Write a .sens file: JPEG colour and zlib depth, or both uncompressed."""
    c = frames[0].camera
    K, size = np.eye(4), (c.width, c.height)
    K[:3, :3] = c.K
    data = sens_header(K, K, size, size, len(frames), kinds=(0, 0) if raw else (2, 1))
    for frame, T in zip(frames, poses, strict=True):
        depth = units(frame).tobytes()
        color = frame.rgb.tobytes() if raw else encoded(frame.rgb, ".jpg")
        data += sens_frame(color, depth if raw else zlib.compress(depth), T, round(frame.stamp * 1e6) + 1_000_000)
    write(folder / "scan.sens", data)
    return folder / "scan.sens"


def write_record3d(folder: Path, frames: Sequence[Frame], poses: Sequence[Pose], **changes: Any) -> Path:
    """Write a .r3d file; ``changes`` replace values of its metadata, None removes them."""
    import liblzfse
    from scipy.spatial.transform import Rotation

    c = frames[0].camera
    arkit = [T @ FLIP for T in poses]
    metadata = {
        "w": c.width,
        "h": c.height,
        "dw": c.width,
        "dh": c.height,
        "fps": 30,
        "K": [c.fx, 0, 0, 0, c.fy, 0, c.cx, c.cy, 1],
        "poses": [[*Rotation.from_matrix(T[:3, :3]).as_quat().tolist(), *T[:3, 3].tolist()] for T in arkit],
    } | changes
    folder.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(folder / "scan.r3d", "w") as file:
        file.writestr("metadata", json.dumps({key: value for key, value in metadata.items() if value is not None}))
        for n, frame in enumerate(frames):
            file.writestr(f"rgbd/{n}.jpg", encoded(frame.rgb, ".jpg"))
            file.writestr(f"rgbd/{n}.depth", liblzfse.compress(np.ascontiguousarray(frame.depth).tobytes()))
            file.writestr(f"rgbd/{n}.conf", liblzfse.compress(np.full(frame.depth.shape, 2, np.uint8).tobytes()))
    return folder / "scan.r3d"


def quaternion(R: NDArray[np.floating[Any]]) -> tuple[float, ...]:
    """Return wxyz of a rotation, from its axis and angle by OpenCV."""
    axis = cv2.Rodrigues(R)[0][:, 0]
    angle = float(np.linalg.norm(axis))
    return (np.cos(angle / 2), *(np.sin(angle / 2) / max(angle, 1e-12) * axis))


def write_colmap(folder: Path, frames: Sequence[Frame], poses: Sequence[Pose], *, binary: bool = True) -> Path:
    """Write a COLMAP scene with depth, by https://colmap.github.io/format.html: T_camera_world, images out of order."""
    c = frames[0].camera
    params = (c.fx, c.fy, c.cx + 0.5, c.cy + 0.5)
    rows = []
    for n, (frame, T) in enumerate(zip(frames, poses, strict=True)):
        write(folder / f"images/frame{n:03d}.jpg", encoded(frame.rgb))  # a PNG; readers do not ask its name
        write(folder / f"depth/frame{n:03d}.png", encoded(units(frame)))
        inverse = np.linalg.inv(T)
        rows.append((n + 1, quaternion(inverse[:3, :3]), tuple(inverse[:3, 3]), f"frame{n:03d}.jpg"))
    model = folder / "sparse/0"
    if binary:
        data = struct.pack("<Q", len(rows))
        for number, quat, shift, name in rows[::-1]:
            data += struct.pack("<I4d3dI", number, *quat, *shift, 1) + name.encode() + b"\0"
            data += struct.pack("<Q", 1) + struct.pack("<ddq", 10.0, 20.0, -1)  # one 2D point without a 3D point
        write(model / "images.bin", data)
        write(model / "cameras.bin", struct.pack("<QIiQQ4d", 1, 1, 1, c.width, c.height, *params))  # 1: PINHOLE
        write(model / "points3D.bin", struct.pack("<Q", 0))
        return folder
    lines = [
        f"{n} {' '.join(map(repr, map(float, (*q, *t))))} 1 {name}\n10.0 20.0 -1\n" for n, q, t, name in rows[::-1]
    ]
    write(model / "images.txt", "# Image list\n" + "".join(lines))
    write(model / "cameras.txt", f"1 PINHOLE {c.width} {c.height} {' '.join(map(repr, params))}\n")
    write(model / "points3D.txt", "# 3D point list\n")
    return folder


def write_nerfstudio(folder: Path, frames: Sequence[Frame], poses: Sequence[Pose]) -> Path:
    """Write a Nerfstudio scene with depth: poses in OpenGL's axes, pixel centres at +0.5, frames out of order."""
    c = frames[0].camera
    listed = []
    for n, (frame, T) in enumerate(zip(frames, poses, strict=True)):
        write(folder / f"images/frame_{n:05d}.png", encoded(frame.rgb))
        write(folder / f"depths/frame_{n:05d}.png", encoded(units(frame)))
        places = {"file_path": f"images/frame_{n:05d}.png", "depth_file_path": f"depths/frame_{n:05d}.png"}
        listed.append({**places, "transform_matrix": (T @ FLIP).tolist()})
    values = {"fl_x": c.fx, "fl_y": c.fy, "cx": c.cx + 0.5, "cy": c.cy + 0.5, "w": c.width, "h": c.height}
    write(folder / "transforms.json", json.dumps({**values, "camera_model": "OPENCV", "frames": listed[::-1]}))
    return folder
