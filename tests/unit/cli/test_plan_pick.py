"""`splatbot plan-pick`: a complete pick in a map, executed in the twin of the map."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from splatbot.cli import main
from splatbot.collision import RobotSpheres
from splatbot.robots.panda import panda
from splatbot.sim.motion import load_motion
from splatbot.workspace import Workspace
from tests.unit.cli.conftest import RunCommand, assert_fix_named, assert_refused
from tests.unit.grasping.files import grasp_file_values
from tests.unit.grasping.objects import OBJECTS, model
from tests.unit.sim.test_page import document

pytest.importorskip("mujoco")


@pytest.fixture(scope="module")
def searched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a map, its scene file and the grasps of one search, which each test copies."""
    folder = tmp_path_factory.mktemp("searched")
    model().save(folder / "map.ply")
    Workspace(T_world_base=np.eye(4)).save(folder / "scene.yaml")
    words = ("--map", folder / "map.ply", "--target", "red box", "--wanted", 3, "--margin", 0.004)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert main(["grasp", *map(str, words), "--out", str(folder / "grasp")]) == 0
    assert "splatbot plan-pick --map" in printed.getvalue()
    return folder


@pytest.fixture
def map_file(tmp_path: Path) -> Path:
    path = tmp_path / "map.ply"
    model().save(path)
    Workspace(T_world_base=np.eye(4)).save(tmp_path / "scene.yaml")
    return path


@pytest.fixture
def grasps(searched: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(searched / "grasp", tmp_path / "grasp")) / "grasp.json"


def test_the_box_is_held_in_the_twin_and_each_motion_clears_the_true_objects(
    run: RunCommand, map_file: Path, grasps: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    answer = run("plan-pick", "--map", map_file, "--grasp", grasps, "--speed", 0.5, "--out", out)
    assert answer.code == 0, answer.err
    for words in ("risen by", "touched nothing else", "beyond a margin of 4.0 mm"):
        assert words in answer.out
    written: dict[str, Any] = json.loads((out / "pick.json").read_text())
    assert written["execute"]
    assert written["simulated"]["rose_m"] == pytest.approx(0.15, abs=0.01)
    assert not written["simulated"]["contacts"]
    assert (written["simulated"]["outcome"], written["simulated"]["reason"]) == ("picked", "")
    page = (out / "pick.html").read_text()
    drawn = document(page)
    nearest = (
        f"clearance of the arm without its hand at least {1e3 * written['simulated']['clearance']['value']:.1f} mm"
    )
    assert nearest in page
    assert drawn["clearanceName"] == "clearance of arm and hand"
    assert min(drawn["clearances"]) < written["simulated"]["clearance"]["value"]  # the hand is nearer than the links
    assert "clearance of arm and hand, in the curve" in page
    assert nearest.replace(" at least", "") in " ".join(answer.out.split())
    assert not any(drawn["contacts"])  # as in pick.json
    assert any(drawn["grips"])
    assert drawn["rises"][-1] == pytest.approx(written["simulated"]["rose_m"], abs=0.005)
    stages = [motion["stage"] for motion in written["motions"]]
    assert stages == ["move", "approach", "lift", "lift"]
    assert all(motion["certified"] for motion in written["motions"])
    openings = [motion["opening_m"] for motion in written["motions"]]
    assert openings[:2] == pytest.approx([round(openings[0] / 0.002) * 0.002] * 2, abs=1e-9)  # as certified
    assert openings[2:] == [written["grasp_width_m"]] * 2
    assert (out / "pick.html").stat().st_size > 100_000
    robot, end = panda(), np.asarray(panda().home)
    for motion in written["motions"]:
        curve = load_motion(out / motion["file"], robot)
        q = curve.at(np.linspace(0.0, curve.duration, 200))[0]
        np.testing.assert_allclose(q[0], end, atol=1e-6)  # each begins where the one before ends
        end = q[-1]
        spheres = RobotSpheres(robot, opening=motion["opening_m"])
        at = spheres.centers(q).reshape(-1, 3)
        radii = np.tile(spheres.spheres.radii, len(q))
        moving = np.tile(spheres.spheres.link > 0, len(q))
        for name, solid in OBJECTS.items():
            if name != "box":
                assert (solid.distance(at[moving]) - radii[moving]).min() > 0.0
    lifted = robot.tcp(end)[:3, 3]
    taken = robot.tcp(load_motion(out / "2-approach.json", robot).position[-1])[:3, 3]
    np.testing.assert_allclose(lifted - taken, (0.0, 0.0, 0.15), atol=2e-3)


def test_a_pick_that_the_twin_does_not_hold_is_not_to_be_executed(
    run: RunCommand, map_file: Path, grasps: Path, tmp_path: Path
) -> None:
    """A grasp that closes 3 cm above the box is planned, and holds nothing in physics."""
    values = json.loads(grasps.read_text())
    best = values["grasps"][0]
    x, y, z = best["T_world_pregrasp"]["position"]
    best["T_world_tcp"] = best["T_world_pregrasp"] | {"position": [x, y, z - 0.01]}
    grasps.write_text(json.dumps(values))
    out = tmp_path / "out"
    out.mkdir()
    (out / "4-lift.json").write_text("of an earlier pick")
    answer = run("plan-pick", "--map", map_file, "--grasp", grasps, "--grasp-index", 0, "--speed", 0.5, "--out", out)
    assert_refused(answer, "should not be executed: nothing held")
    written = json.loads((out / "pick.json").read_text())
    assert not written["execute"]
    assert written["simulated"]["outcome"] == "nothing held"
    assert written["simulated"]["reason"] == "; ".join(written["problems"])
    files = {path.name for path in out.glob("[0-9]*")}
    assert files == {motion["file"] for motion in written["motions"]} == {"1-move.json", "2-approach.json"}


def test_grasps_of_a_map_that_changed_are_refused(
    run: RunCommand, map_file: Path, grasps: Path, tmp_path: Path
) -> None:
    model().select(torch.arange(10_000)).save(map_file)
    words = ("--map", map_file, "--grasp", grasps, "--out", tmp_path / "out")
    assert_refused(run("plan-pick", *words), "is of another map, or the map changed")
    assert not (tmp_path / "out").exists()


def test_rows_of_another_number_of_gaussians_are_refused(
    run: RunCommand, map_file: Path, grasps: Path, tmp_path: Path
) -> None:
    """Without the recording no flying pixel is removed, and the rows would be those of other Gaussians."""
    values = json.loads(grasps.read_text())
    grasps.write_text(json.dumps(values | {"map_gaussians": values["map_gaussians"] + 1}))
    words = ("--map", map_file, "--grasp", grasps, "--out", tmp_path / "out")
    assert_refused(run("plan-pick", *words), "Gaussians without flying pixels; there are")
    grasps.write_text(json.dumps(values | {"target_rows": [-1]}))
    assert_refused(run("plan-pick", *words), "is no file of grasps")


@pytest.mark.long
def test_grasps_have_the_ranks_of_the_table_and_of_grasp_index(
    run: RunCommand, map_file: Path, grasps: Path, tmp_path: Path
) -> None:
    words = ("plan-pick", "--map", map_file, "--grasp", grasps, "--out", tmp_path / "out", "--overwrite")
    assert "grasp 0, " in run(*words).out
    assert "grasp 2, " in run(*words, "--grasp-index", 2).out


def test_a_rank_that_does_not_exist_is_refused(run: RunCommand, map_file: Path, grasps: Path) -> None:
    words = ("--map", map_file, "--grasp", grasps, "--grasp-index", 7)
    assert_refused(run("plan-pick", *words), "--grasp-index: is 7, of 3 grasps")


@pytest.mark.parametrize(
    ("start", "mistake"),
    [
        ("0 1 0", "--start: has 3 values. Fix: panda has 7 joints"),
        ("0 -45 0 -135 0 90 45", "its limits are -1.76 to 1.76 rad: degrees?"),
        ("0 -0.785 0 -2.356 0 1.571 2.95", "joint 6 (panda_joint7) is 2.95, its limits are -2.897 to 2.897 rad"),
        ("here", "--start: is here. Fix: give numbers"),
    ],
)
def test_a_wrong_start_is_named_before_libraries_load(tmp_path: Path, start: str, mistake: str) -> None:
    """The limits are those of the data sheet: ±1.7628 rad and ±2.8973 rad."""
    for name in ("map.ply", "grasp.json"):
        (tmp_path / name).write_text(json.dumps(grasp_file_values()))
    words = ["plan-pick", "--map", "map.ply", "--grasp", "grasp.json", "--start", *start.split()]
    heavy = ("torch", "cv2", "mujoco", "scipy")
    program = (
        f"import sys\nfrom splatbot.cli import main\nprint(main({words!r}), [m for m in {heavy!r} if m in sys.modules])"
    )
    answer = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=True, timeout=120
    )
    assert answer.stdout == "2 []\n"
    assert mistake in answer.stderr


