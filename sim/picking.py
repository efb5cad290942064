"""A pick in the twin: the scene is scanned, and all later stages use only that map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from splatbot.errors import InputError
from splatbot.geometry import quat_multiply
from splatbot.grasping.affordance import Affordance, NameHint, Target, find_target
from splatbot.grasping.pick import Picker
from splatbot.grasping.pick_types import PickOptions, PickResult, PickStep
from splatbot.grasping.sampler import GraspSampler
from splatbot.segmentation import SegmentedMap, segment
from splatbot.sim.controller import TwinController
from splatbot.sim.motion import base_of
from splatbot.sim.scan import scan
from splatbot.sim.twin import Twin
from splatbot.sim.wrist_camera import TwinWristCamera
from splatbot.workspace import NamedPlace

MOST_MOVED = 0.1
"""Largest push of a target [m]; it may not reach its neighbours."""


@dataclass(frozen=True, eq=False)
class TwinPick:
    """Result of a simulated pick.

    Args:
        result: of the pick.
        target: the object that matched the name.
        rose: height by which each movable object rose in the simulation [m].
    """

    result: PickResult
    target: Target
    rose: dict[str, float]

    def summary(self) -> dict[str, Any]:
        """Return the result as values for JSON."""
        result, grasp = self.result, self.result.grasp
        return {
            "outcome": result.outcome,
            "stage": result.stage,
            "reason": result.reason,
            "target": {"label": self.target.label, "backend": self.target.backend, "score": self.target.score},
            "steps": [{"stage": s.stage, "seconds": s.seconds, "note": s.note} for s in result.steps],
            "grasp": None
            if grasp is None
            else {
                "T_world_tcp": grasp.T_world_tcp.tolist(),
                "width_m": grasp.width,
                "approach": grasp.approach,
                "total": grasp.total,
            },
            "opening_m": result.opening,
            "attempts": result.attempts,
            "shift_m": result.shift,
            "rose_m": self.rose,
        }


def pick_in_twin(
    twin: Twin,
    target: str,
    backends: Sequence[Affordance],
    options: PickOptions,
    *,
    views: int = 8,
    margin: float = 0.0,
    home: bool = False,
    look: bool = True,
    moved: float = 0.0,
    seed: int = 0,
    stop: Callable[[], bool] | None = None,
    on_step: Callable[[PickStep], None] | None = None,
) -> TwinPick:
    """Scan the twin's scene, find the named object, and pick it.

    Args:
        twin: with an arm that has fingers.
        target: a name of the scene, or words.
        backends: affordance detectors, tried in order.
        options: of the pick.
        views: number of views of the scan.
        margin: clearance [m] that hand and arm keep from the map.
        home: carry the object to the arm's initial configuration.
        look: look again from the wrist before the fingers close and after the lift.
        moved: distance [m] by which the target is pushed aside after the scan, as by a person.
        seed: of the scan's noise.
        stop: polled continuously; True ends the pick.
        on_step: called after each stage.

    Raises:
        InputError: the scene has no arm with fingers, or the name matches no object or more than one.
    """
    controller, robot = TwinController(twin), twin.world.robot
    if controller.gripper is None or robot is None:
        hint = "give the scene a robot with a gripper, as panda"
        raise InputError("has no fingers.", field=twin.scene.name, hint=hint)
    known = scanned(twin, views, seed)
    found = find_target(NameHint(target), known, backends)
    before = _heights(twin)
    if moved > 0.0:
        push_aside(twin, _nearest(twin, known, found), moved, seed)
    if home:
        options = replace(options, carry_to=tuple(controller.position.tolist()))
    sampler = GraspSampler(known, robot, margin=margin)
    camera = TwinWristCamera(twin, seed=seed) if look else None
    picker = Picker(sampler, controller, controller.gripper, options=options, stop=stop, on_step=on_step, camera=camera)
    result = picker.pick(found)
    return TwinPick(result, found, {name: height - before[name] for name, height in _heights(twin).items()})


def scanned(twin: Twin, views: int, seed: int) -> SegmentedMap:
    """Scan the twin and segment the map, with the names of the scene's objects."""
    movable = [obj.name for obj in twin.scene.objects if obj.movable]
    names = [NamedPlace(name, twin.data.body(f"object/{name}").xipos.copy()) for name in movable]
    return segment(scan(twin, views=views, seed=seed), base_of(twin.scene), names=names)


def push_aside(twin: Twin, name: str, distance: float, seed: int) -> None:
    """Move an object by a distance [m] in a random horizontal direction, and turn it by up to 10 degrees."""
    rng = np.random.default_rng(seed)
    angle, turn = rng.uniform(-np.pi, np.pi), rng.uniform(-np.radians(10.0), np.radians(10.0))
    joint = twin.data.joint(int(twin.world.model.body(f"object/{name}").jntadr[0]))
    joint.qpos[:2] += distance * np.array([np.cos(angle), np.sin(angle)])
    joint.qpos[3:] = quat_multiply([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)], joint.qpos[3:])
    mujoco.mj_forward(twin.world.model, twin.data)


def _nearest(twin: Twin, known: SegmentedMap, target: Target) -> str:
    """Return the movable object that is nearest to a target."""
    middle = known.model.means.detach().double().numpy()[target.rows].mean(axis=0)
    movable = [obj.name for obj in twin.scene.objects if obj.movable]
    return min(movable, key=lambda name: float(np.linalg.norm(twin.data.body(f"object/{name}").xipos - middle)))


def _heights(twin: Twin) -> dict[str, float]:
    movable = [obj.name for obj in twin.scene.objects if obj.movable]
    return {name: float(twin.data.body(f"object/{name}").xipos[2]) for name in movable}
