"""Parts of a pick in the twin of a map; the whole pick is in tests/unit/cli/test_plan_pick.py."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from splatbot.geometry import quat_to_rotation
from splatbot.grasping.pick_types import PickOutcome, PickResult, PickStage
from splatbot.planning.problem import link_words
from splatbot.protocols import Array
from splatbot.sim.contact_monitor import ContactEvent, MinimumClearance
from splatbot.sim.map_pick import CONSTANTS, TARGET, MapPick, _HeldStill, solid_shell
from splatbot.sim.recording import TwinRecording
from splatbot.sim.scene import make_scene
from splatbot.sim.twin import Twin


def surface_of_a_box(size: tuple[float, float, float]) -> tuple[Array, Array]:
    """Return points on the faces of a box about the origin, 3 mm apart, and their normals."""
    points, normals = [], []
    for axis in range(3):
        a, b = (k for k in range(3) if k != axis)
        steps = [np.linspace(-size[k] / 2, size[k] / 2, max(2, round(size[k] / 0.003))) for k in (a, b)]
        u, v = (grid.ravel() for grid in np.meshgrid(*steps))
        for side in (-1.0, 1.0):
            face = np.zeros((len(u), 3))
            face[:, a], face[:, b], face[:, axis] = u, v, side * size[axis] / 2
            points.append(face)
            normals.append(np.tile(side * np.eye(3)[axis], (len(u), 1)))
    return np.concatenate(points), np.concatenate(normals)


@pytest.mark.parametrize("size", [(0.10, 0.06, 0.04), (0.12, 0.08, 0.006)], ids=["box", "plate"])
def test_a_shell_follows_the_surface_and_reaches_inwards(size: tuple[float, float, float]) -> None:
    points, normals = surface_of_a_box(size)
    shell = solid_shell(points, normals)
    assert len(shell.centers) <= CONSTANTS.ellipsoids
    R = quat_to_rotation(shell.quats)
    own = np.einsum("eij,epi->epj", R, points[None] - shell.centers[:, None]) / shell.axes[:, None]
    nearest = np.linalg.norm(own, axis=2).min(axis=0)  # 1 on the surface of an ellipsoid
    assert np.percentile(nearest, 95) < 1.5
    reach = shell.centers[:, None] + R.transpose(0, 2, 1) * shell.axes[:, :, None]  # the ends of the half-axes
    reach = np.concatenate([reach, 2 * shell.centers[:, None] - reach], axis=1).reshape(-1, 3)
    assert (np.abs(reach) - np.array(size) / 2).max() < 4.5e-3  # beyond faces only at their edges
    inner = np.percentile(shell.axes.min(axis=1), 20)
    assert inner >= 0.8 * min(CONSTANTS.inward, min(size) / 2)


def test_a_target_stands_on_its_edge_until_it_is_released() -> None:
    box = {"kind": "box", "size": [0.06, 0.02, 0.10]}
    scene = make_scene({
        "name": "edge",
        "effects": {"forbid": ["sleep"]},
        "objects": [
            {"name": "table", "shapes": [{"kind": "plane"}]},
            {"name": TARGET, "shapes": [box], "at": [0.5, 0.0, 0.051], "rpy": [0.4, 0.0, 0.0], "movable": True},
        ],
    })  # fmt: skip
    twin = Twin(scene)
    held = _HeldStill(twin)
    twin.reset()
    body = twin.data.body(f"object/{TARGET}")
    before = body.xpos.copy()
    mujoco.mj_step(twin.world.model, twin.data, 500)
    np.testing.assert_allclose(body.xpos, before, atol=1e-4)
    held.release()
    mujoco.mj_step(twin.world.model, twin.data, 500)
    assert before[2] - body.xpos[2] > 0.02  # it lies


_TOUCH = ContactEvent("forearm", "map", 1.0, 1.2, 0.002, 3.0)


@pytest.mark.parametrize(
    ("outcome", "rose", "contacts", "verdict"),
    [
        (PickOutcome.PICKED, 0.15, (), "picked"),
        (PickOutcome.PICKED, 0.072, (), "not lifted"),
        (PickOutcome.PICKED, 0.15, (_TOUCH,), "touched"),
        (PickOutcome.NOTHING_HELD, 0.0, (), "nothing held"),
    ],
)
def test_the_outcome_is_picked_only_without_a_problem(
    outcome: PickOutcome, rose: float, contacts: tuple[ContactEvent, ...], verdict: str
) -> None:
    scene = make_scene({"name": "empty", "objects": [{"name": "table", "shapes": [{"kind": "plane"}]}]})
    result = PickResult(outcome, PickStage.CHECK, "", None, ())
    pick = MapPick(result, rose, 0.15, contacts, MinimumClearance(0.3, 0.0), TwinRecording(Twin(scene).world), ())
    assert pick.outcome == verdict
    assert bool(pick) == (verdict == "picked") == (not pick.problems)


def test_a_link_has_the_name_that_plans_give_it() -> None:
    pick = MapPick(
        PickResult(PickOutcome.PICKED, PickStage.CHECK, "", None, ()), 0.15, 0.15,
        (ContactEvent("link5", "map", 1.0, 1.2, 0.002, 3.0),), MinimumClearance(0.3, 0.0),
        TwinRecording(Twin(make_scene({"name": "arm"})).world), (),
    )  # fmt: skip
    assert pick.problems == (f"{link_words(5, 'panda_joint5')} touches map at 1.00 s, 2.0 mm deep",)
    assert pick.words("finger1") == "finger1"
