"""Photographs of a scene from a folder of images or from a video: all, or the sharpest one of each interval."""

from __future__ import annotations

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
_JPEG_QUALITY = 95
_WIDTH = 640  # [px] at which sharpness is measured, where noise of single pixels is small

Bgr = NDArray[np.uint8]
Report = Callable[[str, float], None]


def collect_photographs(source: Path, folder: Path, frames: int | None, report: Report) -> list[str]:
    """Copy images, or frames of a video, to a folder that exists, and return their names.

    Args:
        source: a folder with .jpg and .png files, or a video.
        folder: where to write.
        frames: number of intervals of which the sharpest image is taken; by default all images, or 150 of a video.
        report: is called with the name of the step and its finished share.

    Raises:
        InputError: there are too few or too many images.
        LogError: the video or an image is damaged.
    """
    if not source.is_dir():
        return _frames_of_video(source, folder, frames or USUAL_FRAMES, report)
    files = sorted(file for file in source.iterdir() if file.suffix.lower() in _SUFFIXES)
    _check_count(source, min(len(files), frames or len(files)), "images")
    if frames is not None and frames < len(files):
        report_read = _reporter(report, "reading images", len(files))
        images = (read_color(file) for file in files)
        files = [files[index] for index, _ in _sharpest(images, len(files), frames, report_read)]
    for index, file in enumerate(files):
        report("copying images", index / len(files))
        photo_size(file)  # refuses damaged images before the work begins
        shutil.copyfile(file, folder / file.name)
    return [file.name for file in files]


def sharpness(image: Bgr) -> float:
    """Return the variance of the Laplacian of an image (H, W, 3), reduced to 640 px if it is wider."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if grey.shape[1] > _WIDTH:
        grey = cv2.resize(grey, (_WIDTH, max(1, grey.shape[0] * _WIDTH // grey.shape[1])), interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(grey, cv2.CV_64F).var())


def _frames_of_video(video: Path, folder: Path, frames: int, report: Report) -> list[str]:
    capture = cv2.VideoCapture(str(video))
    try:
        total = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if capture.isOpened() else 0
        if total <= 0:
            hint = "give a video that OpenCV reads (.mp4, .mov, .avi), or a folder of images"
            raise LogError("is no video, or states no number of frames.", file=video, field="video", hint=hint)
        _check_count(video, min(total, frames), "frames")
        names = []
        for index, image in _sharpest(_decoded(capture), total, frames, _reporter(report, "reading frames", total)):
            names.append(f"frame_{index:06d}.jpg")
            if not cv2.imwrite(str(folder / names[-1]), image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]):
                raise OSError(None, "cannot be written", str(folder / names[-1]))
        _check_count(video, len(names), "frames")
        return names
    finally:
        capture.release()


def _decoded(capture: cv2.VideoCapture) -> Iterator[Bgr]:
    while (frame := capture.read())[0]:
        yield np.asarray(frame[1], np.uint8)


def _sharpest(images: Iterable[Bgr], total: int, count: int, read: Callable[[int], None]) -> Iterator[tuple[int, Bgr]]:
    """Yield index and image of the sharpest image of each of ``count`` equal intervals of ``total`` images."""
    best: tuple[float, int, Bgr] | None = None
    interval = 0
    for index, image in enumerate(images):
        read(index)
        if index * count // total != interval and best is not None:
            yield best[1:]
            best = None
        interval = index * count // total
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
