"""The robot in its own camera's view."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.camera import Camera
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.geometry import transform_points
from splatbot.logs.scenes.tabletop import tabletop
from splatbot.mapping.selfmask import JointsUnknownError, SelfMask
from splatbot.robots.panda import panda
from splatbot.run.masked import MaskedLog
from splatbot.sim.wrist import T_PANDA_CAMERA, WristLog
from splatbot.slam import Slam
from tests.swept_arm import START, T_BASE_STATIC_CAMERA, T_SCENE_BASE, distance_to_arm

SWING = np.array([0.25, 0.1, 0.0, 0.1, 0.0, 0.1, 0.2])


@pytest.fixture(scope="module")
def log() -> WristLog:
    """The arm swings over the table, at least 10 cm from everything on it."""
    joints = START + np.sin(np.linspace(0, np.pi / 2, 24))[:, None] * SWING
    return WristLog(panda(), joints, tabletop().surfaces, T_scene_base=T_SCENE_BASE, width=160)


def test_the_hand_is_in_view_and_every_pixel_of_it_is_left_out(log: WristLog) -> None:
    mask = SelfMask(panda(), T_PANDA_CAMERA)
    for index in (0, 12, 23):
        frame = log[index]
        shown = log.shows_robot(index)
        assert 0.03 < shown.mean() < 0.5
        usable = mask.usable(frame)
        assert not (usable & shown).any()
        assert usable.mean() > 0.3
        # All unmasked points lie at least 2 cm from the arm.
        points = transform_points(
            T_PANDA_CAMERA, frame.camera.backproject(frame.depth)[usable & (frame.depth > 0)].astype(float)
        )
        at_base = transform_points(panda().fk(log.joints[index])[-1], points)
        assert distance_to_arm(at_base, log.joints[index]).min() > 0.02


@pytest.mark.long
def test_with_the_mask_no_gaussian_is_near_the_swept_arm_and_without_it_many_are(log: WristLog) -> None:
    near, blocked = [], []
    for self_mask in (SelfMask(panda(), T_PANDA_CAMERA), None):
        slam = Slam()
        for frame in log if self_mask is None else MaskedLog(log, self_mask):
            slam.process(frame)
        slam.finish()
        model = slam.snapshot().model
        T_base_map = np.linalg.inv(T_SCENE_BASE) @ log.ground_truth.T_world_camera[0]
        means = transform_points(T_base_map, model.means.double().numpy())
        swept = np.min([distance_to_arm(means, q) for q in log.joints], axis=0)
        near.append(int((swept < 0.02).sum()))
        arm = RobotSpheres(panda(), T_world_base=np.linalg.inv(T_base_map))
        field = GaussianCollisionField(slam.snapshot(), min_observations=0)
        blocked.append(int(arm.check(field, log.joints).in_collision.sum()))
    assert near[0] == 0
    assert near[1] > 100
    assert blocked[0] == 0
    assert blocked[1] > 0.5 * len(log)


def test_objects_in_front_of_the_robot_and_far_from_it_are_not_masked() -> None:
    camera = Camera(100.0, 100.0, 79.5, 59.5, 160, 120)
    q = START
    rgb = np.zeros((120, 160, 3), np.uint8)
    # A camera that stands 1.5 m before the arm and looks at it.
    T = np.array([[0.0, 0, -1, 1.5], [1, 0, 0, 0], [0, -1, 0, 0.4], [0, 0, 0, 1]])
    mask = SelfMask(panda(), T, link=0)
    far = mask.usable(Frame(0.0, rgb, np.full((120, 160), 3.0, np.float32), camera, joints=q))
    before = mask.usable(Frame(0.0, rgb, np.full((120, 160), 0.3, np.float32), camera, joints=q))
    missing = mask.usable(Frame(0.0, rgb, np.zeros((120, 160), np.float32), camera, joints=q))
    assert before.all()
    assert 0.02 < (~far).mean() < 0.5
    np.testing.assert_array_equal(far, missing)
    own = np.ones((120, 160), np.bool_)
    own[:10] = False
    both = mask(Frame(0.0, rgb, np.full((120, 160), 3.0, np.float32), camera, joints=q, mask=own))
    np.testing.assert_array_equal(both.mask, own & far)


def test_rays_are_judged_as_one_by_one_geometry_judges_them() -> None:
    rng = np.random.default_rng(0)
    camera = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
    T = np.array([[0.0, 0, -1, 1.0], [1, 0, 0, 0.1], [0, -1, 0, 0.5], [0, 0, 0, 1]])
    for _ in range(2):
        q = panda().random(1, rng)[0]
        depth = rng.uniform(0.2, 2.0, (48, 64)).astype(np.float32)
        usable = SelfMask(panda(), T, link=0).usable(
            Frame(0.0, np.zeros((48, 64, 3), np.uint8), depth, camera, joints=q)
        )
        arm = RobotSpheres(panda())
        centers = transform_points(np.linalg.inv(T), arm.centers(q)[0])
        rays = camera.backproject(np.ones((48, 64), np.float32)).astype(float)
        along = (rays**2).sum(axis=-1)
        met = np.zeros((48, 64), np.bool_)
        for center, radius in zip(centers, arm.spheres.radii + 0.02, strict=True):
            nearest = np.clip(rays @ center / along, 0.0, depth)[..., None] * rays  # on the ray up to its surface
            gap = np.linalg.norm(nearest - center, axis=-1) - radius
            met |= gap < -2e-3
        assert not (usable & met).any()


def test_frames_without_joints_and_cameras_on_no_link_are_refused() -> None:
    camera = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
    frame = Frame(0.0, np.zeros((48, 64, 3), np.uint8), np.ones((48, 64), np.float32), camera)
    with pytest.raises(InputError, match="no joints"):
        SelfMask(panda(), np.eye(4))(frame)
    with pytest.raises(InputError, match="link"):
        SelfMask(panda(), np.eye(4), link=8)
    with pytest.raises(InputError, match="rigid"):
        SelfMask(panda(), np.ones((4, 4)))


def _front(z: float, q: np.ndarray, names: tuple[str, ...] = ()) -> Frame:
    camera = Camera(100.0, 100.0, 79.5, 59.5, 160, 120)
    rgb = np.zeros((120, 160, 3), np.uint8)
    return Frame(0.0, rgb, np.full((120, 160), z, np.float32), camera, joints=q, joint_names=names)


def test_joints_are_found_by_their_names_in_any_order_and_among_others() -> None:
    mask = SelfMask(panda(), T_BASE_STATIC_CAMERA, link=0)
    in_order = mask.usable(_front(3.0, START))
    names = ("finger", *reversed(panda().chain.names))
    shuffled = mask.usable(_front(3.0, np.array([0.02, *reversed(START)]), names))
    np.testing.assert_array_equal(shuffled, in_order)
    generic = tuple(f"joint{k + 1}" for k in range(8))
    np.testing.assert_array_equal(mask.usable(_front(3.0, np.array([*START, 0.02]), generic)), in_order)
    own = tuple(f"left_arm_{k}" for k in range(7))
    with pytest.raises(JointsUnknownError, match=r"has no joint panda_joint1.*joint_names"):
        mask.usable(_front(3.0, START, own))
    renamed = SelfMask(panda(), T_BASE_STATIC_CAMERA, link=0, joint_names=own)
    np.testing.assert_array_equal(renamed.usable(_front(3.0, START[::-1].copy(), own[::-1])), in_order)
    with pytest.raises(InputError, match="joint_names"):
        SelfMask(panda(), T_BASE_STATIC_CAMERA, link=0, joint_names=own[:3])


def test_an_object_in_the_hand_is_masked_too() -> None:
    at_hand = panda().fk(START)[-1]
    plain, held = (
        SelfMask(panda(), T_BASE_STATIC_CAMERA, link=0, held=spheres) for spheres in (None, [[0.15, 0.0, 0.2, 0.05]])
    )
    frame = _front(3.0, START)
    more = plain.usable(frame) & ~held.usable(frame)
    center = transform_points(np.linalg.inv(T_BASE_STATIC_CAMERA) @ at_hand, np.array([[0.15, 0.0, 0.2]]))[0]
    u, v = (frame.camera.K @ (center / center[2]))[:2]
    rows, columns = np.nonzero(more)
    # The ring around the point at which the centre appears has the radius of the enlarged sphere, 7 cm.
    assert len(rows) > 20
    assert np.hypot(columns - u, rows - v).max() < 1.0 + 100.0 * 0.07 / (center[2] - 0.07)
