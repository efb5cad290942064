"""The mapper: one writer, whose map stays within its bounds and whose snapshots stay as they were."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import torch

from splatbot.frame import Frame
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, se3_exp, transform_points
from splatbot.mapping.executor import InlineExecutor
from splatbot.mapping.insertion import view_of
from splatbot.mapping.mapper import Mapper
from splatbot.mapping.observation import GraphLocation, Observation
from splatbot.tracking.prepare import prepare
from tests.rgbd import CAMERA, small_config, tabletop, wall_frame
from tests.unit.mapping.conftest import insert, observe, should_insert

SIDE = se3_exp([0.1, 0, 0, 0, 0, 0])


def equal(a: GaussianModel, b: GaussianModel) -> bool:
    return all(torch.equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))


def with_ball(frame: Frame, depth: float) -> Frame:
    """Return a frame with a disc of another depth in the middle."""
    v, u = np.mgrid[:120, :160]
    disc = (u - 80) ** 2 + (v - 60) ** 2 < 20**2
    return replace(frame, depth=np.where(disc, np.float32(depth), frame.depth))


def near_disc(model: GaussianModel, depth: float) -> torch.Tensor:
    """Return a mask of Gaussians at this depth on the rays of the disc's middle."""
    x, y, z = model.means.T
    return ((x / z).abs() < 0.1) & ((y / z).abs() < 0.1) & ((z - depth).abs() < 0.03)


def test_nothing_mapped_is_an_empty_snapshot_and_finishing_it_does_not_raise() -> None:
    mapper = Mapper(small_config())
    assert len(mapper.snapshot().model) == 0
    assert mapper.snapshot().map_version == 0
    mapper.finish()
    assert len(mapper.snapshot().model) == 0


def test_every_insertion_its_refinement_and_the_finish_are_a_new_version_with_the_stamp_of_the_last_frame() -> None:
    mapper = Mapper(small_config())
    versions = []
    for stamp, T in ((1.0, np.eye(4)), (2.5, SIDE)):
        insert(mapper, wall_frame(T, stamp=stamp), T)
        versions.append(mapper.snapshot().map_version)
        assert mapper.snapshot().stamp == stamp
    mapper.finish()
    assert [*versions, mapper.snapshot().map_version] == [2, 4, 5]
    assert mapper.snapshot().stamp == 2.5


def test_a_finish_that_is_stopped_spends_no_more_steps_and_adds_nothing() -> None:
    mapper, answers = Mapper(small_config()), iter([False] * 5)
    mapper.config.mapping.final_iterations = 1_000_000
    insert(mapper, wall_frame(np.eye(4)))
    before = len(mapper.model)
    mapper.finish(stop=lambda: next(answers, True))
    assert not list(answers)
    assert 0 < len(mapper.snapshot().model) <= before


def test_a_snapshot_does_not_change_with_the_map() -> None:
    mapper = Mapper(small_config())
    insert(mapper, wall_frame(np.eye(4)))
    held = mapper.snapshot()
    kept = held.model.clone()
    insert(mapper, wall_frame(SIDE), SIDE)
    mapper.finish()
    assert equal(held.model, kept)


def test_a_second_observation_of_a_place_adds_few_gaussians_and_supports_the_others() -> None:
    mapper = Mapper(small_config())
    insert(mapper, wall_frame(np.eye(4)))
    first = len(mapper.model)
    insert(mapper, wall_frame(np.eye(4)))
    assert len(mapper.model) < 1.02 * first
    assert float((mapper.model.observations[:first] == 2).float().mean()) > 0.98


def test_a_new_view_adds_gaussians_only_outside_the_old_one() -> None:
    mapper = Mapper(small_config(mapping__refine_iterations=0))
    insert(mapper, wall_frame(np.eye(4)))
    T = se3_exp([0.4, 0, 0, 0, 0, 0])
    insert(mapper, wall_frame(T), T)
    added = mapper.model.means[mapper.model.anchors == 1].double().numpy()
    assert len(added) > 300
    u = CAMERA.project(transform_points(inverse(np.eye(4)), added))[:, 0]
    assert u.min() > 155  # the old image ends at 159, its last Gaussian a little before


def test_gaussians_are_anchored_in_the_keyframe_that_made_them() -> None:
    mapper = Mapper(small_config())
    for x in (0.0, 0.4, 0.8):
        T = se3_exp([x, 0, 0, 0, 0, 0])
        insert(mapper, wall_frame(T), T)
    assert [k.number for k in mapper.keyframes] == [0, 1, 2]
    assert set(mapper.model.anchors.tolist()) == {0, 1, 2}


def test_misses_reduce_the_odds_of_a_gaussian_until_it_is_removed() -> None:
    mapper = Mapper(small_config(mapping__refine_iterations=0))
    insert(mapper, with_ball(wall_frame(np.eye(4)), 0.7))
    ghosts = []
    odds = 0.8 / 0.2
    for _ in range(8):
        rows = near_disc(mapper.model, 0.7)
        ghosts.append(int(rows.sum()))
        if not ghosts[-1]:
            break
        alive = mapper.model.opacities[rows]
        assert float((alive / (1 - alive) / odds - 1).abs().max()) < 1e-4
        odds /= np.e
        insert(mapper, wall_frame(np.eye(4)))
    assert ghosts[0] > 50
    assert ghosts[-1] == 0
    assert int(near_disc(mapper.model, 1.0).sum()) > 50  # the surface behind has been mapped


