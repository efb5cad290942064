"""Mapping in a thread: tracking never waits for it, no keyframe is lost at the end, and its errors are raised."""

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
from splatbot.mapping.executor import Executor, InlineExecutor, ThreadExecutor
from splatbot.mapping.keyframes import Keyframe
from splatbot.mapping.mapper import CONSTANTS, Mapper
from splatbot.mapping.observation import Observation
from splatbot.slam import Slam
from splatbot.tracking.prepare import prepare
from tests.rgbd import Array, small_config, tabletop, wall_frame


def at(x: float) -> Array:
    return se3_exp([x, 0, 0, 0, 0, 0])


def observation(T: Array) -> Observation:
    return Observation(prepare(wall_frame(T), small_config().tracking), T)


class Threaded:
    """A mapper and its thread, as :class:`Slam` uses them."""

    def __init__(self, mapper: Mapper) -> None:
        self.mapper = mapper
        self.executor = ThreadExecutor(mapper)

    def insert(self, T: Array) -> None:
        self.mapper.submit(observation(T))
        self.executor.run()

    def should_insert(self, T: Array) -> bool:
        return self.mapper.should_insert(observation(T))

    def set_robot_moving(self, moving: bool) -> None:
        self.mapper.set_robot_moving(moving)
        self.executor.run()


def wait_until(condition: Callable[[], bool]) -> None:
    for _ in range(2000):
        if condition():
            return
        time.sleep(0.005)
    pytest.fail("the condition did not hold within 10 s")


@pytest.fixture(autouse=True)
def _restore_threads() -> Iterator[None]:
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def mapper() -> Mapper:
    return Mapper(small_config())


@pytest.fixture
def threaded(mapper: Mapper) -> Iterator[Threaded]:
    threaded = Threaded(mapper)
    yield threaded
    threaded.executor.close()


