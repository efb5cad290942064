"""Photographs of a scene from a folder of images or from a video: all, or the sharpest one of each interval."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.errors import InputError, LogError
from splatbot.logs.images import read_color
from splatbot.training.datasets.images import photo_size

MIN_PHOTOGRAPHS, MAX_PHOTOGRAPHS = 3, 2000
USUAL_FRAMES = 150  # of a video

_SUFFIXES = (".jpg", ".jpeg", ".png")
_OTHERS = (".heic", ".heif", ".avif", ".webp", ".tif", ".tiff", ".bmp", ".gif", ".dng", ".cr2", ".cr3", ".nef", ".arw")
_WHOLE = 0.95  # share of the stated frames below which a video counts as cut off
_JPEG_QUALITY = 95
_WIDTH = 640  # [px] at which sharpness is measured, where noise of single pixels is small

Bgr = NDArray[np.uint8]
Report = Callable[[str, float], None]

_log = logging.getLogger(__name__)


def collect_photographs(source: Path, folder: Path, frames: int | None, report: Report) -> list[str]:
    """Copy images, or frames of a video, to a folder that exists, and return their names.

    Hidden files are left out. Warnings count images of other formats, and the frames of a video that is cut off.

    Args:
        source: a folder with .jpg and .png files, or a video.
        folder: where to write.
        frames: number of intervals of which the sharpest image is taken; by default all images, or 150 of a video.
        report: is called with the name of the step and its finished share.

    Raises:
        InputError: there are too few or too many images, or a name is not UTF-8.
        LogError: the video or an image is damaged.
        FormatError: an image is larger than 64 megapixels.
    """
    if not source.is_dir():
        return _frames_of_video(source, folder, frames or USUAL_FRAMES, report)
    files = sorted(_images(source))
    count = min(len(files), frames or len(files))
    _check_count(source, count, "images")
    names = []
    images = (_read(file) for file in files)  # refuses damaged images before COLMAP runs
    for index, _ in _sharpest(images, len(files), count, _reporter(report, "reading images", len(files))):
        names.append(files[index].name)
        shutil.copyfile(files[index], folder / names[-1])
    return names


def _images(folder: Path) -> list[Path]:
    """List the images of a folder; raises InputError for a name that the database of COLMAP cannot hold."""
    visible = [file for file in folder.iterdir() if not file.name.startswith(".")]
    others = sum(file.suffix.lower() in _OTHERS for file in visible)
    if others:
        _log.warning("%s: %d images of other formats are left out; convert them to .jpg or .png", folder, others)
    images = [file for file in visible if file.suffix.lower() in _SUFFIXES]
    for file in images:
        try:
            file.name.encode()
        except UnicodeEncodeError as error:
            name = os.fsencode(file.name).decode(errors="replace")
            raise InputError("has a name that is not UTF-8.", file=folder, field=name, hint="rename it") from error
    return images


def _read(file: Path) -> Bgr:
    photo_size(file)  # bounds the pixels before they are decoded
    return read_color(file)


def sharpness(image: Bgr) -> float:
    """Return the variance of the Laplacian of an image (H, W, 3), reduced to 640 px if it is wider."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if grey.shape[1] > _WIDTH:
        grey = cv2.resize(grey, (_WIDTH, max(1, grey.shape[0] * _WIDTH // grey.shape[1])), interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(grey, cv2.CV_64F).var())


def _frames_of_video(video: Path, folder: Path, frames: int, report: Report) -> list[str]:
    capture = cv2.VideoCapture(str(video.absolute()))  # no name is an address
    try:
        total = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if capture.isOpened() else 0
        if total <= 0:
            hint = "give a video that OpenCV reads (.mp4, .mov, .avi), or a folder of images"
            raise LogError("is no video, or states no number of frames.", file=video, field="video", hint=hint)
        count = min(total, frames)
        _check_count(video, count, "frames")
        names = []
        images = _decoded(video, capture, total)
        for index, image in _sharpest(images, total, count, _reporter(report, "reading frames", total)):
            names.append(f"frame_{index:06d}.jpg")
            if not cv2.imwrite(str(folder / names[-1]), image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]):
                raise OSError(None, "cannot be written", str(folder / names[-1]))
        _check_count(video, len(names), "frames")
        return names
    finally:
        capture.release()


def _decoded(video: Path, capture: cv2.VideoCapture, total: int) -> Iterator[Bgr]:
    """Yield the frames of a video; a warning is logged if they are clearly fewer than the stated total."""
    read = 0
    while (frame := capture.read())[0]:
        read += 1
        yield np.asarray(frame[1], np.uint8)
    if read < _WHOLE * total:
        problem = "%s: only %d of the stated %d frames can be decoded; if the file is cut off, copy it again"
        _log.warning(problem, video, read, total)


def _sharpest(images: Iterable[Bgr], total: int, count: int, read: Callable[[int], None]) -> Iterator[tuple[int, Bgr]]:
    """Yield index and image of the sharpest image of each of ``count`` equal intervals of ``total`` images.

    Images beyond the total are of the last interval, so that at most ``count`` images are taken.
    """
    best: tuple[float, int, Bgr] | None = None
    interval = 0
    for index, image in enumerate(images):
        read(index)
        current = min(count - 1, index * count // total)
        if current != interval and best is not None:
            yield best[1:]
            best = None
        interval = current
        found = sharpness(image)
        if best is None or found > best[0]:
            best = found, index, image
    if best is not None:
        yield best[1:]


def _reporter(report: Report, step: str, total: int) -> Callable[[int], None]:
    return lambda index: report(step, min(1.0, index / total))


def _check_count(source: Path, count: int, name: str) -> None:
    if not MIN_PHOTOGRAPHS <= count <= MAX_PHOTOGRAPHS:
        hint = f"give {MIN_PHOTOGRAPHS} to {MAX_PHOTOGRAPHS:,}; --frames takes the sharpest ones of many"
        raise InputError(f"makes {count:,} photographs.", file=source, field=name, hint=hint)
