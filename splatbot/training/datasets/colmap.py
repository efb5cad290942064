"""Scenes of COLMAP: photographs with the cameras, poses and points of a sparse model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import FormatError, LogError
from splatbot.formats.colmap import ImageRow, read_cameras, read_images, read_points
from splatbot.geometry import inverse, pose_from_quat
from splatbot.layouts import colmap_model
from splatbot.training.datasets.base import TrainingData, sorted_views
from splatbot.training.datasets.images import Lens, PhotoFile, is_image, make_lens, open_photo, photo_size, scaled_size

_NAMES = ("cameras", "images", "points3D")
_MAX_DISTANCE = 1e9  # of a camera from the origin


def colmap_dataset(folder: Path, scale: int = 1) -> TrainingData:
    """Open a COLMAP scene; `images_2`, `images_4` and so on are used for their scale if their sizes fit.

    Args:
        folder: the scene, its folder `sparse`, or the folder of the model.
        scale: factor by which width and height of the images are reduced.

    Raises:
        FormatError: a file of the model is missing or damaged, or a camera model is not supported.
        LogError: an image is missing, or its size is not that of its camera.
    """
    model = colmap_model(folder) or folder
    cameras, images, points3d = _model_files(model)
    lenses, rows = _lenses(cameras), read_images(images)
    poses = [_pose(images, row) for row in rows]
    points, colors = read_points(points3d)
    photos = _photos(_image_root(model, scale), _image_lenses(images, rows, lenses), scale)
    named = zip(rows, photos, poses, strict=True)
    views = [photo.view(row.name, T, f"camera {row.camera_id}") for row, photo, T in named]
    return TrainingData("colmap", folder, sorted_views(images, views), points, colors)


def _model_files(model: Path) -> list[Path]:
    """Return the files of cameras, images and points, all binary or all text."""
    for suffix in (".bin", ".txt"):
        files = [model / f"{name}{suffix}" for name in _NAMES]
        if all(file.is_file() for file in files):
            return files
    raise FormatError(
        "has no complete set of cameras, images and points3D.",
        file=model,
        field="model",
        hint="copy the three files of the model with the same suffix, .bin or .txt",
    )


def _lenses(file: Path) -> dict[int, Lens]:
    """Read the lenses of a model by their camera ids."""
    lenses: dict[int, Lens] = {}
    for row in read_cameras(file):
        field = f"camera {row.camera_id}"
        if row.camera_id in lenses:
            raise FormatError("is there twice.", file=file, field=field, hint="remove one of the two")
        values = {("fx" if name == "f" else name): value for name, value in row.params.items()}
        values.setdefault("fy", values["fx"])
        lenses[row.camera_id] = make_lens(file, field, row.size, values, fisheye="FISHEYE" in row.model)
    return lenses


def _pose(file: Path, row: ImageRow) -> NDArray[np.float64]:
    """Return T_world_camera (4, 4) of an image."""
    try:
        T = inverse(pose_from_quat(row.translation, row.quat))
    except ValueError as error:
        raise FormatError(
            f"is {row.quat}: {error}.", file=file, field=f"image {row.name} QW..QZ", hint="remove or pose the image"
        ) from error
    if not (np.abs(T) < _MAX_DISTANCE).all():  # False for NaN
        raise FormatError(
            f"is {row.translation}.",
            file=file,
            field=f"image {row.name} TX..TZ",
            hint=f"remove the image; values below {_MAX_DISTANCE:g} are taken",
        )
    return T


def _image_lenses(file: Path, rows: Sequence[ImageRow], lenses: Mapping[int, Lens]) -> list[tuple[str, Lens]]:
    """Return name and lens of each image."""
    unknown = next((row for row in rows if row.camera_id not in lenses), None)
    if unknown is not None:
        raise FormatError(
            f"is {unknown.camera_id}, and no such camera is in the model.",
            file=file,
            field=f"image {unknown.name} CAMERA_ID",
            hint="copy the files of cameras and images from the same model",
        )
    outside = next((name for name in (PurePosixPath(row.name) for row in rows) if _leaves_folder(name)), None)
    if outside is not None:
        raise FormatError(
            "is outside of the folder images.", file=file, field=f"image {outside} NAME", hint="give relative names"
        )
    return [(row.name, lenses[row.camera_id]) for row in rows]


def _leaves_folder(name: PurePosixPath) -> bool:
    return name.is_absolute() or ".." in name.parts


def _image_root(model: Path, scale: int) -> Path:
    """Return the folder that holds the folder `images`: that of the model, or one of the two above it."""
    roots = [model, *model.absolute().parents[:2]]
    for root in roots:
        if (root / "images").is_dir() or (root / f"images_{scale}").is_dir():
            return root
    raise LogError(
        "has no folder images next to its model.", file=model, field="images", hint=f"copy it to {roots[-1]}/images"
    )


def _photos(root: Path, images: Sequence[tuple[str, Lens]], scale: int) -> list[PhotoFile]:
    """Open the photographs of a scene; all of them are needed."""
    photos = [_photo(root, name, lens, scale) for name, lens in images]
    missing = [name for (name, _), photo in zip(images, photos, strict=True) if photo is None]
    if missing:
        raise LogError(
            f"is missing, the first of {len(missing)} of {len(images)} images.",
            file=root / "images" / missing[0],
            field="image",
            hint="copy the images with which the model was made, or remove them from the model",
        )
    return [photo for photo in photos if photo is not None]


def _photo(root: Path, name: str, lens: Lens, scale: int) -> PhotoFile | None:
    """Open a photograph, already scaled if there is one of fitting size; None if the file is missing."""
    small, large = root / f"images_{scale}" / name, root / "images" / name
    if scale > 1 and is_image(small):
        size, expected = photo_size(small), scaled_size(lens.camera, scale)
        if max(abs(size[0] - expected[0]), abs(size[1] - expected[1])) <= 1:
            return PhotoFile(small, lens.resized(size), size)
    return open_photo(large, lens, scale) if is_image(large) else None
