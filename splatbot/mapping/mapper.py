"""The mapper inserts keyframes into the Gaussian map, refines it, and is the only writer of it."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.config import Config
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.mapping.completion import missing_gaussians
from splatbot.mapping.culling import without_redundant, without_replaced
from splatbot.mapping.densify import PositionGradients, split
from splatbot.mapping.depth_fusion import (
    DepthNoiseModel,
    compare_with_depth,
    fuse_depth,
    fuse_normals,
    initial_uncertainty,
    update_visibility,
)
from splatbot.mapping.dynamic_objects import DynamicObjectFilter
from splatbot.mapping.exposure import in_exposure_of_map
from splatbot.mapping.insertion import ModelView, guessed_gaussians, model_depth, new_gaussians, unexplained, view_of
from splatbot.mapping.keyframes import Keyframe, first_number, is_keyframe, mapping_images, resized
from splatbot.mapping.loop import LoopCloser
from splatbot.mapping.memory import memory_of
from splatbot.mapping.merge import merge_similar
from splatbot.mapping.observation import GraphLocation, Observation
from splatbot.mapping.prune import best_supported, keep_mask
from splatbot.mapping.refine import Refiner, Stop, never
from splatbot.mapping.rigid_motion import move_gaussians, move_keyframe
from splatbot.tracking.nearby_keyframes import pose_distance
from splatbot.tracking.prepare import valid_share, with_depth
from splatbot.tracking.reference import make_reference

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MapperConstants:
    """Constants of the mapper.

    Args:
        backlog: keyframes that may wait for depth fusion; while as many wait, no further one is inserted.
        densify_after: share of the final iterations that run before densification; they measure the gradients.
        unmapped_share: share of an image without any map behind it that makes the next frame a keyframe.
        refined_correction: [m] a correction of the poses that moves a keyframe by more has the map refined again.
    """

    backlog: int = 3
    densify_after: float = 1 / 3
    unmapped_share: float = 0.03
    refined_correction: float = 0.01


CONSTANTS = MapperConstants()


class Mapper:
    """Holds the keyframes and the map.

    The tracking thread calls :meth:`locate`, :meth:`should_insert`, :meth:`submit`, :meth:`observe` and
    :meth:`set_robot_moving`. An executor (:mod:`splatbot.mapping.executor`) calls :meth:`step` in the mapping thread,
    which may be the same. Each keyframe takes these steps:

    1. add: the frame becomes a keyframe with its measured depth as reference; frames can be tracked against it at once.
    2. insert: depth fusion, new Gaussians, pruning, a reference with the depth of the map, loop detection.
       Keyframes of further cameras are not in the pose graph; each moves with a keyframe of the first camera.
    3. refine: ``refine_iterations`` gradient steps, then a reference with the depth of the refined map.

    The list of keyframes and their references are replaced by assignment, never changed: a reader in another thread
    sees the old or the new state.
    """

    def __init__(self, config: Config) -> None:
        self.config = config
        self.keyframes: list[Keyframe] = []
        self.model = GaussianModel.empty()
        self.pending_iterations = 0
        """Refinement iterations that the keyframes require and that have not run yet."""
        self.version = 0
        """Number of changes of the map: an insertion, an observation, a loop closure, a keyframe's refinement."""
        self.loops = LoopCloser(config)
        self._refiner = Refiner(config.mapping, config.seed)
        self._refiner.adam.extend(self.model)
        self._dynamic_objects = DynamicObjectFilter(config.mapping.dynamic_timeout_s)
        self._depth_noise = DepthNoiseModel.of(config.tracking)
        self._unmapped_seen: set[str] = set()
        """Names of the cameras that see a part of the scene without a map."""
        self._anchors: dict[int, int] = {}
        """Number of the first camera's keyframe with which each keyframe of a further camera moves."""
        self._robot_moving = False
        self._frozen = False
        self._stamp = 0.0
        # Written by the tracking thread only.
        self._observed_stamps: dict[str, float] = {}
        """Stamp [s] of the last frame of each camera that was offered for the comparison with the map."""
        # The two threads share these under the lock.
        self._lock = threading.Lock()
        self._submitted: deque[Observation] = deque()
        self._latest: dict[str, Observation] = {}
        """The frame of each camera that is compared with the map next."""
        # Added to the keyframes, not in the map yet.
        self._added: deque[tuple[Observation, Keyframe]] = deque()
        # In the map, with a reference to renew after refinement.
        self._inserted: deque[tuple[Observation, Keyframe]] = deque(maxlen=CONSTANTS.backlog)

    # --- state ---

    @property
    def size(self) -> int:
        """Number of Gaussians."""
        return len(self.model)

    @property
    def first_keyframes(self) -> list[Keyframe]:
        """Keyframes of the first camera, which its frames are tracked against."""
        return self.keyframes_of("")

    def keyframes_of(self, camera_name: str) -> list[Keyframe]:
        """Return the keyframes of one camera."""
        return [keyframe for keyframe in self.keyframes if keyframe.camera_name == camera_name]

    @property
    def memory(self) -> dict[str, int]:
        """Memory in use [bytes] by category; approximate while another thread maps."""
        return memory_of(self.model, self._refiner.adam, self.keyframes)

    @property
    def loop_counts(self) -> dict[str, int]:
        """Numbers of loop closures that were "closed" and "rejected"."""
        return {"closed": self.loops.closed, "rejected": self.loops.rejected}

    @property
    def inconsistency(self) -> float:
        """Ratio of the observed to the stated variance of motions between keyframes, at least 1."""
        return self.loops.inconsistency

    @property
    def skipped_gradients(self) -> int:
        """Number of gradients that were not finite and did not change the map."""
        return self._refiner.adam.skipped

    @property
    def has_loop(self) -> bool:
        """True if :meth:`close_loops` would move the map; keyframes that wait for insertion come first."""
        return not self._frozen and self.loops.correction is not None and not self.has_keyframes_to_insert

    @property
    def has_keyframes_to_insert(self) -> bool:
        """True while submitted observations are not in the map yet."""
        return bool(self._submitted or self._added)

    @property
    def has_observations(self) -> bool:
        """True while submitted observations, or an observed frame, are not processed yet."""
        return self.has_keyframes_to_insert or bool(self._latest)

    @property
    def has_work(self) -> bool:
        """True if :meth:`step` has work now."""
        return self.has_observations or self._may_refine

    def snapshot(self) -> Snapshot:
        """Copy the map; not while another thread runs :meth:`step`."""
        return Snapshot(self.model.clone(), self.version, self._stamp)

    # --- calls of the tracking thread ---

    def locate(self, T_world_camera: Array, previous: GraphLocation) -> GraphLocation:
        """Return where a frame is in the pose graph.

        Args:
            T_world_camera: (4, 4) of the frame.
            previous: location of the previous frame.
        """
        return self.loops.locate(T_world_camera, self.first_keyframes, previous)

    def should_insert(self, observation: Observation) -> bool:
        """Return whether a frame qualifies as a keyframe; changes no state.

        It needs enough depth for later frames to align to. It must be a new view, revisit a place without a loop
        closure, or follow a frame that the map does not cover. No frame qualifies while ``backlog`` keyframes wait for
        insertion, or while a loop closure waits for them.
        """
        if self._frozen or observation.held_out or observation.verdict == "lost":
            return False
        if valid_share(observation.prepared) < self.config.tracking.min_depth_coverage:
            return False
        waiting, name = self._waiting(), observation.camera_name
        if len(waiting) >= CONSTANTS.backlog or self.loops.correction is not None:
            return False
        if observation.location.revisits or (name in self._unmapped_seen and not waiting):
            return True
        replaces = self.config.mapping.replace_poor and not observation.is_poor
        views: list[Keyframe | Observation] = [*self.keyframes, *waiting]
        views = [view for view in views if view.camera_name == name]
        views = [view for view in views if not (replaces and view.is_poor)]
        return is_keyframe(observation.T_world_camera, views, self.config.mapping)

    def submit(self, observation: Observation) -> GraphLocation:
        """Queue a frame as the next keyframe; return its own location in the pose graph."""
        with self._lock:
            name = observation.camera_name
            before = sum(waiting.camera_name == name for waiting in self._submitted)
            self._submitted.append(observation)
            return GraphLocation(self._next_number(name) + before)

    def observe(self, observation: Observation) -> None:
        """Offer a frame that is not a keyframe for the comparison with the map; the next one replaces it.

        Only frames with the verdict "ok" count, at intervals of ``observe_interval_s`` for each camera.
        """
        if self._frozen or observation.held_out or observation.verdict != "ok":
            return
        name = observation.camera_name
        since = observation.stamp - self._observed_stamps.get(name, -math.inf)
        if not 0 <= since < self.config.mapping.observe_interval_s:
            self._observed_stamps[name] = observation.stamp
            with self._lock:
                self._latest[name] = observation

    def set_robot_moving(self, moving: bool) -> None:
        """Pause refinement while the robot moves; the pending iterations run once it stops."""
        self._robot_moving = moving

    # --- steps of the mapping thread ---

    def step(self, iterations: int = 1) -> bool:
        """Run the next piece of work and return whether there is more; an error leaves the state as it was.

        The order is the one that serves tracking soonest: add a keyframe, insert a keyframe, compare the latest
        observed frame, refine.

        Args:
            iterations: limit of refinement iterations in this step.
        """
        with self.rollback_on_error():
            if self._submitted:
                self.add_keyframe()
            elif self._added:
                self.insert_keyframe()
            elif self._latest:
                self._compare_latest()
            elif self._may_refine:
                self.refine(iterations)
        return self.has_work

    @contextmanager
    def rollback_on_error(self) -> Iterator[None]:
        """Return a context that restores the state if its block raises, and drops observations that are not in the map.

        The state consists of keyframes, map, optimizer, dynamic objects, pose graph and version. It is kept by
        reference: all steps but refinement write to copies, and :meth:`Refiner.step` undoes its own writes.
        """
        before = self._state()
        try:
            yield
        except BaseException:
            self._restore(before)
            raise

    def add_keyframe(self) -> None:
        """Make the first submitted observation a keyframe that refers to its measured depth."""
        observation = self._submitted[0]
        keyframe = self._make_keyframe(observation)
        with self._lock:
            self.keyframes = [*self.keyframes, keyframe]
            self._added.append((observation, keyframe))
            self._submitted.popleft()

    def insert_keyframe(self) -> None:
        """Insert the first added keyframe into the map, update its reference and search for loop closures."""
        observation, keyframe = self._added[0]
        self._cull_keyframes(keyframe)
        self.fuse(observation, keyframe)
        self.make_reference(observation, keyframe)
        if observation.camera_name:
            self._anchors = self._anchors | {keyframe.number: observation.location.keyframe or 0}
        else:
            self.loops.add(keyframe, observation, self.first_keyframes)
        self._added.popleft()
        if self._may_refine:
            self._inserted.append((observation, keyframe))

    def fuse(self, observation: Observation, keyframe: Keyframe) -> None:
        """Update the Gaussians by a keyframe's depth and create new ones where the map does not explain it."""
        self._stamp = observation.stamp
        self._fuse_depth(keyframe.depth, keyframe.camera, keyframe.T_world_camera, keyframe.camera_name)
        view = view_of(self.model, keyframe.camera, keyframe.T_world_camera)
        keyframe.rgb = in_exposure_of_map(keyframe.rgb, keyframe.depth, view)
        self._mask_dynamic_objects(keyframe, view)
        self._add_gaussians(keyframe, view)
        self._prune()
        self._unmapped_seen = self._unmapped_seen - {keyframe.camera_name}
        self.pending_iterations += self.config.mapping.refine_iterations
        self.version += 1

    def make_reference(self, observation: Observation, keyframe: Keyframe) -> None:
        """Set the reference for later frames: gray values of the frame, and depth of the map where that is opaque."""
        levels = observation.prepared.levels
        view = view_of(self.model, levels[0].camera, keyframe.T_world_camera)
        depth = model_depth(view, levels[0].depth, self.config.mapping)
        if keyframe.static_mask is not None:
            depth = np.where(resized(keyframe.static_mask.numpy(), depth.shape), depth, np.float32(0))
        n_pixels = self.config.tracking.n_pixels
        keyframe.reference = make_reference(with_depth(levels, depth), keyframe.T_world_camera, n_pixels)

    def refine(self, iterations: int, stop: Stop = never) -> None:
        """Run at most ``iterations`` of the pending ones, the first on the latest keyframe if it had none."""
        iterations = min(iterations, self.pending_iterations)
        if iterations <= 0:
            return
        self.pending_iterations -= iterations
        self._refiner.refine(self.model, self.keyframes, iterations, stop)
        self._prune()  # refinement may have made Gaussians faint, huge or not finite
        if self.pending_iterations % max(1, self.config.mapping.refine_iterations) == 0:
            while self._inserted:
                self.make_reference(*self._inserted.popleft())
            self.version += 1

    # --- calls while no step runs ---

    def close_loops(self) -> dict[int, Array]:
        """Move keyframes and their Gaussians to the poses of the optimized pose graph.

        No other thread may track or map meanwhile. Refinement of the moved map becomes pending.

        Returns:
            ``T_new_old`` (4, 4) by keyframe number; empty without a loop closure.
        """
        if self.loops.correction is None or self._frozen:
            return {}
        correction = self._with_further_cameras(self.loops.correction)
        self._latest.clear()  # their poses belong to the map before the correction
        self._inserted.clear()
        self.keyframes = [move_keyframe(keyframe, correction) for keyframe in self.keyframes]
        self.model = move_gaussians(self.model, correction)
        self.loops.apply_correction(correction)
        if max(pose_distance(np.eye(4), T)[0] for T in correction.values()) > CONSTANTS.refined_correction:
            self.pending_iterations += self.config.mapping.refine_iterations
        self.version += 1
        return correction

    def freeze(self) -> None:
        """Keep the map as it is from here on: no keyframes, no observations, no refinement."""
        self._frozen = True
        self._latest.clear()

    def finish(self, stop: Stop = never) -> None:
        """Refine over all keyframes at the end of a log, and densify where the loss gradients are large.

        Confirmed depth that the map misses becomes Gaussians before and after. Refinement adapts the first ones; it may
        move or remove Gaussians that depth supports.

        Args:
            stop: called before each iteration. Once it returns True, no iteration and no densification follows.
        """
        self.refine(self.pending_iterations, stop)
        self._complete()
        final, gradients = self.config.mapping.final_iterations, PositionGradients(len(self.model))
        first = int(final * CONSTANTS.densify_after)
        self._refiner.refine_all(self.model, self.keyframes, first, gradients, stop)
        if not stop():
            self._densify(gradients)
            self._refiner.refine_all(self.model, self.keyframes, final - first, stop=stop)
        self._prune()
        self._complete()
        self.version += 1

    # --- implementation ---

    @property
    def _may_refine(self) -> bool:
        return self.pending_iterations > 0 and not (self._robot_moving or self._frozen)

    def _waiting(self) -> list[Observation]:
        """Return the observations that were submitted and are not in the map yet."""
        with self._lock:
            return [*self._submitted, *(observation for observation, _ in self._added)]

    def _next_number(self, camera_name: str) -> int:
        own = self.keyframes_of(camera_name)
        return own[-1].number + 1 if own else first_number(camera_name, self.config)

    def _with_further_cameras(self, correction: Mapping[int, Array]) -> dict[int, Array]:
        """Return a correction by keyframe number with that of the keyframes of further cameras."""
        still = np.eye(4)
        return {**correction, **{number: correction.get(first, still) for number, first in self._anchors.items()}}

    def _cull_keyframes(self, keyframe: Keyframe) -> None:
        """Remove the keyframes of its camera that a new keyframe replaces or makes redundant."""
        kept = without_replaced(self.keyframes_of(keyframe.camera_name), keyframe, self.config.mapping)
        kept = without_redundant(kept, self.config.mapping.max_keyframes)
        numbers = {k.number for k in kept}
        name = keyframe.camera_name
        self.keyframes = [k for k in self.keyframes if k.camera_name != name or k.number in numbers]

    def _state(self) -> dict[str, Any]:
        names = ("keyframes", "model", "pending_iterations", "version", "_stamp", "_unmapped_seen", "_anchors")
        state = {name: getattr(self, name) for name in names} | {"_dynamic_objects": copy(self._dynamic_objects)}
        return state | {"": (self._refiner.state(), self.loops.state())}

    def _restore(self, state: dict[str, Any]) -> None:
        refiner, loops = state.pop("")
        self._refiner.restore(refiner)
        self.loops.restore(loops)
        vars(self).update(state)
        with self._lock:
            dropped = {id(keyframe) for _, keyframe in self._added}
            self.keyframes = [keyframe for keyframe in self.keyframes if id(keyframe) not in dropped]
            self._submitted.clear()
            self._added.clear()
            self._inserted.clear()
            self._latest.clear()

    def _make_keyframe(self, observation: Observation) -> Keyframe:
        prepared, T_world_camera = observation.prepared, observation.T_world_camera
        tracking = self.config.of_camera(observation.camera_name).tracking
        camera, rgb, depth = mapping_images(prepared.frame, self.config.mapping, tracking)
        mask = prepared.frame.mask
        return Keyframe(
            number=self._next_number(observation.camera_name),
            camera=camera,
            rgb=torch.from_numpy(np.ascontiguousarray(rgb)),
            depth=torch.from_numpy(depth),
            T_world_camera=T_world_camera,
            features=observation.features(),
            reference=make_reference(prepared.levels, T_world_camera, self.config.tracking.n_pixels),
            static_mask=None if mask is None else torch.from_numpy(resized(mask, depth.shape)),
            is_poor=observation.is_poor,
            camera_name=observation.camera_name,
        )

    def _compare_latest(self) -> None:
        with self._lock:
            observation = self._latest.pop(next(iter(self._latest))) if self._latest else None
        if observation is not None:
            self._compare(observation)

    def _compare(self, observation: Observation) -> None:
        """Compare the map with a frame that is not a keyframe.

        Gaussians that it sees through lose opacity, and dynamic objects are followed. Where it shows a part of the
        scene without a map, the next frame becomes a keyframe.
        """
        frame, T_world_camera = observation.prepared.frame, observation.T_world_camera
        name = observation.camera_name
        camera, rgb, measured = mapping_images(frame, self.config.mapping, self.config.of_camera(name).tracking)
        depth = torch.from_numpy(measured)
        self._fuse_depth(depth, camera, T_world_camera, name)
        self._prune()
        view = view_of(self.model, camera, T_world_camera)
        colors = in_exposure_of_map(torch.from_numpy(np.ascontiguousarray(rgb)), depth, view)
        self._dynamic_objects.find(view, colors, depth, camera, T_world_camera, self.keyframes, frame.stamp)
        unmapped = (depth > 0) & (view.alpha < self.config.mapping.unexplained_alpha)
        is_seen = float(unmapped.float().mean()) > CONSTANTS.unmapped_share
        self._unmapped_seen = self._unmapped_seen | {name} if is_seen else self._unmapped_seen - {name}
        self.version += 1

    def _noise_of(self, camera_name: str) -> DepthNoiseModel:
        return DepthNoiseModel.of(self.config.of_camera(camera_name).tracking) if camera_name else self._depth_noise

    def _fuse_depth(self, depth: torch.Tensor, camera: Camera, T_world_camera: Array, camera_name: str) -> None:
        noise = self._noise_of(camera_name)
        comparison = compare_with_depth(self.model, depth, camera, T_world_camera, noise)
        self.model = update_visibility(fuse_normals(fuse_depth(self.model, comparison), comparison), comparison)

    def _mask_dynamic_objects(self, keyframe: Keyframe, view: ModelView) -> None:
        dynamic = self._dynamic_objects.find(
            view,
            keyframe.rgb,
            keyframe.depth,
            keyframe.camera,
            keyframe.T_world_camera,
            [k for k in self.keyframes if not any(k is waiting for _, waiting in self._added)],
            self._stamp,
        )
        if dynamic.any():
            keyframe.static_mask = ~dynamic if keyframe.static_mask is None else keyframe.static_mask & ~dynamic
            keyframe.depth = torch.where(dynamic, 0.0, keyframe.depth)

    def _add_gaussians(self, keyframe: Keyframe, view: ModelView) -> None:
        measured = new_gaussians(keyframe, unexplained(view, keyframe.depth, self.config.mapping), self.config.mapping)
        guessed = guessed_gaussians(view, keyframe, self.config.mapping)
        for new in (measured, guessed):
            noise = self._noise_of(keyframe.camera_name)
            new.uncertainty = initial_uncertainty(new, keyframe.T_world_camera, noise)
        self.model = GaussianModel.concatenate([self.model, measured, guessed])
        self._refiner.adam.extend(self.model)

    def _complete(self) -> None:
        if self._frozen or not len(self.model):
            return
        missing = missing_gaussians(self.model, self.keyframes, self.config.mapping, self._depth_noise)
        self.model = GaussianModel.concatenate([self.model, missing])
        self._refiner.adam.extend(self.model)
        self._prune()

    def _densify(self, gradients: PositionGradients) -> None:
        free = self.config.mapping.max_gaussians - len(self.model)
        self.model = split(self.model, gradients.largest(self.config.mapping.densify_gradient, free))
        self._refiner.adam.extend(self.model)

    def _prune(self) -> None:
        keep = keep_mask(self.model, self.config.mapping)
        if not keep.all():
            self._select(keep.nonzero()[:, 0])
        excess = len(self.model) - self.config.mapping.max_gaussians
        if excess > 0:
            self.model, rows = merge_similar(self.model, excess)
            self._refiner.adam.select(rows)
        if len(self.model) > self.config.mapping.max_gaussians:
            self._select(best_supported(self.model, self.config.mapping.max_gaussians))

    def _select(self, index: torch.Tensor) -> None:
        self.model = self.model.select(index)
        self._refiner.adam.select(index)
