"""A log against its twin with known shapes, base pose and arm motion."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from splatbot.bench.collision.peers import solid_mesh
from splatbot.bench.tabletop import Block, Can, Tabletop
from splatbot.camera import Camera
from splatbot.errors import FormatError, InputError
from splatbot.frame import Frame
from splatbot.geometry import inverse, look_at, pose_from_quat, quat_multiply, rotation_to_quat, se3_exp
from splatbot.logs.raycast import RaycastScene, RaycastSurface
from splatbot.logs.textures import Texture
from splatbot.protocols import Array
from splatbot.robots.joint_offsets import robot_in_scene
from splatbot.robots.panda import panda
from splatbot.sim.compare.recorded import ArmRecord, base_in_map, pose_gap, read_arm
from splatbot.sim.compare.replay import BY_IK, RECORDED, find_knots, replay
from splatbot.sim.compare.views import Surroundings, TwinViews, overlap, surroundings
from splatbot.sim.scene import make_scene
from splatbot.sim.solids import BoxGeom, rotation_of, rpy_of
from splatbot.sim.twin import Twin
from splatbot.trajectory import Trajectory
from splatbot.workspace import Workspace

pytest.importorskip("mujoco")

TABLE = Block((0.5, 0.0, -0.02), (0.7, 0.8, 0.04))
THINGS = (Block((0.45, 0.10, 0.06), (0.10, 0.07, 0.12), 0.4), Can((0.55, -0.12, 0.0), 0.035, 0.12))
CAMERA = Camera(150.0, 150.0, 79.5, 59.5, 160, 120)
T_MAP_BASE = pose_from_quat([0.3, -0.2, 0.9], [0.4, -0.8, 0.3, 0.2])
EYE = look_at(np.array([0.0, 0.5, 0.5]), np.array([0.5, 0.0, 0.05]))  # T_base_camera


@cache
def frame() -> Frame:
    stage = RaycastScene(
        [
            RaycastSurface(solid_mesh(solid), Texture((0.8, 0.6, 0.4), (0.2, 0.3, 0.4), seed=i))
            for i, solid in enumerate((TABLE, *THINGS))
        ]
    )
    rgb, depth = stage.render(CAMERA, EYE)
    return Frame(0.0, rgb, depth, CAMERA, 3)


def around(tmp_path: Path, *solids: Block | Can) -> Surroundings:
    model = Tabletop(solids).gaussians(15_000)
    R, turn = T_MAP_BASE[:3, :3], rotation_to_quat(T_MAP_BASE[:3, :3])
    model.means[:] = torch.from_numpy(model.means.double().numpy() @ R.T + T_MAP_BASE[:3, 3]).float()
    model.quats[:] = torch.from_numpy(quat_multiply(turn, model.quats.double().numpy())).float()
    model.save(tmp_path / "map.ply")
    return surroundings(model, tmp_path / "map.ply", T_MAP_BASE, panda())


@pytest.mark.parametrize("rpy", [(0.3, -0.7, 2.1), (0.0, np.pi / 2, 0.4), (-3.0, 1.2, -3.1)])
def test_angles_of_a_rotation_give_it_again(rpy: tuple[float, float, float]) -> None:
    R = rotation_of(rpy)
    np.testing.assert_allclose(rotation_of(rpy_of(R)), R, atol=1e-12)


def test_the_base_is_where_both_cameras_agree(rng: np.random.Generator) -> None:
    arm = {i: se3_exp(rng.normal(size=6)) for i in range(8)}
    tracked = {i: T_MAP_BASE @ T for i, T in arm.items() if i != 2} | {99: np.eye(4)}
    found = base_in_map(arm, tracked, "test")
    np.testing.assert_allclose(found.T_world_base, T_MAP_BASE, atol=1e-12)
    assert found.frames == (0, 1, 3, 4, 5, 6, 7)
    assert found.residuals.max() < 1e-7
    noisy = {i: T @ se3_exp([0.001, 0, 0, 0, 0, 0.002 * (-1) ** i]) for i, T in tracked.items()}
    off = base_in_map(arm, noisy, "test")
    assert pose_gap(off.T_world_base, T_MAP_BASE)[0] < 0.005
    assert off.residuals[:, 1] == pytest.approx(0.002, rel=0.3)


def test_a_frame_that_was_tracked_wrong_does_not_move_the_base(rng: np.random.Generator) -> None:
    arm = {i: se3_exp(rng.normal(size=6)) for i in range(20)}
    tracked = {i: T_MAP_BASE @ T @ se3_exp(rng.normal(scale=5e-4, size=6)) for i, T in arm.items()}
    sound = base_in_map(arm, tracked, "test")
    assert sound.left_out == ()
    wrong = base_in_map(arm, tracked | {7: tracked[7] @ se3_exp([0.09, 0, 0, 0, 0.08, 0])}, "test")
    assert wrong.left_out == (7,)
    assert pose_gap(wrong.T_world_base, sound.T_world_base)[0] < 5e-4
    assert wrong.residuals[7, 0] == pytest.approx(0.09, rel=0.05)


def test_without_a_common_frame_the_error_says_how_many_there_are() -> None:
    with pytest.raises(InputError, match=r"no frame in common .* \(1 and 2 frames\)"):
        base_in_map({0: np.eye(4), 1: np.eye(4)}, {7: np.eye(4)}, "test")


def test_the_twin_of_exact_surfaces_shows_what_the_camera_saw(tmp_path: Path) -> None:
    views = TwinViews(around(tmp_path, TABLE, *THINGS))
    found, seen = views.compare(frame(), EYE, held_out=True, gap=None)
    assert found.index == 3
    assert found.held_out
    assert found.coverage == pytest.approx(1.0, abs=0.02)
    assert found.part_l1_m is not None
    assert found.part_l1_m < 0.004
    assert found.physics_l1_m is not None
    assert found.physics_l1_m < 0.006
    assert found.iou is not None
    assert found.iou > 0.78  # discs of 1 cm fray the outlines
    assert found.physics_iou is not None
    assert found.physics_iou > 0.9
    assert seen.above is not None
    assert 0.02 < seen.above.mean() < 0.3


def test_a_thing_that_the_map_lacks_costs_overlap_and_depth(tmp_path: Path) -> None:
    whole, _ = TwinViews(around(tmp_path, TABLE, *THINGS)).compare(frame(), EYE, held_out=False, gap=None)
    less, _ = TwinViews(around(tmp_path, TABLE, THINGS[0])).compare(frame(), EYE, held_out=False, gap=None)
    for name in ("iou", "physics_iou"):
        assert getattr(less, name) < getattr(whole, name) - 0.1
    for name in ("part_l1_m", "physics_l1_m"):
        assert getattr(less, name) > getattr(whole, name) + 0.001


def test_a_plane_that_the_log_names_counts_in_the_maps_frame(tmp_path: Path) -> None:
    sought = around(tmp_path, TABLE, *THINGS)
    up = T_MAP_BASE[:3, 2]
    named = np.append(up, -float(up @ T_MAP_BASE[:3, 3]) - 0.02)  # 2 cm over the table
    given = surroundings(sought.model, tmp_path / "map.ply", T_MAP_BASE, panda(), named)
    assert sought.support is not None
    assert given.support is not None
    assert sought.support.offset == pytest.approx(0.0, abs=2e-3)
    assert given.support.offset == pytest.approx(0.02)
    table = next(obj for obj in TwinViews(given).world.scene.objects if obj.name == "map-table")
    (shape,) = table.shapes
    assert isinstance(shape, BoxGeom)
    assert table.at[2] + shape.size[2] / 2 == pytest.approx(0.02)


def test_masked_pixels_do_not_count(tmp_path: Path) -> None:
    views = TwinViews(around(tmp_path, TABLE, *THINGS))
    mask = np.ones((120, 160), np.bool_)
    mask[:, :60] = False
    spoiled = frame().rgb.copy(), frame().depth.copy()
    spoiled[0][~mask], spoiled[1][~mask] = 255, 0.3
    clean = Frame(0.0, frame().rgb, frame().depth, CAMERA, mask=mask)
    dirty = Frame(0.0, *spoiled, CAMERA, mask=mask)
    first, second = (views.compare(f, EYE, held_out=False, gap=None)[0] for f in (clean, dirty))
    assert first == second


def test_without_a_level_plane_silhouettes_are_not_made_up(tmp_path: Path) -> None:
    wall = Block((0.5, 0.0, 0.4), (0.02, 0.8, 0.8))
    found = around(tmp_path, wall)
    assert found.support is None
    view, seen = TwinViews(found).compare(frame(), EYE, held_out=False, gap=None)
    assert view.iou is None
    assert view.physics_iou is None
    assert seen.above is None


def test_overlap_is_intersection_over_union_where_it_counts() -> None:
    a = np.array([[True, True, False, True]])
    b = np.array([[True, False, True, True]])
    among = np.array([[True, True, True, False]])
    assert overlap(a, b, among) == pytest.approx(1 / 3)
    assert overlap(a & ~a, b & ~b, among) is None


def _tools(count: int, spacing: float) -> tuple[Array, Trajectory]:
    q = panda().home + np.linspace(0.0, 0.4, count)[:, None] * np.array([1.0, 0.3, 0, 0.5, 0, -0.4, 0.2])
    return q, Trajectory(spacing * np.arange(count, dtype=np.float64), panda().tcp(q))


def test_tool_poses_are_done_again_by_ik_to_a_tenth_of_a_millimetre() -> None:
    _, tool = _tools(4, 1.0)
    knots = find_knots(ArmRecord(tool), [*tool.stamps, np.nan], panda())  # the last frame could not be read
    assert knots is not None
    found = replay(knots, Twin(make_scene({"name": "bare"})))
    assert (found.source, found.poses, found.reached, found.slower) == (BY_IK, 4, 4, 1.0)
    assert [error.index for error in found.errors] == [1, 2, 3]
    assert max(error.position_m for error in found.errors) < 1e-4
    assert any("replaces the arm" in note for note in found.notes)


def test_a_tool_pose_that_is_recorded_wrong_is_seen_as_error(tmp_path: Path) -> None:
    """Recorded joints are followed, and their tool poses compared with the poses recorded next to them."""
    q, tool = _tools(31, 1 / 30)
    lines = [f"{t:.6f} " + " ".join(f"{x:.8f}" for x in row) for t, row in zip(tool.stamps, q, strict=True)]
    (tmp_path / "joints.txt").write_text("\n".join(lines) + "\n")
    shifted = tool.T_world_camera.copy()
    shifted[:, :3, 3] += [0.0, 0.005, 0.0]
    Trajectory(tool.stamps, shifted).save(tmp_path / "ee_poses.txt")
    record = read_arm(tmp_path)
    knots = find_knots(record, list(tool.stamps), panda())
    assert knots is not None
    found = replay(knots, Twin(make_scene({"name": "bare"})))
    assert found.source == RECORDED
    assert len(found.errors) == 30
    assert [error.position_m for error in found.errors] == pytest.approx([0.005] * 30, abs=2e-3)
    assert not any("replaces the arm" in note for note in found.notes)


def test_poses_beyond_the_arms_reach_are_counted_not_invented() -> None:
    far = np.tile(np.eye(4), (3, 1, 1))
    far[:, 0, 3] = [5.0, 5.1, 5.2]
    knots = find_knots(ArmRecord(Trajectory(np.arange(3.0), far)), [0.0, 1.0, 2.0], panda())
    assert knots is not None
    found = replay(knots, Twin(make_scene({"name": "bare"})))
    assert (found.poses, found.reached, found.errors) == (3, 0, ())
    assert "a replay needs two" in found.notes[0]


def test_a_log_without_an_arm_has_no_knots(tmp_path: Path) -> None:
    assert find_knots(read_arm(tmp_path), [0.0, 1.0], panda()) is None
    assert read_arm("synthetic:tabletop").source == ""


def test_the_mount_and_the_joint_offsets_come_from_one_scene(tmp_path: Path) -> None:
    """The camera's pose is that of the manufacturer's last link at the true positions, and the mount of that scene."""
    log, run = tmp_path / "log", tmp_path / "run"
    log.mkdir()
    run.mkdir()
    q, moved = panda().home, np.eye(4)
    moved[2, 3] = 0.05
    (log / "joints.txt").write_text("\n".join(" ".join(map(str, (0.02 * k, *q))) for k in range(50)))
    of_log = Workspace(T_link_camera=np.eye(4), joint_offsets=np.full(7, 0.02), offsets_of="panda")
    of_log.save(log / "scene.yaml")
    for scene, offset, mount in (
        (None, 0.02, np.eye(4)),
        (Workspace(T_world_base=np.eye(4)), 0.02, np.eye(4)),
        (Workspace(joint_offsets=np.full(7, 0.3), offsets_of="panda"), 0.02, np.eye(4)),
        (Workspace(T_link_camera=moved, joint_offsets=np.full(7, -0.03), offsets_of="panda"), -0.03, moved),
        (Workspace(T_link_camera=moved), 0.0, moved),
    ):
        if scene is not None:
            scene.save(run / "scene.yaml")
        record = read_arm(log, run)
        found = record.camera_at(0.5, robot_in_scene(panda(), record.workspace))
        assert found is not None
        np.testing.assert_allclose(found, panda().fk(q + offset)[-1] @ mount, atol=1e-9)


def test_a_mount_that_is_no_pose_is_named(tmp_path: Path) -> None:
    (tmp_path / "intrinsics.json").write_text(json.dumps({"ee_T_camera": (2 * np.eye(4)).tolist()}))
    with pytest.raises(FormatError, match="ee_T_camera"):
        read_arm(tmp_path)


def test_the_camera_follows_from_the_tool_and_its_mount() -> None:
    _, tool = _tools(3, 1.0)
    mount = inverse(EYE)
    record = ArmRecord(tool, mount)
    found = record.camera_at(1.004, panda())
    assert found is not None
    np.testing.assert_allclose(found, tool.T_world_camera[1] @ mount)
    assert record.camera_at(1.5, panda()) is None
