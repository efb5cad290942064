"""Objects that MoveIt attaches, and the spheres that cover them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from splatbot.errors import InputError
from splatbot.logs.ros_transforms import StampedTransform
from splatbot.logs.ros_types import Message, build, from_cdr, to_cdr
from splatbot.robots.tf_buffer import TransformBuffer
from splatbot.services.ros.attached import MAX_SOLIDS, AttachedObjects
from splatbot.services.ros.moveit_types import ATTACHED_TYPE, SCENE_TYPE, register_moveit_types

Array = NDArray[np.float64]
ADD, REMOVE, APPEND = 0, 1, 2
BOX, SPHERE, CYLINDER, CONE, PRISM = 1, 2, 3, 4, 5
CUBE = {"type": BOX, "dimensions": [0.1, 0.1, 0.1]}

register_moveit_types()


def pose(at: Any = (0.0, 0.0, 0.0), xyzw: Any = (0.0, 0.0, 0.0, 1.0)) -> dict[str, Any]:
    return {
        "position": dict(zip("xyz", map(float, at), strict=True)),
        "orientation": dict(zip("xyzw", map(float, xyzw), strict=True)),
    }


def attached(name: str = "cup", link: str = "hand", operation: int = ADD, *, frame: str = "", **fields: Any) -> Message:
    values = {"id": name, "operation": operation, "header": {"frame_id": frame}, **fields}
    return build(ATTACHED_TYPE, link_name=link, object=values)


def surface(kind: int, size: list[float], rng: np.random.Generator, count: int = 4000) -> Array:
    """Sample points on a shape as shape_msgs defines it, in its own frame."""
    turn, u = rng.uniform(0, 2 * np.pi, count), rng.uniform(0, 1, count)
    around = np.stack([np.cos(turn), np.sin(turn)], 1)
    if kind == BOX:
        points = rng.uniform(-0.5, 0.5, (count, 3))
        points[np.arange(count), rng.integers(0, 3, count)] = rng.choice([-0.5, 0.5], count)
        return points * size
    if kind == SPHERE:
        points = rng.normal(size=(count, 3))
        return size[0] * points / np.linalg.norm(points, axis=1, keepdims=True)
    height, radius = size
    on_base = rng.random(count) < 0.3
    share = np.where(on_base, 0.0, u)  # of the height
    if kind == CYLINDER:
        wide = np.where(on_base, np.sqrt(u), 1.0)
        share = np.where(on_base, rng.integers(0, 2, count), share)
    else:
        wide = np.where(on_base, np.sqrt(u), 1.0 - u)
    return np.c_[radius * wide[:, None] * around, (share - 0.5) * height]


@pytest.mark.parametrize("most", [1, 5, 16, 64])
@pytest.mark.parametrize(
    ("kind", "size"),
    [
        (BOX, [0.1, 0.1, 0.1]),
        (BOX, [0.3, 0.02, 0.001]),
        (SPHERE, [0.04]),
        (CYLINDER, [0.12, 0.035]),
        (CYLINDER, [0.01, 0.2]),
        (CYLINDER, [0.5, 0.004]),
        (CONE, [0.12, 0.05]),
        (CONE, [0.02, 0.15]),
    ],
)
def test_spheres_cover_each_primitive_wherever_it_is(kind: int, size: list[float], most: int) -> None:
    rng = np.random.default_rng(kind * 100 + most)
    turn_object, turn_solid = Rotation.random(2, random_state=most)
    at_object, at_solid = rng.uniform(-0.2, 0.2, (2, 3))
    known = AttachedObjects(TransformBuffer())
    known.take_object(
        attached(
            pose=pose(at_object, turn_object.as_quat()),
            primitives=[{"type": kind, "dimensions": size}],
            primitive_poses=[pose(at_solid, turn_solid.as_quat())],
        )
    )
    (solid,) = known.objects["cup"].solids
    spheres = solid.spheres(most)
    assert 1 <= len(spheres) <= most
    points = turn_object.apply(turn_solid.apply(surface(kind, size, rng)) + at_solid) + at_object
    depth = spheres[:, 3] - np.linalg.norm(points[:, None] - spheres[:, :3], axis=2)
    assert depth.max(axis=1).min() >= -1e-9
    extent = np.linalg.norm(points - points.mean(axis=0), axis=1).max()
    assert spheres[:, 3].max() <= 2.0 * extent
    if kind == BOX and most == 64 and size[0] == size[1]:
        assert spheres[:, 3].max() == pytest.approx(0.0125 * np.sqrt(3))  # 4 x 4 x 4 cells of 25 mm


def test_a_mesh_is_covered_with_all_its_triangles() -> None:
    rng = np.random.default_rng(5)
    vertices = rng.uniform([-0.05, 0.1, -0.01], [0.15, 0.2, 0.0], (30, 3))
    triangles = rng.integers(0, 30, (40, 3)).astype(np.uint32)
    mesh = {
        "vertices": [dict(zip("xyz", v, strict=True)) for v in vertices.tolist()],
        "triangles": [{"vertex_indices": t} for t in triangles],
    }
    known = AttachedObjects(TransformBuffer())
    known.take_object(attached(meshes=[mesh]))  # without poses: in the object's frame
    spheres = known.objects["cup"].solids[0].spheres(16)
    weights = rng.dirichlet(np.ones(3), (40, 200))
    points = np.einsum("tpk,tkj->tpj", weights, vertices[triangles]).reshape(-1, 3)
    depth = spheres[:, 3] - np.linalg.norm(points[:, None] - spheres[:, :3], axis=2)
    assert depth.max(axis=1).min() >= -1e-9


def test_objects_are_added_replaced_appended_to_and_removed() -> None:
    known = AttachedObjects(TransformBuffer())

    def counts() -> dict[str, int]:
        return {name: len(one.solids) for name, one in known.objects.items()}

    known.take_object(attached("cup", primitives=[CUBE]))
    known.take_object(attached("cup", primitives=[CUBE, CUBE]))
    known.take_object(attached("cup", operation=APPEND, primitives=[CUBE]))
    known.take_object(attached("pen", operation=APPEND, primitives=[CUBE]))
    known.take_object(attached("lamp", "elbow", primitives=[CUBE]))
    assert counts() == {"cup": 3, "pen": 1, "lamp": 1}
    known.take_object(attached("cup", operation=REMOVE))
    known.take_object(attached("unknown", operation=REMOVE))
    assert counts() == {"pen": 1, "lamp": 1}
    known.take_object(attached("", "hand", REMOVE))
    assert counts() == {"lamp": 1}
    known.take_object(attached("", "", REMOVE))
    assert counts() == {}


def test_a_planning_scene_replaces_the_objects_and_a_difference_changes_them() -> None:
    known = AttachedObjects(TransformBuffer())

    def scene(*objects: Message, is_diff: bool) -> Message:
        state = {"attached_collision_objects": list(objects), "is_diff": is_diff}
        return from_cdr(to_cdr(build(SCENE_TYPE, robot_state=state, is_diff=is_diff)), SCENE_TYPE)

    known.take_scene(scene(attached("cup", primitives=[CUBE]), is_diff=True))
    known.take_scene(scene(attached("pen", primitives=[CUBE]), is_diff=True))
    assert set(known.objects) == {"cup", "pen"}
    known.take_scene(scene(attached("cup", operation=REMOVE), is_diff=True))
    assert set(known.objects) == {"pen"}
    known.take_scene(scene(is_diff=True))
    assert set(known.objects) == {"pen"}
    bad = attached("bad", primitives=[{"type": PRISM, "dimensions": [0.1]}])
    with pytest.raises(InputError, match="type 5"):  # the others of the scene count
        known.take_scene(scene(bad, attached("jar", primitives=[CUBE]), is_diff=False))
    assert set(known.objects) == {"jar"}
    known.take_scene(scene(is_diff=False))
    assert known.objects == {}


def test_poses_in_another_frame_are_placed_by_tf() -> None:
    transforms = TransformBuffer()
    known = AttachedObjects(transforms)
    with pytest.raises(InputError, match="world, which TF does not connect with hand"):
        known.take_object(attached(frame="world", primitives=[CUBE]))
    transforms.add([StampedTransform("world", "hand", 1.0, np.array([50.0, 2.0, 3.0]), np.array([1.0, 0, 0, 0]))])
    known.take_object(attached(frame="/world", pose=pose((50.0, 2.0, 3.2)), primitives=[CUBE]))
    np.testing.assert_allclose(known.objects["cup"].solids[0].T_link_solid[:3, 3], [0, 0, 0.2], atol=1e-9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: attached(primitives=[{"type": PRISM, "dimensions": [0.1]}]), "type 5"),
        (lambda: attached(primitives=[{"type": BOX, "dimensions": [0.1, 0.1]}]), "0.1, 0.1"),
        (lambda: attached(primitives=[{"type": BOX, "dimensions": [0.1, 0.1, np.nan]}]), "nan"),
        (lambda: attached(primitives=[{"type": SPHERE, "dimensions": [1e9]}]), "1000000000"),
        (lambda: attached(primitives=[{"type": SPHERE, "dimensions": [-0.1]}]), "-0.1"),
        (lambda: attached(primitives=[CUBE], pose=pose((np.inf, 0, 0))), "not finite"),
        (lambda: attached(primitives=[CUBE], pose=pose((50.0, 0, 0))), "5 m from its link"),
        (lambda: attached(primitives=[CUBE], primitive_poses=[pose(xyzw=(0, 0, 0, np.nan))]), "not finite"),
        (lambda: attached(primitives=[CUBE] * (MAX_SOLIDS + 1)), "are 65"),
        (lambda: attached(meshes=[{"vertices": [{"x": 1e300}, {"x": -1e300}]}]), "too far"),
        (lambda: attached(meshes=[{"vertices": []}]), "are 0"),
        (lambda: attached(planes=[{"coef": [0, 0, 1, 0]}], primitives=[CUBE]), "infinite"),
        (lambda: attached(), "empty"),
        (lambda: attached(operation=3, primitives=[CUBE]), "is 3"),
        (lambda: attached("", primitives=[CUBE]), "is empty"),
        (lambda: attached(link="", primitives=[CUBE]), "is empty"),
        (lambda: attached(link="elbow", operation=APPEND, primitives=[CUBE]), "is elbow"),
    ],
)
def test_shapes_that_cannot_be_covered_are_refused_and_the_attached_ones_remain(
    make: Callable[[], Message], message: str
) -> None:
    known = AttachedObjects(TransformBuffer())
    known.take_object(attached(primitives=[CUBE]))
    version = known.version
    with pytest.raises(InputError, match=message):
        known.take_object(make())
    assert known.version == version
    assert len(known.objects["cup"].solids) == 1
