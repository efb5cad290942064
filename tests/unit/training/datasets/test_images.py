"""Reading, undistortion and scaling of photographs."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatbot.errors import FormatError, LogError
from splatbot.logs.images import read_color
from splatbot.training.datasets.images import Lens, make_lens, open_photo, photo_size, read_photo, unseen
from tests.unit.training.datasets.scenes import HEIGHT, WIDTH

PINHOLE = {"fx": 140.0, "fy": 133.0, "cx": 81.0, "cy": 58.5}


def lens(**coefficients: float) -> Lens:
    """Build a lens of 160x120 pixels."""
    return make_lens(Path("file"), "camera", (WIDTH, HEIGHT), PINHOLE | coefficients)


@pytest.fixture
def noise(tmp_path: Path, rng: np.random.Generator) -> Path:
    """A PNG of noise."""
    cv2.imwrite(str(tmp_path / "noise.png"), rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8))
    return tmp_path / "noise.png"


def test_image_without_distortion_and_scale_is_returned_as_recorded(noise: Path) -> None:
    photo = open_photo(noise, lens(), 1)
    np.testing.assert_array_equal(photo.read(), read_color(noise))
    assert photo.view("a", np.eye(4)).read_mask is None


def test_principal_point_moves_from_corners_to_pixel_centres() -> None:
    assert (lens().camera.cx, lens().camera.cy) == (80.5, 58.0)
    np.testing.assert_allclose(lens().camera.K_corner[:2, 2], (81.0, 58.5))


def test_scaled_image_is_the_mean_over_pixel_areas(noise: Path) -> None:
    photo = open_photo(noise, lens(), 4)
    blocks = read_photo(noise).reshape(HEIGHT // 4, 4, WIDTH // 4, 4, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(photo.read(), blocks, atol=0.51)
    camera = photo.view("a", np.eye(4)).camera
    assert (camera.width, camera.height) == (40, 30)
    np.testing.assert_allclose(camera.K_corner[:2, 2], (81 / 4, 58.5 / 4))


def test_hidden_colours_do_not_blend_into_visible_ones(tmp_path: Path) -> None:
    image = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    image[:, ::2] = (0, 255, 0, 255)
    image[:, 1::2] = (255, 0, 255, 0)
    cv2.imwrite(str(tmp_path / "a.png"), image)
    assert (open_photo(tmp_path / "a.png", lens(), 2).read() == (0, 255, 0, 128)).all()
    undistorted = open_photo(tmp_path / "a.png", lens(k1=0.05), 1).read()
    np.testing.assert_array_equal(undistorted[undistorted[..., 3] > 20, :3] == (0, 255, 0), True)


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_grey_colour_and_alpha_of_8_and_16_bits_become_rgb_or_rgba(
    tmp_path: Path, channels: int, kind: type[np.uint8 | np.uint16]
) -> None:
    top = np.iinfo(kind).max
    image = np.full((HEIGHT, WIDTH, channels), top // 4, kind)
    image[..., -1] = top
    cv2.imwrite(str(tmp_path / "a.png"), image)
    read = read_photo(tmp_path / "a.png")
    assert read.dtype == np.uint8
    expected = {1: (255, 255, 255), 3: (255, 63, 63), 4: (63, 63, 63, 255)}[channels]
    np.testing.assert_array_equal(read[0, 0], expected)


def test_pixels_whose_source_is_outside_of_the_image_are_masked(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "white.png"), np.full((HEIGHT, WIDTH, 3), 255, np.uint8))
    photo = open_photo(tmp_path / "white.png", lens(k1=0.3), 2)
    mask = photo.read_mask()
    assert mask.shape == (HEIGHT // 2, WIDTH // 2)
    assert mask[0, 0]
    assert mask[-1, -1]
    assert not mask[5:-5, 10:-10].any()
    assert (photo.read() == 255).all()  # the border is repeated, not black


@pytest.mark.parametrize(("k1", "fisheye"), [(-0.5, False), (-0.6, True)])
def test_pixels_beyond_the_fold_of_the_distortion_are_masked(k1: float, fisheye: bool) -> None:
    wide = make_lens(
        Path("file"), "camera", (160, 120), {"fx": 60, "fy": 60, "cx": 80, "cy": 60, "k1": k1}, fisheye=fisheye
    )
    fold = np.sqrt(1 / (3 * -k1))  # the root of 1 + 3 k1 r²
    radius = (np.tan(fold) if fisheye else fold) * 60
    v, u = np.mgrid[:120, :160]
    distance = np.hypot(u - 79.5, v - 59.5)
    np.testing.assert_array_equal(
        unseen(wide)[np.abs(distance - radius) > 0.1], (distance > radius)[np.abs(distance - radius) > 0.1]
    )


@pytest.mark.parametrize("coefficients", [{"k1": 1e30}, {"k2": -1e300}, {"k6": 1e308, "k3": -1e308}, {"p1": 1e200}])
def test_absurd_distortion_masks_pixels_without_an_error(noise: Path, coefficients: dict[str, float]) -> None:
    photo = open_photo(noise, lens(**coefficients), 1)
    assert photo.read().shape == (HEIGHT, WIDTH, 3)
    assert photo.read_mask().mean() > 0.9


def test_more_than_64_megapixels_are_refused_by_the_header(tmp_path: Path) -> None:
    header = b"IHDR" + struct.pack(">IIBBBBB", 8001, 8000, 8, 2, 0, 0, 0)
    file = tmp_path / "huge.png"
    file.write_bytes(b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header)))
    for read in (photo_size, read_photo):
        with pytest.raises(FormatError, match=r"8001x8000 px.*64 megapixels"):
            read(file)


def test_damaged_and_replaced_files_are_named(noise: Path, tmp_path: Path) -> None:
    photo = open_photo(noise, lens(), 1)
    noise.write_bytes(noise.read_bytes()[:-20])
    with pytest.raises(LogError, match=r"noise\.png.*truncated"):
        photo.read()
    cv2.imwrite(str(noise), np.zeros((HEIGHT, WIDTH + 2, 3), np.uint8))
    with pytest.raises(LogError, match="162x120"):
        photo.read()
    with pytest.raises(LogError, match=r"none\.png.*cannot be read"):
        open_photo(tmp_path / "none.png", lens(), 1)


def test_size_of_formats_without_a_known_header_is_decoded(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.bmp"), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    assert photo_size(tmp_path / "a.bmp") == (WIDTH, HEIGHT)
