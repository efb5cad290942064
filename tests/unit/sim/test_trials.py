"""Picking trials: scenes, the camera path, the shaking, storage of results, and one tiny trial."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from rich.text import Text

from splatbot.errors import FormatError, InputError
from splatbot.grasping.pick_types import PickOutcome, PickResult, PickStage
from splatbot.logs.raycast import RaycastSurface
from splatbot.robots.panda import panda
from splatbot.sim.compare.agreement import wilson
from splatbot.sim.scene import SceneObject
from splatbot.sim.trials.run import FILE, TrialError, TrialsPlan, read_rows, run_trials
from splatbot.sim.trials.scan import UnseenError, camera_path
from splatbot.sim.trials.scenes import OBSTACLE, TrialScene, make_trial
from splatbot.sim.trials.shake import CONSTANTS as SHAKE
from splatbot.sim.trials.shake import Shake
from splatbot.sim.trials.stacks import GaussianStack
from splatbot.sim.trials.surfaces import surfaces_of
from splatbot.sim.trials.table import HEAD, physics, summaries, table_rows
from splatbot.sim.trials.trial import CONSTANTS as TRIAL
from splatbot.sim.trials.trial import VERSION, TrialRow, TwinPickResult, _failure, _Watched, run_trial
from splatbot.sim.twin import Twin
from splatbot.sim.wrist import T_PANDA_CAMERA

pytest.importorskip("mujoco")

HELD = TwinPickResult(True, "", "picked", "", 0.18, 0.175)
SLIPPED = TwinPickResult(False, "slip", "lost", "nothing is between the fingers any more", 0.02, 0.0, ("table",))


def row(seed: int, stack: str, ideal: TwinPickResult = HELD, held_out: TwinPickResult = HELD) -> TrialRow:
    return TrialRow(
        seed, "tabletop", stack, "can", False, ideal, held_out, 10.0 + seed, 300.0, 4.0, 5_000_000, 50.0, 32, 320,
        version=VERSION,
    )  # fmt: skip


def test_a_seed_gives_one_scene_at_rest_whose_objects_do_not_overlap() -> None:
    for seed in range(6):
        found, again = make_trial(seed), make_trial(seed)
        assert found.scene == again.scene
        assert found.target in {obj.name for obj in found.scene.movable}
        assert found.moving == (seed == 4) == any(obj.name == OBSTACLE for obj in found.scene.objects)
        for a, b in combinations(found.scene.movable, 2):
            assert np.linalg.norm(np.subtract(a.at, b.at)[:2]) > 0.05
        twin = Twin(found.scene)
        assert twin.follower is not None
        q = np.array(twin.data.qpos[twin.follower.qpos])
        before = {t.name: np.array(twin.data.body(f"object/{t.name}").xpos) for t in found.scene.movable}
        for k in range(300):
            twin.advance(k / twin.rate, q, 0 * q, 0 * q, None)
        for name, at in before.items():
            assert np.linalg.norm(twin.data.body(f"object/{name}").xpos - at) < 2e-3, (seed, name)
    assert {make_trial(seed, "isolated").kind for seed in range(6)} == {"box", "can", "ball", "lying can", "egg"}
    with pytest.raises(InputError, match="zoo"):
        make_trial(0, "zoo")


def test_what_the_camera_is_shown_is_what_physics_computes_with() -> None:
    size, at, yaw = np.array([0.1, 0.06, 0.04]), np.array([0.5, 0.1, 0.02]), 0.3
    values = {"name": "box", "shapes": [{"kind": "box", "size": size.tolist()}], "at": at, "rpy": [0, 0, yaw]}
    obj = SceneObject.model_validate(values)
    (surface,) = surfaces_of(obj)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    local = (surface.mesh.vertices - at) @ turn
    np.testing.assert_allclose(np.abs(local), np.broadcast_to(size / 2, local.shape), atol=1e-12)
    for shape, away in (
        ({"kind": "sphere", "radius": 0.03}, lambda p: np.linalg.norm(p, axis=1) - 0.03),
        ({"kind": "cylinder", "radius": 0.02, "height": 0.1}, _off_cylinder),
        (
            {"kind": "ellipsoid", "axes": [0.04, 0.03, 0.02]},
            lambda p: 0.02 * (np.linalg.norm(p / [0.04, 0.03, 0.02], axis=1) - 1),
        ),
    ):
        found: list[RaycastSurface] = surfaces_of(SceneObject.model_validate({"name": "it", "shapes": [shape]}))
        assert np.abs(away(found[0].mesh.vertices)).max() < 1e-9
    with pytest.raises(InputError, match="plane"):
        surfaces_of(SceneObject.model_validate({"name": "table", "shapes": [{"kind": "plane"}]}))


def _off_cylinder(points: np.ndarray) -> np.ndarray:
    out = np.maximum(np.linalg.norm(points[:, :2], axis=1) - 0.02, np.abs(points[:, 2]) - 0.05)
    return np.where(np.linalg.norm(points[:, :2], axis=1) < 1e-9, np.abs(points[:, 2]) - 0.05, out)


def test_the_camera_looks_at_the_table_from_around_and_the_hand_stays_above_the_things() -> None:
    robot, q = panda(), camera_path(24)
    assert (q > robot.chain.lower).all()
    assert (q < robot.chain.upper).all()
    links = robot.fk(q)
    assert (links[:, -1] @ robot.T_link_tcp)[:, 2, 3].min() > 0.2
    cameras = links[:, -1] @ T_PANDA_CAMERA
    towards = np.array([0.5, 0.0, 0.05]) - cameras[:, :3, 3]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    assert (cameras[:, :3, 2] * towards).sum(axis=1).min() > np.cos(np.radians(20.0))
    turns = np.degrees(np.unwrap(np.arctan2(*(cameras[:, 1::-1, 3] - [0.0, 0.5]).T)))
    assert np.ptp(turns) > 180.0


def test_shaking_stays_within_the_limits_and_ends_where_it_began() -> None:
    chain = panda().chain
    shake = Shake(chain, panda().home)
    t = np.linspace(0.0, shake.duration, 4001)
    q, v = (np.array(x) for x in zip(*(shake.reference(float(x)) for x in t), strict=True))
    np.testing.assert_allclose(q[[0, -1]], np.stack([shake.q, shake.q]), atol=1e-12)
    np.testing.assert_allclose(v[[0, -1]], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.gradient(q, t, axis=0)[1:-1], v[1:-1], atol=1e-3)
    acceleration = np.abs(np.gradient(v, t, axis=0)).max(axis=0)
    assert (acceleration < 1.1 * SHAKE.acceleration_share * chain.acceleration).all()
    assert (acceleration > 0.8 * SHAKE.acceleration_share * chain.acceleration).all()
    assert (np.abs(v).max(axis=0) < chain.velocity).all()


def test_the_table_counts_what_the_rows_say() -> None:
    rows = [row(0, "ours"), row(1, "ours", HELD, SLIPPED), row(2, "ours"), row(0, "theirs", SLIPPED, SLIPPED)]
    ours, theirs = summaries(rows)
    interval = wilson(2, 3)
    assert (ours["trials"], ours["successes"], ours["ideal"]) == (3, 2, 1.0)
    assert (ours["low"], ours["high"]) == (interval.low, interval.high)
    assert ours["drop"] == pytest.approx(1 / 3)
    assert (ours["plan_ms"], ours["world_mb"], ours["touched_others"]) == (11.0, 5.0, 1)
    assert ours["failures"] == {"slip": 1}
    assert ours["by_kind"] == {"can": "2 of 3"}
    assert (theirs["success"], theirs["drop"]) == (0.0, 0.0)
    assert [words[0] for words in table_rows([ours, theirs])] == ["ours", "theirs"]
    assert all(Text.from_markup(name).plain == name for name in HEAD)  # rich swallows units in brackets


def test_the_physics_that_a_table_holds_for_is_that_of_the_twin() -> None:
    trial = make_trial(1)
    found = physics(trial)
    assert found["finger_force_n"] == 70.0
    assert found["friction"] == sorted({obj.friction for obj in trial.scene.movable})
    option = Twin(trial.scene).world.model.opt
    assert (found["impratio"], found["timestep_ms"]) == (option.impratio, pytest.approx(1e3 * option.timestep))
    assert 5.0 < found["shake_m_s2"] < 20.0


def test_what_is_written_is_not_done_again_and_a_line_cut_short_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / FILE
    kept = [row(0, "gaussians"), row(1, "gaussians", HELD, SLIPPED)]
    lines = [json.dumps(one.to_dict()) for one in kept]
    path.write_text("\n".join([*lines, lines[0][:40]]))
    assert read_rows(path) == kept
    assert path.read_text() == "".join(f"{line}\n" for line in lines)
    rows, interrupted = run_trials(TrialsPlan(trials=2), tmp_path)
    assert (rows, interrupted) == (kept, False)
    old = [json.dumps({**json.loads(line), "version": VERSION - 1}) for line in lines]
    path.write_text("\n".join(old) + "\n")
    asked: list[int] = []

    def told(trial: TrialScene, *_: object, **__: object) -> list[TrialRow]:
        asked.append(trial.seed)
        return [row(trial.seed, "gaussians")]

    monkeypatch.setattr("splatbot.sim.trials.run.run_trial", told)
    run_trials(TrialsPlan(trials=2), tmp_path)
    assert asked == [0, 1]  # rows of other physics are no results of these trials
    path.write_text("\n".join([lines[0][:40], lines[1]]) + "\n")
    with pytest.raises(FormatError, match="line 1"):
        read_rows(path)


def test_a_target_that_no_image_shows_is_a_failure_of_that_trial_and_not_the_end_of_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unseen(*args: object, **options: object) -> None:
        raise UnseenError("is in no picture.", field="can-1")

    monkeypatch.setattr("splatbot.sim.trials.trial.scan_scene", unseen)
    rows, interrupted = run_trials(TrialsPlan(trials=2, frames=16, width=160), tmp_path)
    assert not interrupted
    assert [row.seed for row in rows] == [0, 1]
    for one in rows:
        assert (one.ideal.failure, one.held_out.failure) == ("perception", "perception")
        assert "in no picture" in one.held_out.reason
        assert (one.frames, one.pixels) == (16, 160)
    assert read_rows(tmp_path / FILE) == rows
    (found,) = summaries([*rows, row(2, "gaussians")])
    assert (found["successes"], found["failures"]) == (1, {"perception": 2})
    assert (found["build_s"], found["world_mb"]) == (4.0, 5.0)
    (one,) = run_trial(make_trial(1, "isolated"), [GaussianStack()])
    assert not one.ideal.success


def test_an_error_ends_the_run_with_the_name_of_its_trial_and_those_before_it_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken_at_four(trial: TrialScene, stacks: list[GaussianStack], **_: object) -> list[TrialRow]:
        if trial.seed == 4:
            raise InputError("row 13220 is not finite.", field="quats")
        return [row(trial.seed, "gaussians")]

    monkeypatch.setattr("splatbot.sim.trials.run.run_trial", broken_at_four)
    with pytest.raises(TrialError, match=r"tabletop, seed 4.*quats: row 13220.*--scenes tabletop --first 4 --trials 1"):
        run_trials(TrialsPlan(trials=3, first=2, frames=32, width=320), tmp_path)
    assert [kept.seed for kept in read_rows(tmp_path / FILE)] == [2, 3]


def test_a_pushed_target_is_another_trial_and_the_look_another_stack(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[float, list[str]]] = []

    def told(trial: TrialScene, stacks: list[GaussianStack], *, moved: float, **_: object) -> list[TrialRow]:
        asked.append((moved, [stack.name for stack in stacks]))
        return [replace(row(trial.seed, stack.name), moved=moved) for stack in stacks]

    monkeypatch.setattr("splatbot.sim.trials.run.run_trial", told)
    still = TrialsPlan(trials=1, stacks=("gaussians",))
    both = TrialsPlan(trials=1, stacks=("gaussians", "gaussians_look"), moved=0.02)
    for plan in (still, both, both, still):
        rows, _ = run_trials(plan, tmp_path)
        assert {one.moved for one in rows} == {plan.moved}
    assert asked == [(0.0, ["gaussians"]), (0.02, ["gaussians", "gaussians_look"])]  # none twice
    with pytest.raises(InputError, match="moved"):
        TrialsPlan(moved=0.2)


def test_wrong_plans_are_named() -> None:
    for values, word in (({"stacks": ("voxels",)}, "voxels"), ({"family": "zoo"}, "zoo"), ({"trials": 0}, "range")):
        with pytest.raises(InputError, match=word):
            replace(TrialsPlan(), **values)


@pytest.mark.long
def test_one_thing_is_seen_picked_and_shaken_whatever_another_scan_gave_and_ctrl_c_keeps_it(tmp_path: Path) -> None:
    def stop(what: str, share: float) -> None:
        raise KeyboardInterrupt

    plan = TrialsPlan(family="isolated", trials=2, first=1, frames=16, width=240)
    another = replace(row(1, "gaussians", SLIPPED), family="isolated")
    (tmp_path / FILE).write_text(json.dumps(another.to_dict()) + "\n")
    rows, interrupted = run_trials(plan, tmp_path, on_progress=stop)
    assert interrupted
    (only,) = rows
    assert (only.seed, only.kind, only.stack) == (1, "can", "gaussians")
    assert only.ideal.success, only.ideal.reason
    assert only.ideal.rose > TRIAL.min_rise
    assert only.ideal.kept > TRIAL.min_kept_height
    obj = make_trial(1, "isolated").scene.movable[0].shapes[0]
    assert obj.kind == "cylinder"
    assert only.width_mm == pytest.approx(2e3 * obj.radius, abs=4.0)  # a scan of 240 pixels
    assert only.plan_ms is not None
    assert only.plan_ms < 500.0
    assert (only.frames, only.pixels) == (16, 240)
    assert read_rows(tmp_path / FILE) == [another, *rows]


_POOL = """
import multiprocessing, os, time
from concurrent.futures import ProcessPoolExecutor
from splatbot.sim.trials.run import begin_worker

