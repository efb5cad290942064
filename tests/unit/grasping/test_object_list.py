"""The list of objects, names that a flat patch does not get, and the first change after a failed search."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatbot.bench.tabletop import Block
from splatbot.gaussians import Snapshot
from splatbot.grasping.advice import first_change
from splatbot.grasping.affordance import NameHint, Target
from splatbot.grasping.language import LanguageAffordance
from splatbot.grasping.object_list import list_objects, list_planes, obstacle
from splatbot.grasping.types import GraspResult
from splatbot.robots.graspable_objects import GraspableObjects, MeasuredMap
from splatbot.robots.panda import panda
from splatbot.robots.store import load_robot
from splatbot.segmentation import segment
from tests.unit.grasping.objects import BOX, OBJECTS, TABLE, colored, model, scene, target_of


def test_each_object_of_the_list_can_be_named_as_a_target() -> None:
    found = list_objects(scene(), panda())
    assert len({item.label for item in found}) == len(found) == len(scene().objects)
    for item in found:
        target = LanguageAffordance().locate(NameHint(item.label), scene())
        assert (target.number, target.score) == (item.number, 1.0)
    for item in found:
        target = LanguageAffordance().locate(NameHint(f"object {item.number}"), scene())
        assert target.number == item.number
        assert item.to_dict()["target"] == f"object {item.number}"
    red = target_of(scene(), BOX, "box").number
    assert found[red].label.startswith("red box")
    np.testing.assert_allclose(sorted(found[red].size), sorted(BOX.size), atol=0.01)


def test_an_object_beyond_the_arm_is_listed_with_its_distance() -> None:
    near = scene()
    T = near.T_world_base.copy()
    T[:3, 3] -= [2.0, 0.0, 0.0]  # the base two metres farther back
    found = list_objects(replace(near, T_world_base=T), panda())
    fitting = [item for item in found if item.fits]
    assert fitting
    assert all("from the first joint, and the arm reaches" in item.to_dict()["obstacle"] for item in fitting)
    assert {item.to_dict()["verdict"] for item in fitting} == {"too far"}
    assert {item.reach for item in list_objects(near, panda())} == {"yes"}


def test_reach_is_that_of_postures_and_not_of_the_size() -> None:
    near = scene()
    for item in list_objects(near, panda()):
        assert item.reach == "yes"
        assert item.fits == (item.to_dict()["verdict"] == "fits")
    T = near.T_world_base.copy()
    T[0, 3] -= (
        0.5  # the middle of an object is 1.0 m away: nearer than all links in line, but too far for a turned hand
    )
    far = list_objects(replace(near, T_world_base=T), panda())
    assert {item.reach for item in far} == {"no pose", "too far"}
    assert [item.fits for item in far] == [item.fits for item in list_objects(near, panda())]
    assert all(item.reach is None for item in list_objects(near, load_robot("ur5e")))  # it has no hand


def test_an_object_that_only_an_arm_through_the_table_reaches_is_in_collision() -> None:
    under = np.eye(4)
    under[:3, 3] = [0.5, 0.0, -0.75]  # below the middle of the table
    arm, shoulder = panda(), np.array([0.5, 0.0, -0.75 + 0.333])
    (x, y, _), (wide, deep, _) = TABLE.center, TABLE.size
    along = np.linspace(-0.5, 0.5, 201)
    edge = np.concatenate(
        [
            [(x + s * wide, y + side * deep, 0.0), (x + side * wide, y + s * deep, 0.0)]
            for s in along
            for side in (-0.5, 0.5)
        ]
    )
    around = list_objects(segment(model(), under), arm)
    for item in around:
        by_the_edge = np.linalg.norm(edge - shoulder, axis=1) + np.linalg.norm(edge - item.at_world, axis=1)
        straight = np.linalg.norm(item.at_world - shoulder)
        assert straight < 0.7
        if by_the_edge.min() > arm.chain.reach(arm.T_link_tcp):
            assert item.reach == "blocked"
            assert item.of_arm is not None
            assert "deep in the map" in item.of_arm.reason
    assert sum(item.reach == "blocked" for item in around) >= 2


@pytest.mark.parametrize("robot", ["panda", "ur5e-2f85"])
def test_a_low_object_on_the_table_is_within_reach(robot: str) -> None:
    """The fingers of a hand at its centre would be in the table; a grasp is a little higher."""
    low = Block((0.45, 0.10, 0.010), (0.10, 0.05, 0.020), 0.4)
    (item,) = list_objects(segment(colored({"low": low}, 24_000, {}), np.eye(4)), load_robot(robot), margin=0.01)
    assert item.reach == "yes"


def test_the_links_before_the_hand_keep_the_margin() -> None:
    (tool,) = {item.at_base[2] for item in list_objects(scene(), panda()) if item.label.startswith("red box")}
    assert tool + 0.11 < 0.3  # the flange is 103 mm from the tool, and so less than 0.3 m above the table
    found = list_objects(scene(), panda(), margin=0.3)
    assert {item.reach for item in found} == {"blocked"}
    assert all("or its 300.0 mm margin" in item.of_arm.reason for item in found if item.of_arm)


def test_the_plane_of_the_scene_file_is_an_obstacle_where_no_frame_saw_it() -> None:
    above = np.eye(4)
    above[:3, 3] = [0.0, 0.0, 0.3]
    objects = GraspableObjects(MeasuredMap(Snapshot(model(), 0)), segment(model(), above))
    without = objects.listed(panda(), margin=0.0, plane=None)
    assert {item.reach for item in without} == {"yes"}
    with_plane = objects.listed(panda(), margin=0.0, plane=[0.0, 0.0, 1.0, -0.28])  # 2 cm below the base
    assert {item.reach for item in with_plane} == {"blocked"}


def test_planes_name_height_and_size() -> None:
    (plane, *_) = list_planes(scene())
    assert plane["label"] == "support"
    assert abs(plane["height_base_m"]) < 0.01
    assert min(plane["size_m"]) > 0.1


def test_what_is_wider_than_the_hand_or_flat_is_not_offered() -> None:
    item = scene().objects[0]
    cube = replace(item, size=np.array([0.086, 0.085, 0.085]))
    for stroke in (0.08, 0.085, 0.0885):  # the hand needs 2 mm at each pad
        wide = obstacle(cube, stroke)
        assert wide is not None
        assert wide.verdict == "too wide"
        assert f"85 mm apart, and the hand opens {1e3 * stroke:.0f} mm" in wide.reason
    assert obstacle(cube, 0.0895) is None
    flat = obstacle(replace(item, size=np.array([0.2, 0.05, 0.004])), 0.08)
    assert flat is not None
    assert flat.verdict == "too flat"
    none = obstacle(cube, 0.0)
    assert none is not None
    assert none.verdict == "no hand"


def test_what_hangs_in_the_air_is_told_from_what_stands() -> None:
    found = list_objects(scene(), panda())
    assert all(item.on_support for item in found)
    above = scene().model.clone()
    above.means[scene().objects[0].rows, 2] += 0.1
    lifted = list_objects(replace(scene(), model=above), panda())
    assert [item.on_support for item in lifted] == [item.number != 0 for item in found]


def test_a_search_of_few_samples_is_to_be_raised_before_anything_else_is_changed() -> None:
    target = Target(scene().objects[0].rows, None, "box", "rules", 1.0)
    result = GraspResult(target, (), {"hands are in the target on their way": 9}, None, 9, {}, 0)
    reason, change = first_change(result, scene(), 0.08, samples=5)
    assert "5 sampled points" in reason
    assert change == "raise --samples, to 400 or more"
    assert "--approach" in first_change(result, scene(), 0.08, samples=400)[1]


def test_flat_patches_are_no_mugs() -> None:
    patches = tuple(replace(o, size=np.array([0.09, 0.08, 0.005]), name="") for o in scene().objects)
    flat = replace(scene(), objects=patches, names=())
    with pytest.raises(Exception, match="fits none"):
        LanguageAffordance().locate(NameHint("mug"), flat)


@pytest.mark.parametrize(
    ("rejected", "why"),
    [
        ({"no posture reaches": 5, "hands touch the surroundings of the target": 2}, "does not reach"),
        ({"hands touch the surroundings of the target": 9}, "around it"),
        ({"closing directions meet nothing on the other side": 9}, "opposite faces"),
    ],
)
def test_a_failed_search_names_one_change(rejected: dict[str, int], why: str) -> None:
    small = target_of(scene(), OBJECTS["box"], "box").number
    target = Target(scene().objects[small].rows, None, "box", "rules", 1.0, (), small)
    result = GraspResult(target, (), rejected, None, 9, {}, 1)
    reason, change = first_change(result, scene(), 0.08)
    assert why in reason
    assert change
