"""The Python snippets of README and guides run as they are printed."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatbot.bench.tabletop import tabletop
from splatbot.cli import main
from splatbot.client import Client
from splatbot.collision import RobotSpheres
from splatbot.frame import PosePrior
from splatbot.gaussians import GaussianModel
from splatbot.grasping.affordance import NameHint, find_target
from splatbot.grasping.language import LanguageAffordance
from splatbot.grasping.pick import Picker
from splatbot.grasping.sampler import GraspSampler
from splatbot.logs import open_log
from splatbot.planning import certify_motion, time_path
from splatbot.robots.controllers import FakeController
from splatbot.robots.grippers import FakeGripper
from splatbot.robots.panda import panda
from splatbot.segmentation import segment
from splatbot.service_key import key_file
from splatbot.serving import serving
from tests.fake_ros_arm import FakeRosArm
from tests.unit.grasping.objects import CAN, OBJECTS, colored
from tests.unit.planning.test_timing import path_of

ROOT = Path(__file__).parents[2]
DOCUMENTS = ["README.md", *(str(p.relative_to(ROOT)) for p in sorted((ROOT / "docs" / "guide").glob("*.md")))]
LOG = "synthetic:tabletop?frames=4&width=160&height=120"
QUICK = ("--quiet", "--set", "mapping.final_iterations=20")
Names = dict[str, Any]


def snippets(document: str) -> list[str]:
    """Return the Python blocks of a document."""
    return re.findall(r"^```python\n(.*?)^```", (ROOT / document).read_text("utf-8"), flags=re.S | re.M)


WITH_SNIPPETS = [name for name in DOCUMENTS if snippets(name)]


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the run ``runs/desk``, and its map as ``map.ply``."""
    folder = tmp_path_factory.mktemp("snippets")
    assert main(["map", LOG, "--out", str(folder / "runs" / "desk"), *QUICK]) == 0
    (folder / "map.ply").write_bytes((folder / "runs" / "desk" / "map.ply").read_bytes())
    return folder


def _table() -> GaussianModel:
    return colored(OBJECTS | {"can": CAN}, 24_000, {"can": (0.8, 0.1, 0.1)})


def _formats(desk: Path) -> Names:
    GaussianModel.load(desk / "map.ply").save(desk / "scene.spz")
    return {}


def _compact(desk: Path) -> Names:
    GaussianModel.load(desk / "runs" / "desk" / "map.ply").save(desk / "scene.ply")
    return {}


def _merging(desk: Path) -> Names:
    log = "synthetic:tabletop?frames=30&width=160&height=120"
    assert main(["map", log, "--out", str(desk / "runs" / "monday"), "--no-report", *QUICK]) == 0
    shutil.copytree(desk / "runs" / "monday", desk / "runs" / "tuesday")
    return {}


def _grasping(desk: Path) -> Names:
    return {"snapshot": _table(), "T_world_base": np.eye(4), "panda": panda, "observers": None}


def _picking(desk: Path) -> Names:
    controller = FakeController(panda().home)
    names = {
        "scene": segment(_table(), np.eye(4)),
        "robot": panda(),
        "controller": controller,
        "gripper": FakeGripper(),
    }
    return names | {x.__name__: x for x in (Picker, GraspSampler, find_target, NameHint, LanguageAffordance)}


def _planning(desk: Path) -> Names:
    tabletop().gaussians(10_000).save(desk / "map.ply")  # the snippet's arm needs a map around its base
    goal = np.array([-0.7, 0.3, 0.0, -2.0, 0.0, 2.4, 0.8])
    later = tabletop().gaussians(10_000)
    names = {"T_world_base": np.eye(4), "start": panda().home, "goal": goal, "later": later}
    names["changed"] = np.zeros(len(later), bool)
    return names | {"here": panda().home, "controller": FakeController(panda().home)}


def _tiles(desk: Path) -> Names:
    assert main(["tile", str(desk / "runs" / "desk"), "--out", str(desk / "building-tiles")]) == 0
    return {"camera": open_log(LOG).camera, "T_world_camera": np.eye(4)}


def _tracking(desk: Path) -> Names:
    return {"replace": replace, "PosePrior": PosePrior, "covariance": 1e-4 * np.eye(6), "T": np.eye(4)}


CONTEXTS: dict[str, Callable[[Path], Names]] = {
    "docs/guide/compact.md": _compact,
    "docs/guide/formats.md": _formats,
    "docs/guide/grasping.md": _grasping,
    "docs/guide/merging.md": _merging,
    "docs/guide/picking.md": _picking,
    "docs/guide/planning.md": _planning,
    "docs/guide/tiles.md": _tiles,
    "docs/guide/tracking.md": _tracking,
}
RESULTS: dict[str, Callable[[Names], bool]] = {
    "docs/guide/collision.md": lambda names: len(names["field"]) > 100,
    "docs/guide/grasping.md": lambda names: 0.0 < names["grasp"].width < 0.08,
    "docs/guide/picking.md": lambda names: names["result"].grasp is not None,
    "docs/guide/planning.md": lambda names: names["followed"].state == "done",
    "docs/guide/tiles.md": lambda names: names["image"].std() > 0.05,
    "docs/guide/tracking.md": lambda names: names["result"].verdict == "ok" and names["frame"].prior is not None,
    "docs/guide/twin.md": lambda names: names["result"].steps > 1000,
}
OF_A_SERVICE = [
    "docs/guide/robot-in-view.md",
    "docs/guide/ros.md",
    "docs/guide/service.md",
    "docs/guide/several-cameras.md",
    "docs/guide/versions.md",
]
OF_AN_ARM = "docs/guide/arms.md"


