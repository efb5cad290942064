"""The only writer of the map: takes keyframes in, keeps the Gaussians true to them, publishes snapshots."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from copy import copy
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.config import Config
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.mapping.culling import without_redundant
from splatbot.mapping.densify import PositionGradients, split
from splatbot.mapping.depth_fusion import DepthNoiseModel, count, first_uncertainty, fuse_depth, fuse_normals, weigh
from splatbot.mapping.dynamic_objects import DynamicObjectFilter
from splatbot.mapping.exposure import in_exposure_of_map
from splatbot.mapping.insertion import ModelView, guessed_gaussians, model_depth, new_gaussians, unexplained, view_of
from splatbot.mapping.keyframes import HasPose, Keyframe, is_keyframe, mapping_images, resized
from splatbot.mapping.loop import LoopCloser, LoopView, move_gaussians, move_keyframe
from splatbot.mapping.memory import memory_of
from splatbot.mapping.merge import merge_alike
from splatbot.mapping.prune import fittest, worth_keeping
from splatbot.mapping.refine import Refiner, Stop, never
from splatbot.tracking.features import Features
from splatbot.tracking.prepare import PreparedFrame, valid_share, with_depth
from splatbot.tracking.reference import Reference, make_reference

_BEFORE = 3  # of the last steps, the share of one in so many goes before densifying: it tells where
_REVEALED = 0.03  # share of a frame that the map has nothing of, from which on the frame is wanted


@dataclass(frozen=True)
class Observation:
    """A frame that is to become a keyframe.

    Args:
        prepared: its images.
        T_world_camera: (4, 4).
        features: what finds its keypoints, called once, in the thread that maps.
        anchor: number of the keyframe that frames were near to before.
    """

    prepared: PreparedFrame
    T_world_camera: NDArray[np.float64]
    features: Callable[[], Features]
    anchor: int | None = None


class Mapper:
    """Holds the keyframes and the model; all work is done in the thread that calls."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.keyframes: list[Keyframe] = []
        self.model = GaussianModel.empty()
        self.owed = 0
        """Refinement steps that keyframes have called for and that were not spent yet."""
        self.loops = LoopCloser(config)
        self._refiner = Refiner(config.mapping, config.seed)
        self._refiner.adam.extend(self.model)
        self._movers = DynamicObjectFilter(config.mapping.dynamic_timeout_s)
        self._revealed = False
        self._noise = DepthNoiseModel.of(config.tracking)
        self._held = False
        self._version = 0
        self._stamp = 0.0

    @property
    def size(self) -> int:
        """Number of Gaussians."""
        return len(self.model)

    def wants(
        self, prepared: PreparedFrame, T_world_camera: NDArray[np.float64], to_come: Sequence[HasPose] = ()
    ) -> bool:
        """Whether a frame at this pose would be a keyframe: a new view, with depth for later frames to align to.

        ``to_come`` are views that will be in the map, but are not yet.
        """
        if valid_share(prepared) < self.config.tracking.min_depth_coverage:
            return False
        bridge = self.loops.is_bridge(T_world_camera, self.keyframes)
        if bridge or (self._revealed and not to_come):
            return True
        return is_keyframe(T_world_camera, [*self.keyframes, *to_come], self.config.mapping)

    def insert(
        self, prepared: PreparedFrame, T_world_camera: NDArray[np.float64], features: Callable[[], Features]
    ) -> None:
        """Fuse a frame into the map, refine, and make it a reference for tracking; ``features`` finds its keypoints.

        An exception leaves keyframes and map as they were.
        """
        observation = Observation(prepared, T_world_camera, features, self.loops.anchor)
        with self._undone_on_error():
            keyframe = self.add_keyframe(observation)
            self.fuse(observation, keyframe)
            self.refine(0 if self._held else self.owed)
            self.make_reference(observation, keyframe)
        self.look_for_loops(observation, keyframe)

    def look_for_loops(self, observation: Observation, keyframe: Keyframe) -> None:
        """Whether a keyframe shows a place seen before; :meth:`close_loops` acts on it."""
        view = LoopView(observation.prepared, observation.T_world_camera, keyframe.features, observation.anchor)
        self.loops.add(keyframe, view, self.keyframes)

    def close_loops(self, *, refine: bool = True) -> dict[int, NDArray[np.float64]]:
        """Move keyframes and their Gaussians where the pose graph has them; T_new_old (4, 4) by keyframe number.

        Nobody may track or map meanwhile. Empty when no loop waits. ``refine`` spends the steps owed at once; else they
        stay owed, and nobody waits for them.
        """
        correction = self.loops.correction
        if correction is None:
            return {}
        self.keyframes = [move_keyframe(keyframe, correction) for keyframe in self.keyframes]
        self.model = move_gaussians(self.model, correction)
        self.loops.moved(correction)
        self.owed += self.config.mapping.refine_iterations
        self.refine(self.owed if refine and not self._held else 0)
        self._version += 1
        return correction

    @property
    def memory(self) -> dict[str, int]:
        """Bytes held, by what for."""
        return memory_of(self.model, self._refiner.adam, self.keyframes)

    @property
    def loop_counts(self) -> dict[str, int]:
        """Loops that were "closed", and "rejected" ones."""
        return {"closed": self.loops.closed, "rejected": self.loops.rejected}

    @property
    def skipped_gradients(self) -> int:
        """Gradients that were not finite, and so moved nothing."""
        return self._refiner.adam.skipped

    @property
    def has_loop(self) -> bool:
        """Whether :meth:`close_loops` has something to do."""
        return self.loops.correction is not None

    def hold(self, moving: bool) -> None:
        """Whether refinement is to wait, because the robot moves; steps owed are spent once it stands."""
        self._held = moving
        if not moving and self.owed:
            self.refine(min(self.owed, self.config.mapping.refine_iterations))
            self._version += 1

    def finish(self, stop: Stop = never) -> None:
        """Refine over all keyframes once no more will come, and densify where their pictures ask for it.

        ``stop`` is asked before each step; once it says so there are no more, and nothing is added to the map.
        """
        self.refine(self.owed, stop)
        steps, pull = self.config.mapping.final_iterations, PositionGradients(len(self.model))
        self._refiner.refine_all(self.model, self.keyframes, steps // _BEFORE, pull, stop)
        if not stop():
            self._densify(pull)
            self._refiner.refine_all(self.model, self.keyframes, steps - steps // _BEFORE, stop=stop)
        self._prune()
        self._version += 1

    def close(self) -> None:
        """Nothing goes on in the background that would have to be ended."""

    def paused(self) -> AbstractContextManager[None]:
        """Nothing goes on in the background that would have to wait."""
        return nullcontext()

    def snapshot(self) -> Snapshot:
        """The map as it is, copied."""
        return Snapshot(self.model.clone(), self._version, self._stamp)

    def add_keyframe(self, observation: Observation, *, provisional: bool = False) -> Keyframe:
        """A keyframe of an observation, which the map does not know yet.

        ``provisional`` gives it a reference of the measured depth, for tracking until :meth:`make_reference`.
        """
        keyframe = self._make_keyframe(observation.prepared, observation.T_world_camera, observation.features())
        if provisional:
            levels, n_pixels = observation.prepared.levels, self.config.tracking.n_pixels
            keyframe.reference = make_reference(levels, observation.T_world_camera, n_pixels)
        # A new list: the tracker may be reading the old one.
        self.keyframes = without_redundant([*self.keyframes, keyframe], self.config.mapping.max_keyframes)
        return keyframe

    def look(self, prepared: PreparedFrame, T_world_camera: NDArray[np.float64]) -> None:
        """Weigh the map against a frame that is no keyframe: what has gone goes, what moves is followed.

        Where it shows what the map has nothing of, the next frame is wanted as a keyframe, from wherever it is.
        """
        camera, rgb, depth = mapping_images(prepared.frame, self.config.mapping, self.config.tracking)
        depths = torch.from_numpy(depth)
        self._weigh(depths, camera, T_world_camera)
        self._prune()
        view = view_of(self.model, camera, T_world_camera)
        colors = in_exposure_of_map(torch.from_numpy(np.ascontiguousarray(rgb)), depths, view)
        stamp = prepared.frame.stamp
        self._movers.find(view, colors, depths, camera, T_world_camera, self.keyframes, stamp)
        bare = (depths > 0) & (view.alpha < self.config.mapping.unexplained_alpha)
        self._revealed = float(bare.float().mean()) > _REVEALED
        self._version += 1

    def fuse(self, observation: Observation, keyframe: Keyframe) -> None:
        """Bring a keyframe's evidence and its new surfaces into the map; it calls for refinement."""
        self._stamp = observation.prepared.frame.stamp
        self._weigh(keyframe.depth, keyframe.camera, keyframe.T_world_camera)
        view = view_of(self.model, keyframe.camera, keyframe.T_world_camera)
        keyframe.rgb = in_exposure_of_map(keyframe.rgb, keyframe.depth, view)
        self._leave_out_what_moves(keyframe, view)
        self._add(keyframe, view)
        self._prune()
        self._revealed = False
        self.owed += self.config.mapping.refine_iterations
        self._version += 1

    def refine(self, steps: int, stop: Stop = never) -> None:
        """Spend at most so many of the steps owed, first on the latest keyframe if it has had none."""
        if steps <= 0:
            return
        steps = min(steps, self.owed)
        self.owed -= steps
        self._refiner.refine(self.model, self.keyframes, steps, stop)
        self._prune()  # or what refinement made faint, huge or not finite would be rendered

    def make_reference(self, observation: Observation, keyframe: Keyframe) -> None:
        """What later frames are aligned to: the frame's own grey, the map's depth where the map is solid."""
        levels = observation.prepared.levels
        view = view_of(self.model, levels[0].camera, keyframe.T_world_camera)
        depth = model_depth(view, levels[0].depth, self.config.mapping)
        if keyframe.still is not None:
            depth = np.where(resized(keyframe.still.numpy(), depth.shape), depth, np.float32(0))
        n_pixels = self.config.tracking.n_pixels
        keyframe.reference = make_reference(with_depth(levels, depth), keyframe.T_world_camera, n_pixels)

    @contextmanager
    def _undone_on_error(self) -> Iterator[None]:
        """Puts everything back when the block raises. Cheap: up to :meth:`refine` the block writes to copies only."""
        before = self.keyframes, self.model, self.owed, self._version, self._stamp, self._refiner.state()
        movers = copy(self._movers)
        try:
            yield
        except BaseException:
            self.keyframes, self.model, self.owed, self._version, self._stamp, state = before
            self._refiner.restore(state)
            self._movers = movers
            raise

    def _make_keyframe(
        self, prepared: PreparedFrame, T_world_camera: NDArray[np.float64], features: Features
    ) -> Keyframe:
        camera, rgb, depth = mapping_images(prepared.frame, self.config.mapping, self.config.tracking)
        mask = prepared.frame.mask
        return Keyframe(
            number=self.keyframes[-1].number + 1 if self.keyframes else 0,
            camera=camera,
            rgb=torch.from_numpy(np.ascontiguousarray(rgb)),
            depth=torch.from_numpy(depth),
            T_world_camera=T_world_camera,
            features=features,
            reference=Reference(T_world_camera, ()),
            still=None if mask is None else torch.from_numpy(resized(mask, depth.shape)),
        )

    def _weigh(self, depth: torch.Tensor, camera: Camera, T_world_camera: NDArray[np.float64]) -> None:
        evidence = weigh(self.model, depth, camera, T_world_camera, self._noise)
        self.model = count(fuse_normals(fuse_depth(self.model, evidence), evidence), evidence)

    def _leave_out_what_moves(self, keyframe: Keyframe, view: ModelView) -> None:
        moving = self._movers.find(
            view,
            keyframe.rgb,
            keyframe.depth,
            keyframe.camera,
            keyframe.T_world_camera,
            [k for k in self.keyframes if k.number < keyframe.number],
            self._stamp,
        )
        if moving.any():
            keyframe.still = ~moving if keyframe.still is None else keyframe.still & ~moving
            keyframe.depth = torch.where(moving, 0.0, keyframe.depth)

    def _add(self, keyframe: Keyframe, view: ModelView) -> None:
        measured = new_gaussians(keyframe, unexplained(view, keyframe.depth, self.config.mapping), self.config.mapping)
        guessed = guessed_gaussians(view, keyframe, self.config.mapping)
        for new in (measured, guessed):
            new.uncertainty = first_uncertainty(new, keyframe.T_world_camera, self._noise)
        self.model = GaussianModel.concatenate([self.model, measured, guessed])
        self._refiner.adam.extend(self.model)

    def _densify(self, pull: PositionGradients) -> None:
        room = self.config.mapping.max_gaussians - len(self.model)
        self.model = split(self.model, pull.strongest(self.config.mapping.densify_gradient, room))
        self._refiner.adam.extend(self.model)

    def _prune(self) -> None:
        keep = worth_keeping(self.model, self.config.mapping)
        if not keep.all():
            self._select(keep.nonzero()[:, 0])
        excess = len(self.model) - self.config.mapping.max_gaussians
        if excess > 0:
            self.model, rows = merge_alike(self.model, excess)
            self._refiner.adam.select(rows)
        if len(self.model) > self.config.mapping.max_gaussians:
            self._select(fittest(self.model, self.config.mapping.max_gaussians))

    def _select(self, index: torch.Tensor) -> None:
        self.model = self.model.select(index)
        self._refiner.adam.select(index)
