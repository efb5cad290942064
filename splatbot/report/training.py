"""Pictures of a training: its course, and held-out photographs next to renders of the map."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from splatbot.report.theme import BLUE, GREEN, figure, png, styled
from splatbot.training.folder import ProgressRow
from splatbot.training.scoring import HeldOutScore

_HEIGHT = 320  # [px] of one image


def training_pictures(rows: list[ProgressRow], scores: list[HeldOutScore]) -> dict[str, bytes]:
    """Return the pictures of a training by file name: ``course.png`` and, with held-out views, ``held_out.jpg``."""
    pictures = {"course.png": course_plot(rows), "held_out.jpg": held_out_picture(scores)}
    return {name: data for name, data in pictures.items() if data is not None}


@styled
def course_plot(rows: Sequence[ProgressRow]) -> bytes:
    """Plot PSNR of the held-out views, or the loss without any, and the number of Gaussians over the time."""
    fig, (left, right) = figure(2)
    minutes = [row.seconds / 60 for row in rows]
    scored = [(t, row.psnr_db) for t, row in zip(minutes, rows, strict=True) if row.psnr_db is not None]
    if scored:
        left.plot(*zip(*scored, strict=True), color=BLUE, marker=".")
        left.set_ylabel("PSNR of held-out views [dB]")
    else:
        left.plot(minutes, [row.loss for row in rows], color=BLUE, marker=".")
        left.set_ylabel("loss")
    right.plot(minutes, [row.gaussians for row in rows], color=GREEN, marker=".")
    right.set_ylabel("Gaussians")
    for ax in (left, right):
        ax.set_xlabel("time of training [min]")
    return png(fig)


def held_out_picture(scores: Sequence[HeldOutScore]) -> bytes | None:
    """Return a JPEG: in each row a held-out photograph, the render, and their absolute difference; None without any."""
    rows = []
    for images in (score.images for score in scores if score.images is not None):
        image, render = images.astype(np.int16)
        row = np.concatenate([image, render, np.abs(image - render)], axis=1).astype(np.uint8)
        height, width = row.shape[:2]
        size = round(width * _HEIGHT / height), _HEIGHT
        rows.append(np.asarray(cv2.resize(row, size, interpolation=cv2.INTER_AREA)))
    if not rows:
        return None
    widest = max(row.shape[1] for row in rows)
    picture = np.concatenate([np.pad(row, ((0, 0), (0, widest - row.shape[1]), (0, 0))) for row in rows])
    return bytes(cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])[1])