def hold_fusion(mapper: Mapper, monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Let depth fusion wait until the returned event is set."""
    gate, fuse = threading.Event(), mapper.fuse

    def slow(observation: Observation, keyframe: Keyframe) -> None:
        assert gate.wait(20)
        fuse(observation, keyframe)

    monkeypatch.setattr(mapper, "fuse", slow)
    return gate


def test_all_submitted_keyframes_are_in_the_map_once_finished(threaded: Threaded) -> None:
    for x in (0.0, 0.4, 0.8):
        threaded.insert(at(x))
    threaded.executor.finish()
    mapper, model = threaded.mapper, threaded.executor.snapshot().model
    assert [k.number for k in mapper.keyframes] == [0, 1, 2]
    assert set(model.anchors.tolist()) == {0, 1, 2}
    assert len(model) == mapper.size
    assert mapper.pending_iterations == 0


def test_the_thread_makes_the_map_that_the_calling_thread_makes() -> None:
    config = small_config(mapping__refine_iterations=0)
    inline, threaded = Mapper(config), Mapper(config)
    executors: tuple[Executor, Executor] = InlineExecutor(inline), ThreadExecutor(threaded)
    for x in (0.0, 0.4):
        for mapper, executor in zip((inline, threaded), executors, strict=True):
            mapper.submit(observation(at(x)))
            executor.run()
    for executor in executors:
        executor.finish()
    alone, beside = (executor.snapshot() for executor in executors)
    assert torch.equal(alone.model.means, beside.model.means)
    assert torch.equal(alone.model.opacity_logits, beside.model.opacity_logits)
    assert alone.map_version == beside.map_version


def test_a_keyframe_that_comes_before_a_loop_is_closed_moves_with_its_neighbor(threaded: Threaded) -> None:
    mapper, executor = threaded.mapper, threaded.executor
    for x in (0.0, 0.4):
        threaded.insert(at(x))
    with executor.paused():
        mapper.loops.correction = {0: np.eye(4), 1: at(0.1)}  # as a loop that the thread found leaves it
    threaded.insert(at(0.8))
    with executor.paused():
        moved = mapper.close_loops()
    np.testing.assert_allclose(moved[2], at(0.1))
    placed = {k.number: k.T_world_camera[0, 3] for k in mapper.keyframes}
    assert placed == pytest.approx({0: 0.0, 1: 0.5, 2: 0.9})
    assert not mapper.has_loop


def test_a_loop_waits_for_the_submitted_keyframes_and_no_frame_waits_for_either(
    threaded: Threaded, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapper, executor = threaded.mapper, threaded.executor
    for x in (0.0, 0.4):
        threaded.insert(at(x))
    with executor.paused():
        may_fuse = hold_fusion(mapper, monkeypatch)
        mapper.loops.correction = {0: np.eye(4), 1: at(0.1)}
    threaded.insert(at(0.8))
    assert not mapper.has_loop
    assert not threaded.should_insert(at(1.2))
    may_fuse.set()
    wait_until(lambda: mapper.has_loop)
    with executor.paused():
        assert len(mapper.close_loops()) == 3
    assert threaded.should_insert(at(1.2))


def test_submitting_does_not_wait_for_fusion(threaded: Threaded, monkeypatch: pytest.MonkeyPatch) -> None:
    mapper, executor = threaded.mapper, threaded.executor
    gate = hold_fusion(mapper, monkeypatch)
    threaded.insert(at(0.0))  # would not return before the gate opens
    assert len(mapper.keyframes) == 1
    assert len(mapper.keyframes[0].reference.levels) == 3  # so the next frame can be tracked already
    assert len(executor.snapshot().model) == 0
    gate.set()
    executor.close()
    assert len(executor.snapshot().model) > 300


def test_keyframes_that_wait_can_be_tracked_against_before_earlier_ones_are_in_the_map(
    threaded: Threaded, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapper, executor = threaded.mapper, threaded.executor
    gate, done = threading.Event(), []
    fuse, add = mapper.fuse, mapper.add_keyframe

    def slow(observation: Observation, keyframe: Keyframe) -> None:
        gate.wait(10)
        fuse(observation, keyframe)
        done.append(f"{keyframe.number} fused")

    def recorded() -> None:
        add()
        done.append(f"{mapper.keyframes[-1].number} tracked against")

    monkeypatch.setattr(mapper, "fuse", slow)
    monkeypatch.setattr(mapper, "add_keyframe", recorded)
    for x in (0.0, 0.4, 0.8):
        threaded.insert(at(x))
    gate.set()
    executor.finish()
    assert [k.number for k in mapper.keyframes] == [0, 1, 2]
    assert done == [
        "0 tracked against",
        "0 fused",
        "1 tracked against",
        "2 tracked against",
        "1 fused",
        "2 fused",
    ]


def test_a_view_that_waits_makes_no_second_keyframe_and_the_backlog_is_limited(
    threaded: Threaded, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert CONSTANTS.backlog == 3
    gate = threading.Event()
    monkeypatch.setattr(threaded.mapper, "fuse", lambda *_: gate.wait(10))
    for x in (0.0, 0.4):
        assert threaded.should_insert(at(x))
        threaded.insert(at(x))
        assert not threaded.should_insert(at(x))
    assert threaded.should_insert(at(0.8))
    threaded.insert(at(0.8))
    assert not threaded.should_insert(at(1.2))
    gate.set()
    wait_until(lambda: threaded.should_insert(at(1.2)))


def test_an_unmapped_view_makes_one_keyframe(threaded: Threaded, monkeypatch: pytest.MonkeyPatch) -> None:
    gate, mapper = threading.Event(), threaded.mapper
    threaded.insert(at(0.0))
    with threaded.executor.paused():
        mapper._unmapped_seen = {""}  # as an observed frame leaves it that the map does not cover
        monkeypatch.setattr(mapper, "fuse", lambda *_: gate.wait(10))
    assert threaded.should_insert(at(0.01))
    threaded.insert(at(0.01))
    wait_until(lambda: len(mapper.keyframes) == 2)
    assert not threaded.should_insert(at(0.02))
    gate.set()


def test_the_keyframes_that_a_reader_holds_do_not_change_under_it(threaded: Threaded) -> None:
    threaded.insert(at(0.0))
    held = threaded.mapper.keyframes
    threaded.insert(at(0.4))
    threaded.executor.finish()
    assert len(held) == 1
    assert len(threaded.mapper.keyframes) == 2


def test_submitted_keyframes_have_consecutive_numbers(threaded: Threaded) -> None:
    numbers = []
    for k in range(30):
        numbers.append(threaded.mapper.submit(observation(at(0.4 * k))).keyframe)
        threaded.executor.run()
    assert numbers == list(range(30))
    threaded.executor.close()
    assert [k.number for k in threaded.mapper.keyframes] == numbers


def test_an_error_in_the_thread_is_raised_and_keyframes_map_and_snapshot_are_as_before(
    threaded: Threaded, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapper, executor = threaded.mapper, threaded.executor
    threaded.insert(at(0.0))
    wait_until(lambda: executor.snapshot().map_version == 2)  # fused, refined
    kept, keyframes, model = executor.snapshot(), mapper.keyframes, mapper.model

    def broken(observation: Observation, keyframe: Keyframe) -> None:
        raise ValueError("broken on purpose")

    monkeypatch.setattr(mapper, "fuse", broken)
    threaded.insert(at(0.4))
    with pytest.raises(RuntimeError, match="mapping has failed") as raised:
        wait_until(lambda: bool(executor.run()))  # type: ignore[func-returns-value]
    assert isinstance(raised.value.__cause__, ValueError)
    with pytest.raises(RuntimeError):
        executor.finish()
    executor.close()
    assert executor.snapshot() is kept
    assert mapper.keyframes == keyframes
    assert mapper.model is model
    assert mapper.version == kept.map_version
    assert not mapper.has_observations


def test_refinement_waits_while_the_robot_moves_and_catches_up_once_it_stands(threaded: Threaded) -> None:
    mapper = threaded.mapper
    threaded.set_robot_moving(True)
    threaded.insert(at(0.0))
    wait_until(lambda: len(threaded.executor.snapshot().model) > 0)
    time.sleep(0.05)
    assert mapper.pending_iterations == mapper.config.mapping.refine_iterations
    threaded.set_robot_moving(False)
    wait_until(lambda: mapper.pending_iterations == 0)


def test_closing_an_executor_that_never_began_or_twice_does_nothing(threaded: Threaded) -> None:
    threaded.executor.close()
    threaded.executor.close()
    threaded.executor.finish()
    assert len(threaded.executor.snapshot().model) == 0


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
    assert slam._mapper.pending_iterations == slam.config.mapping.refine_iterations
    slam.process(joints(frames[11], 0.5))
    assert slam._mapper.pending_iterations == 0


def test_a_pause_waits_for_the_step_in_progress_not_for_all_pending_refinement(
    threaded: Threaded, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapper = threaded.mapper
    steps: list[bool] = []  # for each: whether a pause was requested when it began

    def refine(count: int) -> None:  # as if there were always more to do
        steps.append(threaded.executor._pause_requests > 0)
        time.sleep(0.01)

    monkeypatch.setattr(mapper, "refine", refine)
    threaded.insert(at(0.0))
    mapper.pending_iterations = 10**9
    for _ in range(5):
        done = len(steps)
        wait_until(lambda done=done: len(steps) > done + 2)  # type: ignore[misc]
        with threaded.executor.paused():
            begun = len(steps)
            time.sleep(0.03)
            assert len(steps) == begun
    assert sum(steps) <= 5  # one before each pause at most: it was chosen before the request
    mapper.pending_iterations = 0


def test_closing_a_loop_leaves_refinement_to_the_thread(threaded: Threaded, monkeypatch: pytest.MonkeyPatch) -> None:
    mapper, executor = threaded.mapper, threaded.executor
    threads: list[str] = []
    refine = mapper.refine

    def recorded(steps: int) -> None:
        threads.append(threading.current_thread().name)
        refine(steps)

    monkeypatch.setattr(mapper, "refine", recorded)
    for x in (0.0, 0.4):
        threaded.insert(at(x))
    with executor.paused():
        mapper.loops.correction = {0: np.eye(4), 1: at(0.1)}
        mapper.pending_iterations = 40
        assert mapper.close_loops()
        assert mapper.pending_iterations == 40 + mapper.config.mapping.refine_iterations
    wait_until(lambda: mapper.pending_iterations == 0)
    assert set(threads) == {"mapping"}


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
