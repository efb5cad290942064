"""Effects of lenses, shutters, pixels and cables on frames, each against an independent computation."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
import torch

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.geometry import se3_exp
from splatbot.logs import open_log
from splatbot.logs.synthetic import SyntheticLog
from splatbot.logs.undistort import Undistorter
from splatbot.rasterize import rasterization
from splatbot.sim.effects.color_noise import ColorNoise
from splatbot.sim.effects.depth_camera import DepthCamera
from splatbot.sim.effects.latency import Latency
from splatbot.sim.effects.lens_distortion import LensDistortion, _undistorted
from splatbot.sim.effects.registry import EFFECTS, effect_class, make_effect
from splatbot.sim.effects.rolling_shutter import RollingShutter
from splatbot.sim.effects.warping import pose_at
from splatbot.sim.effects.white_balance import WhiteBalance
from splatbot.trajectory import Trajectory
from tests.unit.sim.frames import frame_at

RNG = np.random.default_rng(0)
SPEC_WITH_EFFECT = {
    "blackout": "blackout:at=2,n=2",
    "depth_camera": "depth_camera:delay=0.01",
    "frame_drops": "frame_drops:rate=0.5",
}
LENS = LensDistortion(k1=-0.2, k2=0.05, p1=0.002, p2=-0.001)


def seen(effects: str) -> dict[str, list[object]]:
    """Describe a stream of six frames."""
    log = open_log(f"synthetic:tabletop?trajectory=handheld&frames=6&width=96&height=72&effects={effects}")
    frames = list(log)
    return {
        "colors": [frame.rgb.tobytes() for frame in frames],
        "depth": [frame.depth.tobytes() for frame in frames],
        "stamps": [frame.stamp for frame in frames],
        "arrivals": [len(frames)],
    }


@pytest.mark.parametrize("name", EFFECTS)
def test_without_an_effect_what_it_declares_to_change_is_different(name: str) -> None:
    observable = effect_class(name).observable
    assert seen(SPEC_WITH_EFFECT.get(name, name))[observable] != seen("")[observable]
    assert effect_class(name).cost


@pytest.mark.parametrize("value", [10, 120, 200])
def test_colour_noise_has_the_variance_of_photons_and_reading(value: int) -> None:
    noise = ColorNoise(full_well=2000, read=20)
    noisy = noise.apply(frame_at(rgb=value), RNG).rgb.astype(np.float64)
    scale = 2000 / 255
    sigma = np.sqrt(scale * value + 20.0**2) / scale
    assert noisy.mean() == pytest.approx(value, abs=0.1 + 5 * sigma / np.sqrt(noisy.size))
    if value > 4 * sigma:  # nothing is clipped; rounding adds a twelfth
        assert noisy.var() == pytest.approx(sigma**2 + 1 / 12, rel=0.03)


def test_white_balance_scales_each_channel_while_it_lasts() -> None:
    effect = WhiteBalance(red=1.5, green=1.0, blue=0.5, at=2, until=4)
    assert effect.apply(frame_at(rgb=100, index=2), RNG).rgb[0, 0].tolist() == [150, 100, 50]
    assert effect.apply(frame_at(rgb=200, index=3), RNG).rgb[0, 0].tolist() == [255, 200, 100]
    assert (effect.apply(frame_at(rgb=100, index=4), RNG).rgb == 100).all()


def test_a_bent_pixel_looks_where_opencv_says() -> None:
    camera = Camera(150.0, 160.0, 99.5, 74.5, 200, 150)
    corners = np.array([[0, 0], [199, 0], [0, 149], [199, 149], [100, 75], [20, 130]], np.float64)
    coefficients = (LENS.k1, LENS.k2, LENS.p1, LENS.p2, LENS.k3)
    ideal = _undistorted(camera, coefficients)[corners[:, 1].astype(int), corners[:, 0].astype(int)]
    rays = np.concatenate([(ideal - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones((6, 1))], axis=1)
    back, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.K, np.array(coefficients))
    np.testing.assert_allclose(back[:, 0], corners, atol=0.01)


def test_undistorting_gives_the_ideal_image_back() -> None:
    log = open_log("synthetic:tabletop?frames=1&width=320&height=240")
    bent = LENS.apply(log[0], RNG)
    camera = Camera(**{**log.camera.__dict__, "distortion": (LENS.k1, LENS.k2, LENS.p1, LENS.p2)})
    back = Undistorter(camera)
    inner = (slice(20, -20), slice(20, -20))
    restored = back.color(bent.rgb)[inner].astype(float)
    assert (
        np.abs(bent.rgb[inner].astype(float) - log[0].rgb[inner]).mean()
        > 3 * np.abs(restored - log[0].rgb[inner]).mean()
    )
    assert np.median(np.abs(back.depth(bent.depth)[inner] - log[0].depth[inner])) < 2e-3


def test_a_warped_picture_of_gaussians_is_the_one_that_the_unscented_transform_draws() -> None:
    rng = np.random.default_rng(3)
    camera = Camera(180.0, 180.0, 119.5, 89.5, 240, 180)
    n = 400
    means = torch.from_numpy(rng.uniform([-1, -0.8, 1.5], [1, 0.8, 2.5], (n, 3))).float()
    given: dict[str, Any] = {
        "means": means,
        "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        "scales": torch.full((n, 3), 0.05),
        "opacities": torch.full((n,), 0.9),
        "colors": torch.from_numpy(rng.uniform(0, 1, (n, 3))).float(),
        "viewmats": torch.eye(4)[None],
        "Ks": torch.from_numpy(camera.K_corner).float()[None],
        "width": 240,
        "height": 180,
    }
    radial, tangential = torch.tensor([[LENS.k1, LENS.k2, 0, 0, 0, 0]]), torch.tensor([[LENS.p1, LENS.p2]])
    drawn, _, _ = rasterization(**given, with_ut=True, radial_coeffs=radial, tangential_coeffs=tangential)
    ideal, _, _ = rasterization(**given)
    rgb = [np.rint(255 * image[0].clamp(0, 1).numpy()).astype(np.uint8) for image in (ideal, drawn)]
    warped = LENS.apply(Frame(0.0, rgb[0], np.ones((180, 240), np.float32), camera), RNG).rgb
    inner = (slice(12, -12), slice(12, -12))
    errors = [np.abs(image[inner].astype(float) - rgb[1][inner]).mean() for image in (warped, rgb[0])]
    assert errors[1] > 5
    assert errors[0] < 0.2 * errors[1]


def test_a_lens_that_folds_the_image_is_refused() -> None:
    with pytest.raises(InputError, match="folds"):
        LensDistortion(k1=-2.0).apply(frame_at(), RNG)


@pytest.mark.parametrize(
    ("scene", "trajectory", "left"), [("wall", "rotation", 0.3), ("wall", "arm", 0.3), ("tabletop", "arm", 0.55)]
)
def test_a_rolling_shutter_comes_near_to_lines_rendered_one_by_one(scene: str, trajectory: str, left: float) -> None:
    """Fine texture sampled once a pixel differs from itself moved by part of one, most of all on the table."""
    log = open_log(f"synthetic:{scene}?trajectory={trajectory}&frames=61&width=160&height=120")
    assert isinstance(log, SyntheticLog)
    frame, readout = log[20], 0.06
    read = RollingShutter(readout=readout).along(log.ground_truth).apply(frame, RNG)
    exact, depth = np.empty_like(frame.rgb), np.empty_like(frame.depth)
    for line in range(120):
        pose = pose_at(log.ground_truth, frame.stamp + readout * (line / 119 - 0.5))
        image = log.scene.render(log.camera, pose)
        exact[line], depth[line] = image[0][line], image[1][line]
    inner = (slice(None), slice(8, -8))
    error, still = (np.abs(x.rgb[inner].astype(float) - exact[inner]).mean() for x in (read, frame))
    assert still > 2  # there is something to shear
    assert error < left * still
    off, unread = (np.median(np.abs(x.depth[inner] - depth[inner])) for x in (read, frame))
    assert off < 0.5 * unread


def test_a_sideways_motion_shears_by_its_speed_times_the_readout() -> None:
    """At 1 m, 2 m/s for 0.05 s are 0.1 m: 20 px from the first line to the last; the middle stays."""
    stamps = np.array([0.0, 1.0])
    path = Trajectory(stamps, np.array([se3_exp([2.0 * t, 0, 0, 0, 0, 0]) for t in stamps]))
    edge = np.where(np.arange(200) < 100, 0, 200)[None, :, None]
    read = RollingShutter(readout=0.05).along(path).apply(frame_at(rgb=edge, index=10), RNG)
    edges = [int(np.argmax(read.rgb[line, :, 0] > 100)) for line in (0, 74, 149)]
    assert edges == pytest.approx([110, 100, 90], abs=1)
    np.testing.assert_allclose(read.depth[read.depth > 0], 1.0, atol=1e-4)


def test_a_late_depth_camera_sees_the_scene_of_the_later_pose_shifted_and_too_near() -> None:
    log = open_log("synthetic:room?trajectory=turns&frames=31&width=160&height=120")
    assert isinstance(log, SyntheticLog)
    frame = log[6]
    effect = DepthCamera(delay=1 / 30, right=3, down=-2, bias=0.02).along(log.ground_truth)
    late = effect.apply(frame, RNG)
    exact = np.roll(log[7].depth, (-2, 3), (0, 1)) - 0.02
    inner = (slice(20, -20), slice(20, -20))
    error, still = (np.abs(image - exact)[inner] for image in (late.depth, frame.depth))
    assert np.median(error) < 2e-3
    assert np.mean(error > 0.05) < 0.5 * np.mean(still > 0.05)
    assert np.array_equal(late.rgb, frame.rgb)


def test_a_late_frame_keeps_its_images_and_is_stamped_when_it_arrives() -> None:
    frame = frame_at(index=3)
    late = Latency(delay=0.04, jitter=0.02).apply(frame, RNG)
    assert 0.04 <= late.stamp - frame.stamp <= 0.06
    assert np.array_equal(late.rgb, frame.rgb)
    assert late.index == 3


@pytest.mark.parametrize(
    "spec",
    ["color_noise:read=-1", "color_noise:full_well=0", "white_balance:red=nan", "rolling_shutter:readout=-1",
     "latency:delay=inf", "stereo_holes:scatter=2", "stereo_holes:dark=300", "lens_distortion:k1=inf"],
)  # fmt: skip
def test_arguments_out_of_range_are_named(spec: str) -> None:
    name, _, rest = spec.partition(":")
    with pytest.raises(InputError) as caught:
        make_effect(spec)
    assert caught.value.field == f"effect {name}: {rest.partition('=')[0]}"
