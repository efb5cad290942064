"""The viewer of the service, with its server and without a browser."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from splatbot.bench.tabletop import tabletop
from splatbot.gaussians import Snapshot
from splatbot.protocols import Array
from splatbot.robots.panda import panda
from splatbot.services.access import Access
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore
from splatbot.services.viewer.viewer import Viewer, _News
from splatbot.workspace import Workspace

OFFSETS = np.array([0.0, 0.03, -0.02, 0.04, 0.01, -0.03, 0.0])


@pytest.fixture
def viewer() -> Iterator[Viewer]:
    found = Viewer(MapStore(), Access(ServiceSettings()), port=0)
    yield found
    found.stop()


def make(viewer: Viewer, scene: Workspace) -> None:
    """Make the map again, with this scene, and show it."""
    if viewer._store.list():
        viewer._store.remove("lab")
    snapshot = Snapshot(tabletop().gaussians(200), 1)
    served = viewer._store.add("lab", source="a", state="static", snapshot=snapshot, workspace=scene)
    viewer._show(_News(served=served))


def nodes(viewer: Viewer) -> set[str]:
    """Return the first parts of the names of all drawn nodes."""
    return {name.split("/")[1] for name in viewer.server.scene._handle_from_node_name if "/" in name.rstrip("/")}


@pytest.mark.parametrize(
    ("offsets", "arm", "why"),
    [
        (np.full(6, 0.01), "ur5e", "are those of ur5e, not panda"),
        (np.full(7, 0.01), "iiwa14", "are those of iiwa14, not panda"),
        (np.array([0, 0, 0, 3.1, 0, 0, 0]), "panda", "more than its range"),
    ],
)
def test_a_map_of_another_arm_is_shown_without_a_robot_and_with_the_reason(
    viewer: Viewer, offsets: Array, arm: str, why: str
) -> None:
    make(viewer, Workspace(T_world_base=np.eye(4)))
    assert {"map", "robot"} <= nodes(viewer)
    make(viewer, Workspace(T_world_base=np.eye(4), joint_offsets=offsets, offsets_of=arm))
    assert "map" in nodes(viewer)
    assert "robot" not in nodes(viewer)
    assert why in viewer._state.content
    make(viewer, Workspace(T_world_base=np.eye(4)))
    assert "robot" in nodes(viewer)
    assert "no robot" not in viewer._state.content


def test_a_map_that_is_made_again_has_the_robot_of_its_new_scene(viewer: Viewer) -> None:
    moved, q = np.eye(4), panda().home
    moved[0, 3] = 0.2
    make(viewer, Workspace(T_world_base=np.eye(4)))
    make(viewer, Workspace(T_world_base=moved, joint_offsets=OFFSETS, offsets_of="panda"))
    assert viewer._arm is not None
    np.testing.assert_allclose(viewer._arm.forward(q)[0], moved @ panda().fk(q + OFFSETS), atol=1e-9)
    ends = [
        handle.position for name, handle in viewer.server.scene._handle_from_node_name.items() if "now/meshes" in name
    ]
    assert viewer._robot is not None
    expected = moved @ panda().fk(np.clip(q, viewer._robot.chain.lower, viewer._robot.chain.upper) + OFFSETS)
    assert min(np.linalg.norm(np.array(end) - expected[-1, :3, 3]) for end in ends) < 1e-6