@pytest.mark.parametrize("name", [name for name in WITH_SNIPPETS if name not in (*OF_A_SERVICE, OF_AN_ARM)])
def test_the_snippets_of_a_document_run_in_turn(name: str, desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(desk)
    names = CONTEXTS.get(name, lambda _: {})(desk)
    for text in snippets(name):
        exec(compile(text, name, "exec"), names)
    assert RESULTS.get(name, lambda _: True)(names)


@pytest.fixture(scope="module")
def served(desk: Path) -> Iterator[str]:
    """Address of a service of the map, which refines its maps briefly."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SPLATBOT_MAPPING__FINAL_ITERATIONS", "20")
        command = serving("--map", str(desk / "runs" / "desk"), "--data", str(desk / "maps"), log=desk / "log.txt")
        with command as service:
            yield service.url


def test_the_snippet_of_an_arm_moves_one_behind_rosbridge() -> None:
    (code,) = snippets(OF_AN_ARM)
    robot = panda()
    trajectory = time_path(path_of(np.stack([robot.home, robot.home + 0.1])), RobotSpheres(robot), None)
    names: Names = {"motion": certify_motion(trajectory.slowed(10.0), RobotSpheres(robot, margin=1e-3), None)}
    with FakeRosArm(robot.chain.names, robot.home) as arm:
        exec(compile(code.replace("ws://robot:9090", arm.address), OF_AN_ARM, "exec"), names)
        assert np.abs(arm.position - robot.home - 0.1).max() < 5e-3


@pytest.mark.parametrize("name", OF_A_SERVICE)
def test_the_snippets_of_a_client_run_against_a_service(name: str, served: str) -> None:
    address = served.split("//")[1]
    for text in snippets(name):
        assert re.search(r"(localhost|127\.0\.0\.1):8000", text)
        here = re.sub(r"(localhost|127\.0\.0\.1):8000", address, text)
        if "ros.run()" not in here:
            exec(compile(here, name, "exec"), {})
            continue
        here += "ros.terminate()\n"  # ends the reactor of its process
        done = subprocess.run([sys.executable, "-c", here], capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, done.stderr


@pytest.mark.long
def test_the_curl_requests_of_versions_are_answered(served: str) -> None:
    (commands,) = re.findall(r"```sh\n(.*?)```", (ROOT / "docs" / "guide" / "versions.md").read_text(), re.DOTALL)
    log = "synthetic:tabletop?frames=16&width=160&height=120"
    with Client(served) as robot:
        for name in ("monday", "tuesday"):
            assert robot.wait(robot.create_map(name, log)["id"])["state"] == "succeeded"
        here = commands.replace("localhost:8000", served.split("//")[1])
        here = "set -e\n" + here.replace("~/.local/state/splatbot/service-key", str(key_file()))
        done = subprocess.run(["bash", "-c", here], capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        listed = json.loads(robot.request("GET", "/v1/jobs")[0])["jobs"]
        jobs = [job for job in listed if job["kind"] in ("diff", "merge")]
        assert [robot.wait(job["id"])["state"] for job in jobs[-2:]] == ["succeeded"] * 2


@pytest.fixture(scope="module")
def placed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a service of a run with a robot base."""
    folder = tmp_path_factory.mktemp("requests")
    run = str(folder / "run")
    assert main(["map", "synthetic:tabletop?frames=20&width=320&height=240", "--out", run, "--quiet"]) == 0
    assert main(["info", run, "--fit-plane", "--up", "0", "-0.867", "-0.498"]) == 0
    with serving("--map", run, log=folder / "log.txt") as service:
        yield service.url


@pytest.mark.long
def test_each_request_of_the_guide_is_answered(placed: str) -> None:
    text = (ROOT / "docs" / "guide" / "requests.md").read_text()
    commands = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
    assert len(commands) == 6
    for command in commands:
        here = command.replace("localhost:8000", placed.split("//")[1]).replace("curl -s", "curl -s --fail-with-body")
        here = here.replace(
            '"robot": "panda"}', '"robot": "panda", "accept_implied": true}'
        )  # the box is seen from one side
        done = subprocess.run(["bash", "-c", here], capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        assert json.loads(done.stdout)["map_version"] == 1


def test_every_document_with_snippets_is_run() -> None:
    assert set(CONTEXTS) | set(OF_A_SERVICE) <= set(WITH_SNIPPETS)
