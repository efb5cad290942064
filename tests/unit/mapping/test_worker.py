"""Mapping in a thread: the tracker never waits for it, nothing is lost at the end, and what goes wrong is told."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from splatbot.frame import Frame
from splatbot.gaussians import GaussianModel
from splatbot.geometry import se3_exp
from splatbot.mapping.keyframes import Keyframe
from splatbot.mapping.mapper import Mapper, Observation
from splatbot.mapping.worker import MappingWorker
from splatbot.slam import Slam
from splatbot.tracking.features import Features
from splatbot.tracking.prepare import prepare
from tests.rgbd import Array, small_config, tabletop, wall_frame

NO_FEATURES = Features.none


def at(x: float) -> Array:
    return se3_exp([x, 0, 0, 0, 0, 0])


def insert(worker: MappingWorker, T: Array) -> None:
    worker.insert(prepare(wall_frame(T), small_config().tracking), T, NO_FEATURES)


def wants(worker: MappingWorker, T: Array) -> bool:
    return worker.wants(prepare(wall_frame(T), small_config().tracking), T)


def wait_until(true: Callable[[], bool]) -> None:
    for _ in range(2000):
        if true():
            return
        time.sleep(0.005)
    pytest.fail("the worker did not get there in 10 s")


@pytest.fixture(autouse=True)
def _restore_threads() -> Iterator[None]:
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def mapper() -> Mapper:
    return Mapper(small_config())


def test_what_was_handed_over_is_in_the_map_once_finished(mapper: Mapper) -> None:
    worker = MappingWorker(mapper)
    for x in (0.0, 0.4, 0.8):
        insert(worker, at(x))
    worker.finish()
    assert [k.number for k in worker.keyframes] == [0, 1, 2]
    assert set(worker.snapshot().model.anchors.tolist()) == {0, 1, 2}
    assert len(worker.snapshot().model) == worker.size
    assert mapper.owed == 0


def test_a_worker_that_is_alone_makes_the_map_that_the_mapper_makes() -> None:
    config = small_config(mapping__refine_iterations=0)
    alone, worker = Mapper(config), MappingWorker(Mapper(config))
    for x in (0.0, 0.4):
        alone.insert(prepare(wall_frame(at(x)), config.tracking), at(x), NO_FEATURES)
        insert(worker, at(x))
    worker.finish()
    alone.finish()
    assert torch.equal(worker.snapshot().model.means, alone.snapshot().model.means)
    assert torch.equal(worker.snapshot().model.opacity_logits, alone.snapshot().model.opacity_logits)


def test_a_keyframe_that_comes_before_a_loop_is_closed_moves_with_its_neighbour(mapper: Mapper) -> None:
    worker = MappingWorker(mapper)
    for x in (0.0, 0.4):
        insert(worker, at(x))
    with worker.paused():
        mapper.loops.correction = {0: np.eye(4), 1: at(0.1)}  # as a loop found by the thread leaves it
    insert(worker, at(0.8))
    with worker.paused():
        moved = worker.close_loops()
    np.testing.assert_allclose(moved[2], at(0.1))
    placed = {k.number: k.T_world_camera[0, 3] for k in worker.keyframes}
    assert placed == pytest.approx({0: 0.0, 1: 0.5, 2: 0.9})
    assert not worker.has_loop
    worker.close()


def test_a_loop_waits_for_the_keyframes_that_wait_and_no_frame_waits_for_either(
    mapper: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    may_fuse, fuse = threading.Event(), mapper.fuse

    def slow(observation: Observation, keyframe: Keyframe) -> None:
        assert may_fuse.wait(20)
        fuse(observation, keyframe)

    worker = MappingWorker(mapper)
    for x in (0.0, 0.4):
        insert(worker, at(x))
    with worker.paused():
        monkeypatch.setattr(mapper, "fuse", slow)
        mapper.loops.correction = {0: np.eye(4), 1: at(0.1)}
    insert(worker, at(0.8))
    assert not worker.has_loop
    assert not wants(worker, at(1.2))
    may_fuse.set()
    wait_until(lambda: worker.has_loop)
    with worker.paused():
        assert len(worker.close_loops()) == 3
    assert wants(worker, at(1.2))
    worker.close()


def test_handing_over_does_not_wait_for_fusion(mapper: Mapper, monkeypatch: pytest.MonkeyPatch) -> None:
    gate = threading.Event()
    fuse = mapper.fuse

    def slow(observation: Observation, keyframe: Keyframe) -> None:
        gate.wait(10)
        fuse(observation, keyframe)

    monkeypatch.setattr(mapper, "fuse", slow)
    worker = MappingWorker(mapper)
    insert(worker, at(0.0))  # would not return before the gate opens
    assert len(worker.keyframes) == 1
    assert len(worker.keyframes[0].reference.levels) == 3  # so the next frame can be tracked already
    assert len(worker.snapshot().model) == 0
    gate.set()
    worker.close()
    assert len(worker.snapshot().model) > 300


def test_what_waits_can_be_tracked_against_before_what_came_earlier_is_in_the_map(
    mapper: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, done = threading.Event(), []
    fuse, add = mapper.fuse, mapper.add_keyframe

    def slow(observation: Observation, keyframe: Keyframe) -> None:
        gate.wait(10)
        fuse(observation, keyframe)
        done.append(f"{keyframe.number} fused")

    def told(observation: Observation, *, provisional: bool = False) -> Keyframe:
        keyframe = add(observation, provisional=provisional)
        done.append(f"{keyframe.number} tracked against")
        return keyframe

    monkeypatch.setattr(mapper, "fuse", slow)
    monkeypatch.setattr(mapper, "add_keyframe", told)
    worker = MappingWorker(mapper)
    for x in (0.0, 0.4, 0.8):
        insert(worker, at(x))
    gate.set()
    worker.finish()
    assert [k.number for k in worker.keyframes] == [0, 1, 2]
    assert done == [
        "0 tracked against",
        "0 fused",
        "1 tracked against",
        "2 tracked against",
        "1 fused",
        "2 fused",
    ]


def test_a_view_that_waits_is_not_wanted_again_and_too_many_waiting_are_too_many(
    mapper: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate = threading.Event()
    monkeypatch.setattr(mapper, "fuse", lambda *_: gate.wait(10))
    worker = MappingWorker(mapper, backlog=3)
    for x in (0.0, 0.4):
        assert wants(worker, at(x))
        insert(worker, at(x))
        assert not wants(worker, at(x))
    assert wants(worker, at(0.8))
    insert(worker, at(0.8))
    assert not wants(worker, at(1.2))
    gate.set()
    wait_until(lambda: wants(worker, at(1.2)))
    worker.close()


def test_what_a_look_has_revealed_is_wanted_once(mapper: Mapper, monkeypatch: pytest.MonkeyPatch) -> None:
    gate = threading.Event()
    worker = MappingWorker(mapper)
    insert(worker, at(0.0))
    with worker.paused():
        mapper._revealed = True  # as a look at what the map has nothing of leaves it
        monkeypatch.setattr(mapper, "fuse", lambda *_: gate.wait(10))
    assert wants(worker, at(0.01))
    insert(worker, at(0.01))
    wait_until(lambda: len(worker.keyframes) == 2)
    assert not wants(worker, at(0.02))
    gate.set()
    worker.close()


def test_the_keyframes_that_a_reader_holds_do_not_change_under_it(mapper: Mapper) -> None:
    worker = MappingWorker(mapper)
    insert(worker, at(0.0))
    held = worker.keyframes
    insert(worker, at(0.4))
    worker.finish()
    assert len(held) == 1
    assert len(worker.keyframes) == 2


def test_what_goes_wrong_in_the_thread_is_told_and_the_last_published_map_stays(
    mapper: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    worker = MappingWorker(mapper)
    insert(worker, at(0.0))
    wait_until(lambda: worker.snapshot().map_version == 2)  # fused, refined
    kept = worker.snapshot()

    def broken(observation: Observation, keyframe: Keyframe) -> None:
        raise ValueError("broken on purpose")

    monkeypatch.setattr(mapper, "fuse", broken)
    insert(worker, at(0.4))
    with pytest.raises(RuntimeError, match="mapping has failed") as told:
        wait_until(lambda: wants(worker, at(0.0)))
    assert isinstance(told.value.__cause__, ValueError)
    with pytest.raises(RuntimeError):
        worker.finish()
    worker.close()
    assert worker.snapshot() is kept


def test_refinement_waits_while_the_robot_moves_and_catches_up_once_it_stands(mapper: Mapper) -> None:
    worker = MappingWorker(mapper)
    worker.hold(True)
    insert(worker, at(0.0))
    wait_until(lambda: len(worker.snapshot().model) > 0)
    time.sleep(0.05)
    assert mapper.owed == mapper.config.mapping.refine_iterations
    worker.hold(False)
    wait_until(lambda: mapper.owed == 0)
    worker.close()


def test_closing_a_worker_that_never_began_or_twice_does_nothing(mapper: Mapper) -> None:
    worker = MappingWorker(mapper)
    worker.close()
    worker.close()
    worker.finish()
    assert len(worker.snapshot().model) == 0


def test_slam_with_a_mapping_thread_tracks_and_maps_the_tabletop() -> None:
    frames, poses = tabletop()
    slam = Slam(small_config(mapping__threaded=True))
    for frame in frames:
        slam.process(frame)
    slam.finish()
    for result, truth in zip(slam.results, poses, strict=True):
        assert result.T_world_camera is not None
        assert np.linalg.norm(result.T_world_camera[:3, 3] - truth[:3, 3]) < 3e-3
    assert isinstance(slam.snapshot().model, GaussianModel)
    assert len(slam.snapshot().model) > 1500


def test_a_moving_robot_s_map_is_refined_once_it_stands_also_without_a_thread() -> None:
    frames, _ = tabletop()

    def joints(frame: Frame, angle: float) -> Frame:
        return replace(frame, joints=np.array([angle]))

    slam = Slam(small_config())
    slam.process(joints(frames[0], 0.0))
    assert slam.process(joints(frames[10], 0.5)).keyframe
    assert slam._mapper.owed == slam.config.mapping.refine_iterations  # type: ignore[union-attr]
    slam.process(joints(frames[11], 0.5))
    assert slam._mapper.owed == 0  # type: ignore[union-attr]


def test_a_pause_waits_for_the_step_under_way_not_for_all_that_is_owed(
    mapper: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: list[int] = []

    def refine(count: int) -> None:  # as if there were always more to do
        steps.append(count)
        time.sleep(0.01)

    monkeypatch.setattr(mapper, "refine", refine)
    worker = MappingWorker(mapper)
    insert(worker, at(0.0))
    mapper.owed = 10**9
    for _ in range(5):
        done = len(steps)
        wait_until(lambda done=done: len(steps) > done + 2)  # type: ignore[misc]
        asked = len(steps)
        with worker.paused():
            begun = len(steps)
            time.sleep(0.03)
            assert len(steps) == begun
        assert begun - asked <= 2
    mapper.owed = 0
    worker.close()


def test_closing_a_loop_leaves_refinement_to_the_thread(mapper: Mapper, monkeypatch: pytest.MonkeyPatch) -> None:
    by: list[str] = []
    refine = mapper.refine

    def told(steps: int) -> None:
        if steps:
            by.append(threading.current_thread().name)
        refine(steps)

    monkeypatch.setattr(mapper, "refine", told)
    worker = MappingWorker(mapper)
    for x in (0.0, 0.4):
        insert(worker, at(x))
    with worker.paused():
        mapper.loops.correction = {0: np.eye(4), 1: at(0.1)}
        mapper.owed = 40
        assert worker.close_loops()
        assert mapper.owed == 40 + mapper.config.mapping.refine_iterations
    wait_until(lambda: mapper.owed == 0)
    assert set(by) == {"mapping"}
    worker.close()


def test_a_program_that_breaks_while_mapping_goes_on_ends_with_its_own_error() -> None:
    program = """
from splatbot.slam import Slam
from tests.rgbd import small_config, tabletop
Slam(small_config(mapping__threaded=True, mapping__refine_iterations=10**6)).process(tabletop()[0][0])
raise RuntimeError("on purpose")
"""
    root = Path(__file__).parents[3]
    ended = subprocess.run([sys.executable, "-c", program], cwd=root, capture_output=True, text=True, timeout=120)
    assert ended.stderr.rstrip().endswith("RuntimeError: on purpose")
    assert ended.returncode == 1
