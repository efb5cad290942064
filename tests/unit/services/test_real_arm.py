"""An arm on the network as an arm of the service: behind the gate, the leases and the emergency stop."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from splatbot.cli.serve import serve
from splatbot.collision import RobotSpheres
from splatbot.errors import DeviceError, InputError
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.geometry import pose_from_quat
from splatbot.planning import time_path
from splatbot.robots.controllers.addresses import connect_arm
from splatbot.robots.controllers.ros import RosController
from splatbot.robots.controllers.ur import UrController
from splatbot.robots.store import load_robot
from splatbot.services.arms import REAL, Arms
from splatbot.services.leases import LeaseError
from splatbot.services.motion_gate import MotionRequest
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore
from splatbot.workspace import Workspace
from tests.contracts.conftest import running
from tests.fake_ros_arm import ACTION, FakeRosArm
from tests.fake_ur import FakeUr
from tests.unit.planning.test_timing import path_of
from tests.waiting import until

PANDA = load_robot("panda")


def _ball() -> GaussianModel:
    return GaussianModel.from_activated(
        means=[[3.0, 0, 0]], quats=[[1.0, 0, 0, 0]], scales=[[0.05] * 3], opacities=[0.9], colors=[[1.0, 0, 0]]
    )


class Scene:
    """An arm behind a socket, and the service's arms."""

    def __init__(self, arm: FakeRosArm) -> None:
        self.arm = arm
        self.controller = connect_arm(f"ros:{arm.address}{ACTION}?update_rate=1000&max_age=3&lag=3", PANDA)
        self.store = MapStore()
        workspace = Workspace(T_world_base=pose_from_quat((0, 0, 0), (1, 0, 0, 0)))
        self.served = self.store.add(
            "desk", source="a", state="static", snapshot=Snapshot(_ball(), 1), workspace=workspace
        )
        self.arms = Arms(self.store)
        self.arms.connect(PANDA, self.controller)

    def request(self, turn: float, slowed: float) -> MotionRequest:
        """Return a motion of all joints by an angle [rad] from where the arm is."""
        at = self.arms.get(REAL).feedback
        assert at is not None
        path = path_of(np.stack([at.position, at.position + turn]))
        motion = time_path(path, RobotSpheres(PANDA), None).slowed(slowed)
        return MotionRequest(motion, "panda", "desk", self.served.generation)


@pytest.fixture
def scene() -> Iterator[Scene]:
    with FakeRosArm(PANDA.chain.names, PANDA.home) as arm:
        made = Scene(arm)
        yield made
        made.arms.close(5.0)
        made.controller.close()


def _ended(scene: Scene, job: str) -> str:
    until(lambda: scene.arms.motions.get(job).state in ("succeeded", "failed", "cancelled"))
    found = scene.arms.motions.get(job)
    return f"{found.state}: {found.detail}"


def test_a_motion_needs_the_lease_and_is_executed_on_the_arm(scene: Scene) -> None:
    request = scene.request(0.1, 2.0)
    with pytest.raises(LeaseError):
        scene.arms.send(REAL, request, lease="none")
    lease = scene.arms.lease(REAL, "a", seconds=30.0)
    job = scene.arms.send(REAL, request, lease=lease.id)
    assert _ended(scene, job.id).startswith("succeeded")
    np.testing.assert_allclose(scene.arm.position, PANDA.home + 0.1, atol=0.005)


def test_an_emergency_stop_and_the_end_of_a_lease_cancel_the_goal(scene: Scene) -> None:
    for end in (lambda lease: scene.arms.stop_all("me"), lambda lease: scene.arms.leases.release(lease)):
        lease = scene.arms.lease(REAL, "a", seconds=30.0, preempt=True)
        job = scene.arms.send(REAL, scene.request(0.2, 20.0), lease=lease.id)
        until(lambda: scene.arm.commands)  # the goal runs
        cancels = scene.arm.cancels
        end(lease.id)
        assert "was stopped" in _ended(scene, job.id)
        assert scene.arm.cancels > cancels
        scene.arm.commands.clear()
        scene.arms.reset()


def test_plans_start_where_the_arm_was_moved_by_hand(scene: Scene) -> None:
    def shown() -> bool:
        feedback = scene.arms.get(REAL).feedback
        return feedback is not None and np.allclose(feedback.position, PANDA.home + 0.05)

    scene.arm.position = PANDA.home + 0.05
    until(shown)


def test_a_lost_connection_ends_the_motion_as_failed(scene: Scene) -> None:
    scene.arm.behaviour.drop_at = 0.5
    lease = scene.arms.lease(REAL, "a", seconds=30.0)
    job = scene.arms.send(REAL, scene.request(0.2, 20.0), lease=lease.id)
    assert "connection" in _ended(scene, job.id)
    until(lambda: scene.arm.cancels > 0)


def test_clients_without_a_key_cannot_lease_it(scene: Scene) -> None:
    with running(ServiceSettings(), scene.store) as service:
        service.runtime.arms.connect(PANDA, scene.controller)
        listed = service.client.get("/v1/arms").json()["arms"]
        assert [arm["name"] for arm in listed] == ["fake", "twin", "real"]
        shown = service.client.get("/v1/arms/real").json()
        assert (shown["robot"], shown["state"]) == ("panda", "idle")
        answer = httpx.post(f"{service.url}/v1/arms/real/lease", json={"seconds": 5})
        assert answer.status_code == 401


def test_an_address_names_the_arm_and_its_options(monkeypatch: pytest.MonkeyPatch) -> None:
    ur5e = load_robot("ur5e")
    fake = FakeUr(ur5e.home.copy())
    fake.install(monkeypatch)
    controller = connect_arm("ur:ur?frequency=125&path_tolerance=0.02", ur5e)
    assert isinstance(controller, UrController)
    assert (controller.period, controller.options.path_tolerance) == (0.008, 0.02)
    with FakeRosArm(PANDA.chain.names, PANDA.home, ros=1) as arm:
        connected = connect_arm(f"ros:{arm.address}{ACTION}?ros=1&states=/joint_states&lag=0.5", PANDA)
        assert isinstance(connected, RosController)
        assert connected.options.lag == 0.5
        connected.close()


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("fake", "no address"),
        ("ur:", "no address"),
        ("ros:", "no address"),
        ("ros:ws://[", "malformed"),
        ("ros:http://host/action", "no address"),
        ("ros:ws://host:9090", "no address"),
        ("ros:ws://host:9090/a?speed=2", "no option 'speed'"),
        ("ros:ws://host:9090/a?lag=soon", "is 'soon'"),
        ("ros:ws://host:9090/a?lag=-1", "above 0"),
        ("ros:ws://host:9090/a?ros=3", "give 1 or 2"),
    ],
)
def test_an_address_without_sense_is_named(address: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        connect_arm(address, PANDA)


def test_serving_an_arm_needs_its_model_keys_and_an_answer(tmp_path: Path) -> None:
    _ball().save(tmp_path / "map.ply")
    with pytest.raises(InputError, match="has no model"):
        serve(map=tmp_path / "map.ply", arm="ur:host", port=0)
    with pytest.raises(InputError, match="without a key"):
        serve(map=tmp_path / "map.ply", robot="ur5e", arm="ur:host", insecure_no_auth=True, port=0)
    with pytest.raises(DeviceError, match="cannot be reached"):
        serve(map=tmp_path / "map.ply", robot="panda", arm=f"ros:ws://127.0.0.1:9{ACTION}", port=0)
