"""`splatbot pick`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

if TYPE_CHECKING:
    from splatbot.grasping.affordance import Target
    from splatbot.grasping.pick_types import PickResult
    from splatbot.segmentation import MapScene
    from splatbot.sim.twin import Twin


def pick(
    scene: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")],
    /,
    *,
    target: str,
    vlm: bool = False,
    views: int = 8,
    force: Annotated[float | None, tyro.conf.arg(metavar="NEWTONS")] = None,
    lift: float = 0.15,
    tries: int = 5,
    margin: float = 0.0,
    home: bool = False,
    seed: int = 0,
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
) -> int:
    """Pick a thing in the twin: look around, find grasps, plan, approach, close, lift, check.

    The scene is scanned by a depth camera through the scene's sensor effects; all that follows knows only that map. The
    whole way is certified before the arm moves. Writes pick.json: outcome, stage, times, grasp, and how far the thing
    really rose. Exit code 1 if it is not held.

    Examples:
        splatbot pick tabletop_clutter --target can
        splatbot pick tabletop_clutter --target "largest box" --force 40 --home
        SPLATBOT_VLM_URL=http://127.0.0.1:8000/v1 SPLATBOT_VLM_MODEL=qwen splatbot pick my.yaml --target mug --vlm

    Args:
        scene: a scene's name, as of `splatbot twin --list`, or its YAML file.
        target: a name of the scene, or words as of `splatbot grasp`.
        vlm: ask the vision-language model of SPLATBOT_VLM_URL and SPLATBOT_VLM_MODEL too; it and the rules must not
            contradict each other.
        views: of the scan.
        force: of the fingers; by default the gripper's own.
        lift: how far up [m].
        tries: grasps whose way is looked for.
        margin: room [m] that hand and arm keep from the map.
        home: carry it home.
        seed: of sensor noise and search.
        out: folder to write to; by default runs/pick.
    """
    from splatbot.atomic import atomic_write
    from splatbot.cli.affordances import name_backends
    from splatbot.errors import InputError
    from splatbot.grasping.affordance import NameHint, find_target
    from splatbot.grasping.options import GraspOptions
    from splatbot.grasping.pick import Picker
    from splatbot.grasping.pick_types import PickError, PickOptions
    from splatbot.grasping.sampler import GraspSampler
    from splatbot.sim.controller import TwinController
    from splatbot.sim.scene import load_scene
    from splatbot.sim.twin import Twin

    backends = name_backends(vlm=vlm)
    twin = Twin(load_scene(scene))
    controller = TwinController(twin)
    robot = twin.world.robot
    if controller.gripper is None or robot is None:
        raise InputError("has no fingers.", field=scene, hint="give the scene a robot with a gripper, as panda")
    known = _known(twin, views, seed)
    found = find_target(NameHint(target), known, backends)
    options = PickOptions(
        lift=lift,
        force=force,
        tries=tries,
        grasp=GraspOptions(seed=seed),
        carry_to=tuple(controller.position.tolist()) if home else None,
        seed=seed,
    )
    before = _heights(twin)
    picker = Picker(GraspSampler(known, robot, margin=margin), controller, controller.gripper, options=options)
    result = picker.pick(found)
    rose = {name: height - before[name] for name, height in _heights(twin).items()}
    folder = out if out is not None else Path("runs") / "pick"
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_write(folder / "pick.json") as handle:
        handle.write(json.dumps(_summary(result, found, rose), indent=2).encode())
    _print(result, found, rose, folder)
    if not result:
        raise PickError(result)
    return 0


def _known(twin: Twin, views: int, seed: int) -> MapScene:
    """What a scan tells, with the names of the scene's objects."""
    from splatbot.segmentation import segment
    from splatbot.sim.motion import base_of
    from splatbot.sim.scan import scan
    from splatbot.workspace import NamedPlace

    movable = [thing.name for thing in twin.scene.objects if thing.movable]
    names = [NamedPlace(name, twin.data.body(f"object/{name}").xipos.copy()) for name in movable]
    return segment(scan(twin, views=views, seed=seed), base_of(twin.scene), names=names)


def _heights(twin: Twin) -> dict[str, float]:
    movable = [thing.name for thing in twin.scene.objects if thing.movable]
    return {name: float(twin.data.body(f"object/{name}").xipos[2]) for name in movable}


def _summary(result: PickResult, target: Target, rose: dict[str, float]) -> dict[str, Any]:
    grasp = result.grasp
    return {
        "outcome": result.outcome,
        "stage": result.stage,
        "reason": result.reason,
        "target": {"label": target.label, "backend": target.backend, "score": target.score},
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
        "rose_m": rose,
    }


def _print(result: PickResult, target: Target, rose: dict[str, float], folder: Path) -> None:
    from splatbot.cli.tables import print_table

    rows = [(str(step.stage), f"{step.seconds:6.2f} s  {step.note}") for step in result.steps]
    rows += [(f"{name} rose", f"{1e3 * by:+.0f} mm") for name, by in rose.items() if abs(by) > 0.005]
    print_table([*rows, ("written to", str(folder))], title=f"{target.label} ({target.backend}): {result.outcome}")
