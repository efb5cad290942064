"""`splatbot twin`: output, files, and exit codes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatbot.bench.tabletop import tabletop
from splatbot.robots.panda import panda
from splatbot.sim.effects.physics import PHYSICS
from splatbot.sim.effects.registry import EFFECTS
from splatbot.workspace import Workspace
from tests.terminal import at_a_terminal
from tests.unit.cli.conftest import RunCommand, assert_refused

pytest.importorskip("mujoco")


def test_the_result_holds_tracking_touches_and_the_ledger_with_costs(run: RunCommand, tmp_path: Path) -> None:
    answer = run("twin", "--scene", "wiping", "--forbid", "backlash", "--json", tmp_path / "r.json")
    assert answer.code == 0  # to wipe is to touch
    values = json.loads((tmp_path / "r.json").read_text())
    assert {contact["other"] for contact in values["contacts"]} >= {"board"}
    assert values["tracking"]["tcp"] > 1e-3
    effects = {entry["name"]: entry for entry in values["effects"]}
    assert list(effects) == [*PHYSICS, *EFFECTS]
    assert effects["backlash"]["by"] == "forbidden"
    assert effects["backlash"]["ms"] is None
    assert all(isinstance(entry["ms"], float) for entry in effects.values() if entry["on"])
    assert "minimum clearance of the arm" in answer.out
    assert f"written to {tmp_path / 'r.json'}" in answer.out


def test_the_verdict_is_the_first_line_and_inactive_effects_are_one_line_at_the_end() -> None:
    shown = at_a_terminal("twin", "--scene", "wiping", "--forbid", "backlash", "--no-costs", columns=80)
    assert shown.code == 0, shown.text
    assert shown.longest_line() <= 80
    text = " ".join(shown.text.split())
    assert text.index("verdict: contacts, which the task allows: finger1 and board") < text.index("wiping: 3.00 s")
    assert text.index("wiping: 3.00 s") < text.index("minimum clearance")
    assert text.index("minimum clearance") < text.index("active effects") < text.index("inactive: backlash (forbidden")
    assert text.index("torque_limits") < text.index("not needed here: soft_bodies, ")
    assert "everything is rigid" not in text  # the reason of soft_bodies, which --json has


def test_a_run_without_contact_says_so_first(run: RunCommand) -> None:
    answer = run("twin", "--scene", "empty", "--no-costs")
    assert (answer.code, answer.out.splitlines()[0]) == (0, "verdict: no contact of the arm")


def test_an_arm_that_touches_the_map_ends_with_1(run: RunCommand, tmp_path: Path) -> None:
    tabletop().gaussians(8000).save(tmp_path / "map.ply")
    home, into = panda().home.tolist(), [0.0, 0.9, 0.0, -1.4, 0.0, 2.3, 0.785]
    header = ["time", *(f"position.{name}" for name in panda().chain.names)]
    rows = [",".join(map(str, [t, *q])) for t, q in ((0.0, home), (1.0, into), (1.5, into))]
    (tmp_path / "plan.csv").write_text("\n".join([",".join(header), *rows]))
    answer = run("twin", "--map", tmp_path / "map.ply", "--trajectory", tmp_path / "plan.csv", "--no-costs")
    assert answer.code == 1
    assert answer.out.startswith("verdict: do not execute: unintended contact of ")
    assert "contact: " in answer.out
    assert " and map" in answer.out
    assert "Gaussians as" in answer.out


@pytest.mark.long
def test_a_plan_of_another_robot_at_another_base_runs_in_the_twin_of_the_map(run: RunCommand, tmp_path: Path) -> None:
    tabletop().gaussians(4000).save(tmp_path / "map.ply")
    of = ("--map", tmp_path / "map.ply", "--robot", "ur5e-2f85", "--base", 0.05, 0, 0, 1, 0, 0, 0)
    goal = (0.4, -1.4, 1.2, -1.3, -1.5, 0.2)
    planned = run("plan", *of, "--start", "home", "--goal", *goal, "--speed", 1, "--out", tmp_path / "out")
    assert planned.code == 0, planned.err
    assert "next: splatbot twin --map" in planned.out
    simulated = ("twin", *of, "--trajectory", tmp_path / "out" / "trajectory.json", "--no-costs")
    answer = run(*simulated, "--json", tmp_path / "r.json")
    assert answer.code == 0, answer.err
    values = json.loads((tmp_path / "r.json").read_text())
    clearance = json.loads((tmp_path / "out" / "plan.json").read_text())["clearance_m"]
    assert values["contacts"] == []
    assert values["tracking"]["tcp"] < 1e-3
    assert clearance > 0.0
    assert values["clearance"]["value"] > 0.0


def test_a_plan_of_an_earlier_calibration_does_not_run_in_the_twin_of_the_map(run: RunCommand, tmp_path: Path) -> None:
    tabletop().gaussians(4000).save(tmp_path / "map.ply")
    scene = Workspace(T_world_base=np.eye(4), joint_offsets=np.full(7, 0.01), offsets_of="panda")
    scene.save(tmp_path / "scene.yaml")
    of, goal = ("--map", tmp_path / "map.ply"), (0.3, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8)
    planned = run("plan", *of, "--start", "home", "--goal", *goal, "--speed", 1, "--out", tmp_path / "out")
    assert planned.code == 0, planned.err
    simulated = ("twin", *of, "--no-costs", "--trajectory", tmp_path / "out" / "trajectory.json")
    assert run(*simulated).code == 0
    replace(scene, joint_offsets=np.full(7, 0.02)).save(tmp_path / "scene.yaml")
    for name in ("trajectory.json", "trajectory.csv"):
        assert_refused(run(*simulated[:-1], tmp_path / "out" / name), "plan.json: joint_offsets: differ from those")
    for text in ("{}", "[]", "{"):
        (tmp_path / "out" / "plan.json").write_text(text)
        assert_refused(run(*simulated), "plan.json: joint_offsets: does not name")
    (tmp_path / "out" / "plan.json").unlink()
    assert run(*simulated).code == 0  # of another program, in reported positions


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--scene", "empty", "--base", "0", "0", "0", "1", "0", "0", "0"), "--base: places a robot in a map"),
        (("--scene", "empty", "--robot", "r2d2"), "r2d2"),
        ((), "needs either a scene or a map"),
        (("--scene", "empty", "--map", "a.ply"), "needs either a scene or a map"),
        (("--scene", "kitchen"), "there is no scene 'kitchen'"),
        (("--scene", "empty", "--force", "magic"), "there is no 'magic'"),
        (("--scene", "empty", "--timestep", "1"), "give seconds in 0..0.05"),
        (("--scene", "empty", "--trajectory", "nowhere.json"), "nowhere.json: --trajectory: does not exist"),
    ],
)
def test_wrong_input_is_named_and_ends_with_2(run: RunCommand, words: tuple[str, ...], message: str) -> None:
    answer = run("twin", *words)
    assert answer.code == 2
    assert message in answer.err


def test_the_list_names_scenes_and_physics(run: RunCommand) -> None:
    answer = run("twin", "--list")
    assert answer.code == 0
    for word in ("mug_hanging", "shelf_bin", "soft_bodies", "backlash"):
        assert word in answer.out


@pytest.mark.long
def test_a_film_shows_the_arm_move_or_it_is_said_why_there_is_none(tmp_path: Path) -> None:
    """In a process of its own: MUJOCO_GL must be set before mujoco is imported."""
    import cv2

    command = [
        sys.executable,
        "-m",
        "splatbot",
        "twin",
        "--scene",
        "empty",
        "--no-costs",
        "--video",
        str(tmp_path / "a.mp4"),
    ]
    env = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "MUJOCO_GL")}
    done = subprocess.run(command, capture_output=True, text=True, env=env)
    if done.returncode != 0:
        assert "MuJoCo cannot draw here" in done.stderr
        pytest.skip("no EGL here; the command says so")
    film = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    frames = [film.read()[1] for _ in range(int(film.get(cv2.CAP_PROP_FRAME_COUNT)))]
    assert len(frames) == pytest.approx(2.6 * 25, abs=2)
    assert float(abs(frames[0].astype(float) - frames[-1]).mean()) > 1.0