def test_a_guess_that_is_seen_through_goes_at_once() -> None:
    mapper = Mapper(small_config(mapping__refine_iterations=0))
    near = replace(wall_frame(np.eye(4)), depth=np.full((120, 160), 0.6, np.float32))
    insert(mapper, with_ball(near, 0.0))
    guesses = int((mapper.model.observations == 0).sum())
    assert guesses > 30
    insert(mapper, with_ball(near, 1.0))
    assert int((mapper.model.observations == 0).sum()) < 0.3 * guesses  # at the rim depth may belong to either side
    assert int(near_disc(mapper.model, 0.6).sum()) == 0


def test_a_guess_that_a_later_keyframe_measures_is_observed() -> None:
    mapper = Mapper(small_config(mapping__refine_iterations=0))
    insert(mapper, with_ball(wall_frame(np.eye(4)), 0.0))
    assert int((mapper.model.observations == 0).sum()) > 30
    insert(mapper, wall_frame(np.eye(4)))
    assert not (mapper.model.observations == 0).any()


@pytest.mark.parametrize("cap", [100, 1500])
def test_the_cap_is_never_exceeded(cap: int) -> None:
    mapper = Mapper(small_config(mapping__max_gaussians=cap))
    for x in (0.0, 0.4, 0.8):
        T = se3_exp([x, 0, 0, 0, 0, 0])
        insert(mapper, wall_frame(T), T)
        assert len(mapper.model) == cap
    mapper.finish()
    assert len(mapper.model) <= cap


def test_gaussians_that_went_bad_are_pruned_before_anyone_renders_them(monkeypatch: pytest.MonkeyPatch) -> None:
    mapper = Mapper(small_config())
    refine = mapper._refiner.refine

    def damaging(model: GaussianModel, *rest: object) -> None:
        refine(model, *rest)  # type: ignore[arg-type]
        model.means[3] = torch.nan
        model.sh[5] = torch.inf

    monkeypatch.setattr(mapper._refiner, "refine", damaging)
    for x in (0.0, 0.4):
        T = se3_exp([x, 0, 0, 0, 0, 0])
        insert(mapper, wall_frame(T), T)
        for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
            assert torch.isfinite(getattr(mapper.model, name)).all()


def test_the_optimiser_keeps_the_rows_that_the_model_keeps(monkeypatch: pytest.MonkeyPatch) -> None:
    mapper = Mapper(small_config(mapping__max_gaussians=1500))
    monkeypatch.setattr(
        "splatbot.mapping.mapper.merge_similar", lambda model, excess: (model, torch.arange(len(model)))
    )
    prune, pruned = mapper._prune, []

    def tagged() -> None:
        n = len(mapper.model)
        mapper.model.anchors = torch.arange(n, dtype=torch.int32)
        mapper._refiner.adam.steps = torch.arange(n, dtype=torch.float32)
        prune()
        assert torch.equal(mapper._refiner.adam.steps.int(), mapper.model.anchors)
        pruned.append(n - len(mapper.model))

    monkeypatch.setattr(mapper, "_prune", tagged)
    for x in (0.0, 0.4):
        T = se3_exp([x, 0, 0, 0, 0, 0])
        insert(mapper, wall_frame(T), T)
    assert sum(pruned) > 100


def test_over_the_cap_neighbours_are_merged_and_the_optimiser_follows() -> None:
    mapper = Mapper(small_config(mapping__max_gaussians=1500))
    insert(mapper, wall_frame(np.eye(4)))
    assert len(mapper.model) == len(mapper._refiner.adam.steps) == 1500
    assert float(view_of(mapper.model, CAMERA, np.eye(4)).alpha[4:-4, 4:-4].min()) > 0.6  # coarser, and no hole


def test_the_reference_of_a_keyframe_lies_on_the_map() -> None:
    mapper = Mapper(small_config())
    insert(mapper, wall_frame(SIDE, normal=(0.2, 0.1, 0.97), distance=1.1), SIDE)
    reference = mapper.keyframes[0].reference
    assert np.array_equal(reference.T_world_camera, SIDE)
    assert len(reference.levels) == 3
    for level in reference.levels:
        world = transform_points(SIDE, level.points)
        assert np.abs(world @ [0.2, 0.1, 0.97] - 1.1).max() < 5e-3


def test_only_a_new_view_with_enough_depth_becomes_a_keyframe() -> None:
    mapper = Mapper(small_config())
    frame = wall_frame(np.eye(4))
    blind = replace(frame, depth=np.zeros_like(frame.depth))
    assert should_insert(mapper, frame)
    assert not should_insert(mapper, blind)
    insert(mapper, frame)
    assert not should_insert(mapper, frame)
    assert should_insert(mapper, frame, SIDE)


