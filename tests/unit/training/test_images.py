"""Training images in memory."""

from __future__ import annotations

import numpy as np
import torch

from splatbot.camera import Camera
from splatbot.training.datasets import TrainingView
from splatbot.training.images import ImageCache


def view(image: np.ndarray, mask: np.ndarray | None = None) -> tuple[TrainingView, list[int]]:
    reads: list[int] = []

    def read() -> np.ndarray:
        reads.append(1)
        return image

    camera = Camera(200.0, 200.0, 149.5, 99.5, image.shape[1], image.shape[0])
    return TrainingView("a", camera, np.eye(4), read, None, None if mask is None else lambda: mask), reads


def test_an_image_is_read_once_for_all_sizes() -> None:
    one, reads = view(np.zeros((200, 300, 3), np.uint8))
    cache = ImageCache([one])
    sizes = [tuple(cache.photo(0, reduce).rgb.shape) for reduce in (2, 1, 2, 4)]
    assert sizes == [(100, 150, 3), (200, 300, 3), (100, 150, 3), (100, 150, 3)]  # 4 would be below 96 px
    assert len(reads) == 1
    assert cache.photo(0, 2).camera == one.camera.resized(150, 100)


def test_reduced_colours_are_not_mixed_with_those_behind_transparent_pixels() -> None:
    image = np.zeros((200, 300, 4), np.uint8)
    image[:, ::2] = (200, 100, 50, 255)  # every other column; the others are transparent black
    photo = ImageCache([view(image)[0]]).photo(0, 2)
    assert photo.alpha is not None
    torch.testing.assert_close(photo.rgb[5, 5], torch.tensor([200.0, 100.0, 50.0]) / 255, atol=3e-3, rtol=0)
    torch.testing.assert_close(photo.alpha[5, 5], torch.tensor(0.5), atol=3e-3, rtol=0)
    white = photo.over(torch.ones(3))[5, 5]
    torch.testing.assert_close(white, torch.tensor([227.5, 177.5, 152.5]) / 255, atol=5e-3, rtol=0)


def test_a_reduced_pixel_that_touches_a_masked_one_is_not_trained_on() -> None:
    mask = np.zeros((200, 300), bool)
    mask[10, 10] = True
    photo = ImageCache([view(np.zeros((200, 300, 3), np.uint8), mask)[0]]).photo(0, 2)
    assert photo.trained is not None
    assert (~photo.trained).nonzero().tolist() == [[5, 5]]