if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context, initializer=begin_worker) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        time.sleep(120)
"""


@pytest.mark.long
def test_workers_end_when_the_process_that_began_them_is_killed(tmp_path: Path) -> None:
    script = tmp_path / "pool.py"
    script.write_text(_POOL)
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True) as began:
        assert began.stdout is not None
        worker = int(began.stdout.readline())
        began.kill()
    until = time.monotonic() + 20.0
    while _runs(worker) and time.monotonic() < until:
        time.sleep(0.05)
    assert not _runs(worker)


def _runs(pid: int) -> bool:
    """Return whether a process runs and is no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_a_film_of_a_pick_gets_every_control_period() -> None:
    seen: list[float] = []
    twin = Twin(make_trial(1, "isolated").scene)
    controller = _Watched(twin, lambda data, time: seen.append(time))
    q = panda().home
    for _ in range(3):
        controller._advance(q, 0 * q, 0 * q)
    assert len(seen) == 3


@pytest.mark.parametrize(("outcome", "failure"), [("TARGET_MOVED", "look"), ("OBSTRUCTED", "look"), ("LOST", "slip")])
def test_a_failed_look_is_no_failure_of_control(outcome: str, failure: str) -> None:
    assert _failure(PickResult(PickOutcome[outcome], PickStage.CHECK, "it is away", None, ()), (), False) == failure
