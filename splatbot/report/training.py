"""Pictures of a training: its course, and held-out photographs next to renders of the map."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from splatbot.report.theme import BLUE, GREEN, figure, png, styled
from splatbot.training.folder import ProgressRow
from splatbot.training.scoring import HeldOutScore

_SHOWN_VIEWS = 4
_HEIGHT = 320  # [px] of one image


def training_pictures(rows: list[ProgressRow], scores: list[HeldOutScore]) -> dict[str, bytes]:
    """Return the pictures of a training by file name: ``course.png`` and, with held-out views, ``held_out.jpg``."""
    pictures = {"course.png": course_plot(rows)}
    if scores:
        pictures["held_out.jpg"] = held_out_picture(scores)
    return pictures


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


def held_out_picture(scores: Sequence[HeldOutScore]) -> bytes:
    """Return a JPEG: in each row a held-out photograph, the render, and their absolute difference."""
    step = -(-len(scores) // _SHOWN_VIEWS)
    rows = []
    for score in scores[::step]:
        difference = np.abs(score.image - score.render)
        row = np.concatenate([score.image, score.render, difference], axis=1)
        height, width = row.shape[:2]
        rows.append(cv2.resize(row, (round(width * _HEIGHT / height), _HEIGHT), interpolation=cv2.INTER_AREA))
    widest = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, 0), (0, widest - row.shape[1]), (0, 0))) for row in rows]
    picture = np.rint(255 * np.concatenate(padded).clip(0, 1)).astype(np.uint8)
    return bytes(cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])[1])
