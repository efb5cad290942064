"""Protocols of picking trials: household shapes, packed, bin and shelf scenes, and objects that lack depth."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import Any

import mujoco
import numpy as np
import pytest

from splatbot.config import Config
from splatbot.frame import Frame
from splatbot.geometry import inverse, se3_exp
from splatbot.grasping.affordance import MasksHint
from splatbot.logs.raycast import RaycastScene
from splatbot.protocols import Array
from splatbot.sim.compare.held_out import HeldOutTwin, Spread, draw
from splatbot.sim.scene import make_scene
from splatbot.sim.trials.objects import CONVEX, HOUSEHOLD, household
from splatbot.sim.trials.scan import CONSTANTS as SCAN
from splatbot.sim.trials.scan import (
    UnseenError,
    _hints,
    _log,
    _with_materials,
    calibration_error,
    camera_path,
    scan_scene,
)
from splatbot.sim.trials.scenes import ANY_TARGET, BIN, FAMILIES, SHELF, TABLE, TrialScene, make_trial
from splatbot.sim.trials.surfaces import surfaces_of
from splatbot.sim.trials.trial import HELD_OUT
from splatbot.sim.twin import Twin
from splatbot.sim.world import OBJECT


def _placed(kind: str, *, at: tuple[float, float, float], movable: bool) -> dict[str, Any]:
    item = household(kind, np.random.default_rng(3))
    return {"name": "it", "shapes": item.shapes, "at": at, "movable": movable}


@pytest.mark.parametrize("kind", HOUSEHOLD)
def test_the_camera_and_physics_see_the_same_household_shape(kind: str) -> None:
    """Rays of MuJoCo against the compiled shape end where rays against the textured mesh do."""
    at = (0.5, 0.0, 0.3)
    scene = make_scene({"name": "one", "robot": None, "objects": [_placed(kind, at=at, movable=False)]})
    twin = Twin(scene)
    surfaces = surfaces_of(scene.objects[0])
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    starts = np.array(at) + 0.4 * directions + rng.uniform(-0.03, 0.03, (300, 3))
    shown = RaycastScene(surfaces)
    found = []
    for start, way in zip(starts, -directions, strict=True):
        geom = np.zeros(1, np.int32)
        there = mujoco.mj_ray(twin.world.model, twin.data, start, way, None, 1, -1, geom)
        here = float(shown.reach(start, way[None])[0])
        if there >= 0 and np.isfinite(here):
            found.append(abs(there - here))
        elif there >= 0 or np.isfinite(here):
            found.append(np.nan)  # grazes an edge of the facets of a round shape
    assert np.isnan(found).mean() < 0.05
    assert np.nanquantile(found, 0.95) < 5e-4
    assert len(found) > 100


@pytest.mark.parametrize("kind", HOUSEHOLD)
def test_a_household_shape_comes_to_rest_on_the_table(kind: str) -> None:
    item = household(kind, np.random.default_rng(3))
    assert 0.01 < item.height < 0.095
    objects = [{"name": TABLE, "shapes": [{"kind": "plane"}]}, _placed(kind, at=(0.5, 0.0, item.height), movable=True)]
    twin = Twin(make_scene({"name": "one", "robot": None, "objects": objects}))
    none = np.zeros(0)
    for k in range(round(2.0 * twin.rate)):
        twin.advance(k / twin.rate, none, none, none, None)
    speed = np.linalg.norm(twin.data.body(OBJECT + "it").cvel)
    assert speed < 0.05 or kind in ("dumbbell", "potato", "banana")  # these may still roll
    assert twin.data.body(OBJECT + "it").xpos[2] > 0.005


@pytest.mark.parametrize("family", ANY_TARGET)
def test_a_seed_gives_one_scene_whose_objects_rest_where_the_protocol_says(family: str) -> None:
    for seed in range(3):
        found = make_trial(seed, family)
        assert found.scene == make_trial(seed, family).scene
        at = {obj.name: np.array(obj.at) for obj in found.scene.movable}
        names = {found.target, *found.others}
        assert len(names) >= 2
        assert names <= set(at)
        assert all(found.materials.get(name) != "glass" for name in names)
        for place in at.values():
            assert 0.0 < place[2] < 0.25
        if family == "bin":
            for place in at.values():
                assert (np.abs(place[:2] - [0.48, 0.0]) <= [0.18, 0.24]).all()
        if family == "shelf":
            (shelf,) = (obj for obj in found.scene.objects if obj.name == SHELF)
            board = max(shape.at[2] for shape in shelf.shapes)
            assert all(place[2] < board and 0.62 < place[0] < 0.88 for place in at.values())


def test_packed_objects_are_closer_than_those_of_a_table_top() -> None:
    """Medians over scenes of the distance from an object to its nearest neighbour."""
    nearest = {}
    for family in ("packed", "tabletop"):
        found = []
        for seed in range(6):
            at = [np.array(obj.at[:2]) for obj in make_trial(seed, family).scene.movable]
            found += [min(np.linalg.norm(a - b) for b in at if b is not a) for a in at]
        nearest[family] = float(np.median(found))
    assert nearest["packed"] < 0.8 * nearest["tabletop"]


def test_isolated_scenes_show_every_shape_in_turn() -> None:
    count = len(CONVEX) + len(HOUSEHOLD)
    kinds = [make_trial(seed, "isolated").kind for seed in range(len(CONVEX), count)]
    assert kinds == list(HOUSEHOLD)
    assert len(HOUSEHOLD) >= 20
    assert make_trial(count, "isolated").kind == make_trial(0, "isolated").kind == "box"
    assert set(FAMILIES) == {"tabletop", "isolated", *ANY_TARGET}


def _with(found: TrialScene, **materials: Any) -> TrialScene:
    return replace(found, materials=materials)


def test_black_loses_depth_and_glass_shows_the_surface_behind_it() -> None:
    found = make_trial(2, "packed")
    first, second = found.target, next(iter(found.others))
    joints = camera_path(4, found.viewpoints)
    plain = _log(found, joints, 160)
    lost: list[float] = []
    through: list[float] = []
    total = 0
    for name, material in ((first, "black"), (second, "glass")):
        read = _with_materials(_with(found, **{name: material}), plain, joints)
        bare = _log(found, joints, 160, (name,))
        for k in range(4):
            before, after, behind = plain[k].depth, read(k).depth, bare[k].depth
            own = before < behind - 1e-6
            np.testing.assert_array_equal(after[~own], before[~own])
            missing, kept = own & (after == 0), own & (after > 0)
            (lost if material == "black" else through).append(missing.sum() / max(own.sum(), 1))
            reference = before if material == "black" else behind
            np.testing.assert_array_equal(after[kept], reference[kept])
            total += int(own.sum())
    assert total > 500
    assert np.mean(lost) == pytest.approx(SCAN.holes[0], abs=0.05)
    assert np.mean(through) == pytest.approx(SCAN.holes[1], abs=0.05)


def test_masks_mark_each_object_that_may_be_picked() -> None:
    found = make_trial(1, "bin")
    log = _log(found, camera_path(16, found.viewpoints), 160)
    hints = _hints(found, log, [log[k] for k in range(16)], log.ground_truth.T_world_camera)
    assert set(hints) <= {found.target, *found.others}
    assert len(hints) >= 2
    for hint in hints.values():
        assert isinstance(hint, MasksHint)
        assert all(one.mask.any() and one.view.depth is not None for one in hint.masks)
    for a, b in combinations(hints.values(), 2):
        assert isinstance(a, MasksHint)
        assert isinstance(b, MasksHint)
        for one in a.masks:
            same = [two for two in b.masks if two.view is one.view]
            assert not any((one.mask & two.mask).any() for two in same)


@pytest.mark.long
def test_a_camera_that_is_not_calibrated_errs_the_same_way_in_each_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """The mean of the errors of many frames is the error of calibration; an exact camera has none."""
    priors: dict[bool, list[Array]] = {True: [], False: []}
    found = make_trial(0, "isolated")
    log = _log(found, camera_path(40), 64)

    class Recorder:
        def __init__(self, config: Config) -> None:
            self.results: list[Any] = []

        def process(self, frame: Frame) -> None:
            assert frame.prior is not None
            assert frame.prior.T_world_camera is not None
            priors[calibrated].append(frame.prior.T_world_camera)

        def finish(self) -> None:
            raise UnseenError("stops here.")

    monkeypatch.setattr("splatbot.sim.trials.scan.Slam", Recorder)
    for calibrated in (True, False):
        with pytest.raises(UnseenError, match="stops here"):
            scan_scene(found, frames=40, width=64, calibrated=calibrated)
    true = log.ground_truth.T_world_camera
    wanted = se3_exp(calibration_error(found.seed))
    for calibrated, at in ((True, np.eye(4)), (False, wanted)):
        # Priors are relative to the first: prior_0^-1 prior_k = (T_0 E N_0)^-1 T_k E N_k, with noise N of 0.5 mm.
        residual = [inverse(inverse(true[0] @ at) @ T @ at) @ P for T, P in zip(true, priors[calibrated], strict=True)]
        assert np.abs(np.mean([R[:3, 3] for R in residual], axis=0)).max() < 1.5e-3
    wrong = [inverse(inverse(true[0]) @ T) @ P for T, P in zip(true, priors[False], strict=True)]
    assert max(np.linalg.norm(R[:3, 3]) for R in wrong) > 1.5e-3


def test_the_held_out_engine_is_drawn_after_the_physics_and_is_that_of_its_twin() -> None:
    scene = make_trial(0, "isolated").scene
    cones, solvers = set(), set()
    for seed in range(8):
        plain, held = draw(Spread(), seed), draw(HELD_OUT, seed)
        assert held.engine is not None
        assert replace(held, engine=None) == plain
        option = HeldOutTwin(scene, held).world.model.opt
        assert bool(option.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL) == held.engine.pyramidal
        assert (option.solver, option.impratio) == (held.engine.solver, pytest.approx(held.engine.impratio))
        cones.add(held.engine.pyramidal)
        solvers.add(held.engine.solver)
    assert (len(cones), len(solvers)) == (2, 2)


def test_the_bin_and_the_shelf_are_in_the_camera_images() -> None:
    for family, name in (("bin", BIN), ("shelf", SHELF)):
        found = make_trial(0, family)
        joints = camera_path(4, found.viewpoints)
        images = [_log(found, joints, 160, without)[1].depth for without in ((), (name,))]
        assert (images[0] < images[1] - 1e-3).mean() > 0.02