def test_a_search_without_grasps_is_refused_with_its_reason_and_change(
    run: RunCommand, map_file: Path, tmp_path: Path
) -> None:
    """The green box is 120 mm wide, and the hand opens 80 mm."""
    out = tmp_path / "grasp"
    assert run("grasp", "--map", map_file, "--target", "green box", "--out", out).code == 1
    for command in (("plan-pick",), ("plan-pick", "--grasp-index", 1), ("plan", "--start", "home")):
        answer = run(*command, "--map", map_file, "--grasp", out / "grasp.json", "--out", tmp_path / "out")
        assert_refused(answer, "grasp.json: grasps: holds no grasp of green box: its faces are 120 mm apart")
        assert_fix_named(answer, "take a hand that opens wider")
        assert "--grasp-index" not in answer.err


def test_grasps_of_an_earlier_calibration_are_refused_by_plans_and_picks(
    run: RunCommand, map_file: Path, grasps: Path, tmp_path: Path
) -> None:
    scene = map_file.with_name("scene.yaml")
    Workspace(T_world_base=np.eye(4), joint_offsets=np.full(7, 0.01), offsets_of="panda").save(scene)
    words = ("--map", map_file, "--grasp", grasps, "--out", tmp_path / "out")
    for command in (("plan-pick",), ("plan", "--start", "home")):
        assert_refused(run(*command, *words), "joint_offsets: differ from those of the scene")
    values = json.loads(grasps.read_text())
    assert values.pop("joint_offsets") == []
    grasps.write_text(json.dumps(values))
    assert_refused(run("plan-pick", *words), "is no file of grasps")
    assert not (tmp_path / "out").exists()
