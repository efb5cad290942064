"""`splatbot pick`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from splatbot.cli.paths import result_folder, written_to
from splatbot.errors import InputError

if TYPE_CHECKING:
    from splatbot.sim.picking import TwinPick


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
    look: bool = True,
    attempts: int = 3,
    moved: float = 0.0,
    seed: int = 0,
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    overwrite: bool = False,
) -> int:
    """Pick an object in the twin: scan, find grasps, plan, look again, approach, close, lift, check.

    The scene is scanned by a depth camera through the scene's sensor effects; all later steps use only that map. The
    whole path is certified before the arm moves. Writes pick.json: outcome, stage, times, grasp, and the height
    to which the object rose. The exit code is 1 if the hand does not hold it.

    Examples:
        splatbot pick tabletop_clutter --target can
        splatbot pick tabletop_clutter --target can --moved 0.03
        splatbot pick tabletop_clutter --target can --moved 0.03 --no-look
        splatbot pick tabletop_clutter --target "largest box" --force 40 --home
        SPLATBOT_VLM_URL=http://127.0.0.1:8000/v1 SPLATBOT_VLM_MODEL=qwen splatbot pick my.yaml --target mug --vlm

    Args:
        scene: a scene's name, as of `splatbot twin --list`, or its YAML file.
        target: a name of the scene, or words as of `splatbot grasp`.
        vlm: also query the vision-language model of SPLATBOT_VLM_URL and SPLATBOT_VLM_MODEL; it and the rules must not
            contradict each other.
        views: number of views of the scan.
        force: force of the fingers; by default the gripper's own.
        lift: height of the lift [m].
        tries: largest number of grasps to plan for.
        margin: clearance [m] of hand and arm to the map.
        home: carry the object to the home configuration.
        look: look again from the wrist: correct the grasp before the fingers close, and check that the place is empty.
        attempts: largest number of grasps that are executed; more than one needs --look.
        moved: distance [m] by which the target is pushed aside after the scan, to see how the pick copes.
        seed: seed of sensor noise and search.
        out: folder to write to; by default runs/pick, whose earlier results are replaced.
        overwrite: replace the results of an earlier call in the folder that --out names.
    """
    folder, replaced = result_folder(out, "pick", "pick.json", overwrite=overwrite)

    from splatbot.atomic import atomic_write
    from splatbot.cli.affordances import name_backends
    from splatbot.grasping.options import GraspOptions
    from splatbot.grasping.pick_types import PickError, PickOptions
    from splatbot.sim.picking import MOST_MOVED, pick_in_twin
    from splatbot.sim.scene import load_scene
    from splatbot.sim.twin import Twin

    backends = name_backends(vlm=vlm)
    if not 0.0 <= moved <= MOST_MOVED:
        raise InputError(f"is {moved:g}.", field="--moved", hint=f"give metres, 0 to {MOST_MOVED:g}")
    options = PickOptions(
        lift=lift, force=force, tries=tries, grasp=GraspOptions(seed=seed), attempts=attempts, seed=seed
    )
    twin = Twin(load_scene(scene))
    picked = pick_in_twin(
        twin, target, backends, options,
        views=views, margin=margin, home=home, look=look, moved=moved, seed=seed,
    )  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_write(folder / "pick.json") as handle:
        handle.write(json.dumps(picked.summary(), indent=2).encode())
    _print(picked, written_to(folder, replaced))
    if not picked.result:
        raise PickError(picked.result)
    return 0


def _print(picked: TwinPick, folder: str) -> None:
    from splatbot.cli.tables import print_table

    result, target = picked.result, picked.target
    rows = [(str(step.stage), f"{step.seconds:6.2f} s  {step.note}") for step in result.steps]
    rows += [(f"{name} rose", f"{1e3 * by:+.0f} mm") for name, by in picked.rose.items() if abs(by) > 0.005]
    print_table([*rows, ("written to", folder)], title=f"{target.label} ({target.backend}): {result.outcome}")
