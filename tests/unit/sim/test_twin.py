"""The twin follows motions, reports contacts, and repeats runs exactly."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.robots.panda import panda
from splatbot.sim.motion import hold, motion_from_samples
from splatbot.sim.scene import Scene, load_scene, make_scene
from splatbot.sim.twin import Twin

pytest.importorskip("mujoco")


def _scene(**values: Any) -> Scene:
    return make_scene({"name": "test", **values})


def _box(name: str, at: tuple[float, float, float], **values: Any) -> dict[str, Any]:
    return {"name": name, "shapes": [{"kind": "box", "size": [0.06, 0.06, 0.06]}], "at": at, **values}


def test_it_follows_within_two_milliradians_and_a_millimetre() -> None:
    tracking = Twin(load_scene("empty")).follow().tracking
    assert tracking is not None
    assert tracking.largest < 2e-3
    assert tracking.tcp < 1e-3


def test_without_knowledge_of_gravity_the_arm_sags() -> None:
    """The sag is gravity's torque over the motor's stiffness."""
    twin = Twin(_scene(robot={"motors": {"feedforward": False}}))
    tracking = twin.follow(hold(panda().home, 1.0)).tracking
    follower = twin.follower
    assert tracking is not None
    assert follower is not None
    sag = float(np.abs(twin.data.qfrc_bias[:7] / twin.world.model.actuator_gainprm[:7, 0]).max())
    assert tracking.final == pytest.approx(sag, rel=0.02)


def test_the_same_seed_gives_the_same_bits_and_another_does_not() -> None:
    scene = load_scene("tabletop_clutter")
    twin = Twin(scene, seed=3)
    first = twin.follow().digest
    assert twin.follow().digest == first  # after a reset
    assert Twin(scene, seed=3).follow().digest == first
    assert Twin(scene, seed=4).follow().digest != first


def test_twins_in_four_threads_give_the_bits_of_one() -> None:
    scene = load_scene("mug_hanging")
    alone = Twin(scene).follow().digest
    found: list[str] = []
    threads = [threading.Thread(target=lambda: found.append(Twin(scene).follow().digest)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [alone] * 4


def test_a_wall_in_the_way_is_contacted_by_the_right_link_with_force() -> None:
    tcp = panda().tcp(panda().home)[:3, 3]
    wall = {"name": "wall", "shapes": [{"kind": "box", "size": [0.02, 1.0, 1.5]}], "at": [tcp[0] + 0.08, 0.0, 0.75]}
    moves = [{"t": 1.0, "tcp": [tcp[0] + 0.10, 0.0, tcp[2]]}]
    result = Twin(_scene(objects=[wall], task={"kind": "reach", "moves": moves})).follow()
    assert {contact.other for contact in result.contacts} == {"wall"}
    assert {contact.part for contact in result.contacts} <= {"finger1", "finger2", "link6", "link7"}
    assert max(contact.force for contact in result.contacts) > 5.0
    assert result.clearance.value < 0


def test_the_room_around_the_arm_is_the_distance_to_the_nearest_thing() -> None:
    """A sphere next to the hand: its centre's distance from the capsule's axis, minus both radii."""
    T = panda().fk(panda().home)[7]
    hand = panda().shapes[-1]
    middle = T[:3, :3] @ ((np.array(hand.start) + np.array(hand.end)) / 2) + T[:3, 3]  # type: ignore[attr-defined]
    side = T[:3, :3] @ np.cross([0, 0, 1.0], np.array(hand.end) - np.array(hand.start))  # type: ignore[attr-defined]
    at = middle - 0.15 * side / np.linalg.norm(side)
    ball = {"name": "ball", "shapes": [{"kind": "sphere", "radius": 0.03}], "at": at.tolist()}
    clearance = Twin(_scene(objects=[ball])).follow(hold(panda().home, 0.1)).clearance
    assert clearance.value == pytest.approx(0.15 - hand.radius - 0.03, abs=2e-3)  # type: ignore[attr-defined]
    assert (clearance.part, clearance.other) == ("link7", "ball")


def test_what_falls_off_an_edge_is_reported_and_what_lies_is_not() -> None:
    table = {"name": "table", "shapes": [{"kind": "box", "size": [0.5, 0.5, 0.4]}], "at": [0.5, 0.0, 0.2]}
    boxes = [_box("firm", (0.5, 0.0, 0.43), movable=True), _box("loose", (0.77, 0.1, 0.43), movable=True)]
    scene = _scene(robot=None, objects=[{"name": "floor", "shapes": [{"kind": "plane"}]}, table, *boxes])
    result = Twin(scene).follow()
    assert result.dropped == ("loose",)
    assert result.moved["firm"] < 1e-3


def test_it_stops_within_a_period_on_request_and_at_the_first_contact() -> None:
    twin = Twin(load_scene("empty"))
    stopped = twin.follow(progress=lambda share: twin.stop() if share >= 0.5 else None)
    assert stopped.stopped == pytest.approx(1.3, abs=0.05)
    stopped = Twin(load_scene("tabletop_clutter")).follow(until_contact=True)
    assert stopped.stopped == stopped.contacts[0].first


def test_a_motion_of_another_robot_is_refused() -> None:
    with pytest.raises(InputError, match="moves 3 joints; the robot has 7"):
        Twin(load_scene("empty")).follow(motion_from_samples([0.0, 1.0], np.zeros((2, 3))))


def test_the_base_stands_where_the_scene_says() -> None:
    twin = Twin(_scene(robot={"at": [0.3, -0.2, 0.1], "yaw": 0.7}))
    tcp = panda().tcp(panda().home)[:3, 3]
    c, s = np.cos(0.7), np.sin(0.7)
    expected = [0.3 + c * tcp[0] - s * tcp[1], -0.2 + s * tcp[0] + c * tcp[1], 0.1 + tcp[2]]
    np.testing.assert_allclose(twin.data.site("tcp").xpos, expected, atol=1e-9)


def test_the_first_link_may_stand_in_what_the_robot_stands_on() -> None:
    twin = Twin(load_scene("wiping").with_effects())
    assert twin.world.mounted == ()
    table = {"name": "table", "shapes": [{"kind": "box", "size": [0.6, 0.6, 0.22]}], "at": [0.0, 0.0, 0.11]}
    assert Twin(_scene(objects=[table])).world.mounted == (("link1", "table"),)


def test_steps_longer_than_the_controllers_period_slow_it_and_that_is_said() -> None:
    motion = hold(panda().home, 0.1)
    slow = Twin(_scene(), timestep=0.004).follow(motion)
    assert slow.rate == pytest.approx(250.0)
    assert any("the controller runs at 250 Hz, not at 1000" in text for text in slow.warnings)
    assert Twin(_scene(), timestep=0.0005).follow(motion).warnings == ()