def test_the_map_of_the_tabletop_shows_views_it_was_not_made_of() -> None:
    frames, poses = tabletop()
    mapper = Mapper(small_config(mapping__refine_iterations=8))
    for i in (0, 10):
        insert(mapper, frames[i], poses[i])
    mapper.finish()
    view = view_of(mapper.model, frames[5].camera, poses[5])
    error = (view.rgb.double() - torch.from_numpy(frames[5].rgb).double() / 255).square().mean()
    assert -10 * np.log10(float(error)) > 21.0  # [dB]
    depth_error = (view.depth - torch.from_numpy(frames[5].depth)).abs()
    assert float(depth_error.median()) < 4e-3


@pytest.mark.parametrize("broken", ["_add_gaussians", "refine", "make_reference", "add_keyframe", "insert_keyframe"])
def test_an_exception_in_an_insertion_leaves_the_map_and_later_insertions_unchanged(
    broken: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapper, other = Mapper(small_config()), Mapper(small_config())
    for m in (mapper, other):
        insert(m, wall_frame(np.eye(4)))
    before, keyframes = mapper.snapshot(), mapper.keyframes

    def fail_after(work: Callable[..., None]) -> Callable[..., None]:
        def run(*arguments: Any) -> None:
            work(*arguments)
            raise MemoryError("on purpose")

        return run

    with monkeypatch.context() as patch:
        patch.setattr(mapper, broken, fail_after(getattr(mapper, broken)))
        with pytest.raises(MemoryError):
            insert(mapper, wall_frame(SIDE), SIDE)
    assert equal(mapper.model, before.model)
    assert mapper.keyframes == keyframes
    assert mapper.snapshot().map_version == before.map_version
    for m in (mapper, other):
        insert(m, wall_frame(SIDE), SIDE)
    assert equal(mapper.model, other.model)  # the optimiser and the draws are back, too


def test_whether_a_frame_becomes_a_keyframe_changes_no_state() -> None:
    mapper = Mapper(small_config())
    insert(mapper, wall_frame(np.eye(4)))
    before = {name: (id(value), repr(value)) for name, value in vars(mapper).items()}
    loops = {name: (id(value), repr(value)) for name, value in vars(mapper.loops).items()}
    assert should_insert(mapper, wall_frame(SIDE), SIDE)
    mapper.locate(SIDE, GraphLocation(0))
    assert {name: (id(value), repr(value)) for name, value in vars(mapper).items()} == before
    assert {name: (id(value), repr(value)) for name, value in vars(mapper.loops).items()} == loops


def test_frames_that_are_lost_or_held_out_and_a_frozen_map_change_nothing() -> None:
    mapper = Mapper(small_config())
    insert(mapper, wall_frame(np.eye(4)))
    seen = Observation(prepare(wall_frame(SIDE), mapper.config.tracking), SIDE)
    assert mapper.should_insert(seen)
    for unusable in (replace(seen, verdict="lost"), replace(seen, held_out=True)):
        assert not mapper.should_insert(unusable)
        mapper.observe(unusable)
        assert not mapper.has_work
    mapper.pending_iterations = 5
    mapper.freeze()
    assert not mapper.should_insert(seen)
    mapper.observe(seen)
    assert not mapper.has_work
    assert not mapper.step()


def test_frames_are_observed_at_intervals_and_only_the_latest() -> None:
    mapper = Mapper(small_config(mapping__observe_interval_s=0.2))
    insert(mapper, wall_frame(np.eye(4)))
    for stamp in (1.0, 1.1, 1.3):
        frame = prepare(wall_frame(np.eye(4), stamp=stamp), mapper.config.tracking)
        mapper.observe(Observation(frame, np.eye(4)))
    assert [observation.stamp for observation in mapper._latest.values()] == [1.3]
    observations = mapper.model.observations.clone()
    InlineExecutor(mapper).run()
    assert int((mapper.model.observations - observations).max()) == 1


def test_an_error_within_a_refinement_iteration_leaves_the_map_and_the_optimizer_as_they_were(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mapper = Mapper(small_config())
    insert(mapper, wall_frame(np.eye(4)))
    model, adam = mapper.model.clone(), mapper._refiner.adam
    moments = {name: tensor.clone() for name, tensor in adam.first.items()}

    def broken(*_: object, **__: object) -> None:
        raise MemoryError("on purpose")

    monkeypatch.setattr("splatbot.mapping.refine.limit_shape", broken)
    mapper.pending_iterations = 3
    with pytest.raises(MemoryError):
        mapper.step()
    assert equal(mapper.model, model)
    assert all(torch.equal(adam.first[name], moments[name]) for name in moments)
    assert mapper.pending_iterations == 3


def test_an_observation_that_fails_leaves_the_map_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    mapper = Mapper(small_config())
    insert(mapper, wall_frame(np.eye(4)))
    before = mapper.snapshot()

    def broken() -> None:
        raise MemoryError("on purpose")

    monkeypatch.setattr(mapper, "_prune", broken)
    with pytest.raises(MemoryError):
        observe(mapper, wall_frame(np.eye(4)))
    assert equal(mapper.model, before.model)
    assert mapper.version == before.map_version
    assert not mapper.has_observations
