"""A pick in the twin: the scene is scanned, and all later stages use only that map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from splatbot.errors import InputError
from splatbot.grasping.affordance import Affordance, NameHint, Target, find_target
from splatbot.grasping.pick import Picker
from splatbot.grasping.pick_types import PickOptions, PickResult, PickStep
from splatbot.grasping.sampler import GraspSampler
from splatbot.segmentation import SegmentedMap, segment
from splatbot.sim.controller import TwinController
from splatbot.sim.motion import base_of
from splatbot.sim.scan import scan
from splatbot.sim.twin import Twin
from splatbot.workspace import NamedPlace


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
    if home:
        options = replace(options, carry_to=tuple(controller.position.tolist()))
    sampler = GraspSampler(known, robot, margin=margin)
    picker = Picker(sampler, controller, controller.gripper, options=options, stop=stop, on_step=on_step)
    result = picker.pick(found)
    return TwinPick(result, found, {name: height - before[name] for name, height in _heights(twin).items()})


def scanned(twin: Twin, views: int, seed: int) -> SegmentedMap:
    """Scan the twin and segment the map, with the names of the scene's objects."""
    movable = [obj.name for obj in twin.scene.objects if obj.movable]
    names = [NamedPlace(name, twin.data.body(f"object/{name}").xipos.copy()) for name in movable]
    return segment(scan(twin, views=views, seed=seed), base_of(twin.scene), names=names)


def _heights(twin: Twin) -> dict[str, float]:
    movable = [obj.name for obj in twin.scene.objects if obj.movable]
    return {name: float(twin.data.body(f"object/{name}").xipos[2]) for name in movable}
