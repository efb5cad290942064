"""Structure: pieces of walls and posts, and objects of which no view sees the whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatbot.bench.tabletop import Block
from splatbot.camera import Camera
from splatbot.collision.visibility import DepthView
from splatbot.gaussians import Snapshot
from splatbot.geometry import look_at
from splatbot.grasping.affordance import AffordanceError, NameHint
from splatbot.grasping.language import LanguageAffordance
from splatbot.grasping.object_list import list_objects
from splatbot.grasping.structure import find_structures
from splatbot.protocols import Array
from splatbot.rasterize.views import render_view
from splatbot.robots.graspable_objects import MeasuredMap, segment_objects
from splatbot.robots.panda import panda
from splatbot.segmentation import SegmentedMap, segment
from splatbot.workspace import NamedPlace, Workspace
from tests.unit.grasping.objects import BOX, OBJECTS, colored, target_of

_WALL = Block((0.8, 0.0, 0.15), (0.005, 0.6, 0.3))  # 60 cm of it, of which the box of the workspace has 25 cm
_WORKSPACE = np.array([[0.2, -0.1, -0.1], [1.2, 0.15, 0.8]])


def _with_wall(names: tuple[NamedPlace, ...] = ()) -> SegmentedMap:
    model = colored({"box": BOX, "wall": _WALL}, 40_000, {"box": (0.8, 0.1, 0.1)})
    return segment(model, np.eye(4), box=_WORKSPACE, names=names)


def _view(scene: SegmentedMap, eye: Array, at: Array, focal: float = 300.0) -> DepthView:
    camera = Camera(focal, focal, 159.5, 119.5, 320, 240)
    T = look_at(eye, at)
    return render_view(scene.model, camera, T, "depth"), camera, T


def test_a_piece_of_a_wall_is_structure_and_the_box_in_front_of_it_is_an_object() -> None:
    scene = _with_wall()
    wall, box = target_of(scene, _WALL, "wall").number, target_of(scene, BOX, "box").number
    assert max(scene.objects[wall].size) < 0.31
    assert list(find_structures(scene)) == [wall]
    assert "continues in other surface" in find_structures(scene)[wall]
    assert scene.labels[scene.objects[box].rows].tolist() == [box] * len(scene.objects[box].rows)


@pytest.mark.parametrize(("length", "is_structure"), [(0.28, False), (0.33, True)])
def test_a_piece_longer_than_30_cm_is_structure(length: float, is_structure: bool) -> None:
    bar = Block((0.5, 0.0, 0.03), (0.05, length, 0.06))
    scene = segment(colored({"bar": bar}, 24_000, {}), np.eye(4))
    assert len(scene.objects) == 1
    assert bool(find_structures(scene)) == is_structure


def test_an_object_that_each_view_cuts_is_structure_until_one_view_sees_all_of_it() -> None:
    scene = segment(colored({"box": BOX}, 24_000, {}), np.eye(4))
    eye, at = np.array([-0.2, 0.3, 0.5]), np.array(BOX.center)
    beyond = at + np.array([0.0, -0.2, 0.0])  # the box is at the left edge of the image
    cut, whole = _view(scene, eye, beyond, 600.0), _view(scene, eye, at)
    elsewhere = _view(scene, eye, at + np.array([0.0, -1.0, 0.0]))
    assert find_structures(scene, [cut, cut]) == {0: "cut by the edge of each view of it"}
    assert find_structures(scene, [cut, whole]) == {}
    assert find_structures(scene, [whole]) == {}
    assert find_structures(scene, [elsewhere]) == {}  # no view sees it, so that nothing is known
    hidden = (np.full_like(cut[0], 0.1), *cut[1:])
    assert find_structures(scene, [hidden]) == {}


def test_a_fragment_of_an_object_that_belongs_to_no_object_makes_it_no_structure() -> None:
    scene = segment(colored({"box": BOX}, 24_000, {}), np.eye(4))
    (box,) = scene.objects
    lid = box.rows[scene.points[box.rows, 2] > BOX.center[2] + BOX.size[2] / 2 - 0.03]
    labels = scene.labels.copy()
    labels[lid] = -1  # as of a gap in the map
    split = replace(scene, labels=labels, objects=(replace(box, rows=np.setdiff1d(box.rows, lid)),))
    assert len(lid) > 0.2 * len(box.rows)
    assert find_structures(split) == {}


def test_solid_objects_on_a_table_are_no_structure() -> None:
    assert find_structures(segment(colored(OBJECTS, 24_000, {}), np.eye(4))) == {}


def test_words_take_no_structure_and_a_label_does() -> None:
    scene = _with_wall()
    wall, box = target_of(scene, _WALL, "wall").number, target_of(scene, BOX, "box").number
    find = LanguageAffordance().locate
    assert find(NameHint("widest box"), scene).number == wall  # as long as it counts as an object
    known = replace(scene, structures=find_structures(scene))
    assert find(NameHint("widest box"), known).number == box
    for label in (f"structure {wall}", f"object {wall}"):
        assert find(NameHint(label), known).number == wall
    alone = replace(scene, structures=dict.fromkeys(range(len(scene.objects)), "cut"))
    with pytest.raises(AffordanceError, match="fits none"):
        find(NameHint("widest box"), alone)


def test_the_list_keeps_the_numbers_and_offers_no_structure() -> None:
    scene = _with_wall()
    wall = target_of(scene, _WALL, "wall").number
    found = list_objects(replace(scene, structures=find_structures(scene)), panda())
    assert [item.number for item in found] == [item.number for item in scene.objects]
    values = found[wall].to_dict()
    assert (values["kind"], values["label"], values["target"]) == ("structure", f"structure {wall}", None)
    assert (values["verdict"], values["reach"]) == ("structure", None)
    assert "continues in other surface" in values["obstacle"]
    (box,) = (item.to_dict() for item in found if item.number != wall)
    assert (box["kind"], box["target"]) == ("object", f"object {box['number']}")


def test_a_name_in_the_scene_file_makes_a_piece_an_object() -> None:
    place = NamedPlace("door", np.array([0.79, 0.0, 0.2]))
    assert find_structures(_with_wall((place,))) == {}


def test_the_segmentation_of_commands_and_service_knows_the_structure() -> None:
    scene = _with_wall()
    known = Workspace(T_world_base=np.eye(4), box=_WORKSPACE)
    objects = segment_objects(MeasuredMap(Snapshot(scene.model, 0)), np.eye(4), known, as_known=True)
    assert objects.scene.structures == find_structures(scene)
    assert len(objects.scene.structures) == 1
