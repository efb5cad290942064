"""GraspPlanning on a map of a block on a table."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.geometry import rotation_to_quat
from splatbot.services.ros.graph import RosGraph
from splatbot.services.ros.grasping import GRASP_SERVICE, GraspServices
from splatbot.services.ros.publishers import GRASP_MARKERS, RosPublishers
from splatbot.services.ros.wire import to_json
from splatbot.services.store import MapStore
from splatbot.workspace import Workspace
from tests.waiting import until

STEP = 0.004
CENTRE, HALF = np.array([0.5, 0.05, 0.04]), np.array([0.02, 0.03, 0.04])


def _face(centre: Any, half: Any, axis: int) -> tuple[Any, Any]:
    """Return means (N, 3) of a flat rectangle across an axis, and the quaternion of discs that lie in it."""
    u, v = (i for i in range(3) if i != axis)
    a, b = (np.arange(-half[i], half[i] + 1e-9, STEP) for i in (u, v))
    grid = np.stack(np.meshgrid(a, b), -1).reshape(-1, 2)
    means = np.tile(np.asarray(centre, float), (len(grid), 1))
    means[:, [u, v]] += grid
    R = np.eye(3)[:, [u, v, axis]] if axis != 1 else np.eye(3)[:, [v, u, axis]]
    return means, rotation_to_quat(R)


def _block_on_a_table() -> GaussianModel:
    parts = [(*_face([0.5, 0.0, 0.0], [0.25, 0.25, 0.0], 2), [0.5, 0.5, 0.5])]
    for axis in range(3):
        for side in (-1, 1):
            centre = CENTRE + side * HALF * np.eye(3)[axis]
            if centre[2] > 0.001:
                parts.append((*_face(centre, HALF, axis), [0.9, 0.1, 0.1]))
    means = np.concatenate([m for m, _, _ in parts])
    return GaussianModel.from_activated(
        means=means,
        quats=np.concatenate([np.tile(q, (len(m), 1)) for m, q, _ in parts]),
        scales=np.tile([STEP / 2, STEP / 2, 0.0004], (len(means), 1)),
        opacities=np.full(len(means), 0.95),
        colors=np.concatenate([np.tile(c, (len(m), 1)) for m, _, c in parts]),
    )


@pytest.fixture(scope="module")
def graph() -> Iterator[RosGraph]:
    graph, store = RosGraph(), MapStore()
    workspace = Workspace(
        T_world_base=np.eye(4),
        support_plane=np.array([0.0, 0.0, 1.0, 0.0]),
        box=np.array([[0.25, -0.25, -0.02], [0.75, 0.25, 0.4]]),
    )
    snapshot = Snapshot(_block_on_a_table(), 1, 2.0)
    store.add("desk", source="a", state="static", snapshot=snapshot, workspace=workspace)
    GraspServices(graph, store)
    outlets = RosPublishers(store.bus, graph)
    outlets.start()
    yield graph
    outlets.stop()


def _ask(graph: RosGraph, target: dict[str, Any]) -> dict[str, Any]:
    call = graph.service(GRASP_SERVICE).call
    return dict(json.loads(to_json(call(json.loads(json.dumps({"target": target}))))))


def test_grasps_of_the_block_hold_it_from_both_sides_best_first(graph: RosGraph) -> None:
    top = {"x": 0.5, "y": 0.05, "z": 0.08}
    answer = _ask(graph, {"pose": {"position": top}})
    assert answer["error_code"]["val"] == 1, answer["error_code"]
    grasps = answer["grasps"]
    assert len(grasps) >= 1
    qualities = [g["grasp_quality"] for g in grasps]
    assert qualities == sorted(qualities, reverse=True)
    for grasp in grasps:
        at = np.array([grasp["grasp_pose"]["pose"]["position"][a] for a in "xyz"])
        assert (np.abs(at - CENTRE) <= HALF + 0.02).all()
        closed = sum(grasp["grasp_posture"]["points"][0]["positions"])
        assert 0.03 < closed < 0.09
        assert sum(grasp["pre_grasp_posture"]["points"][0]["positions"]) >= closed
        assert grasp["grasp_pose"]["header"]["frame_id"] == "map"
        assert len(grasp["joint_state"]["position"]) == 7
    until(lambda: graph.latched(GRASP_MARKERS) is not None)
    told = graph.latched(GRASP_MARKERS)
    assert told is not None
    assert len(told.message.markers) == len(grasps)


def test_where_nothing_is_the_code_says_failure_and_the_message_why(graph: RosGraph) -> None:
    answer = _ask(graph, {"pose": {"position": {"x": 0.5, "y": -0.1, "z": 0.3}}})
    assert answer["grasps"] == []
    assert answer["error_code"]["val"] != 1
    assert answer["error_code"]["message"]
