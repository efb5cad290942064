"""The only writer of the map: takes keyframes in, keeps the Gaussians true to them, publishes snapshots."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.config import Config
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.mapping.fusion import guessed_gaussians, model_depth, new_gaussians, unexplained, view_of, weigh
from splatbot.mapping.keyframes import Keyframe, is_keyframe, mapping_images
from splatbot.mapping.prune import fittest, worth_keeping
from splatbot.mapping.refine import Refiner
from splatbot.tracking.features import Features
from splatbot.tracking.prepare import PreparedFrame, valid_share, with_depth
from splatbot.tracking.reference import Reference, make_reference


class Mapper:
    """Holds the keyframes and the model."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.keyframes: list[Keyframe] = []
        self.model = GaussianModel.empty()
        self._refiner = Refiner(config.mapping, config.seed)
        self._refiner.adam.extend(self.model)
        self._version = 0
        self._stamp = 0.0

    def wants(self, prepared: PreparedFrame, T_world_camera: NDArray[np.float64]) -> bool:
        """Whether a frame at this pose would be a keyframe: a new view, with depth for later frames to align to."""
        if valid_share(prepared) < self.config.tracking.min_valid:
            return False
        return is_keyframe(T_world_camera, self.keyframes, self.config.mapping)

    def insert(self, prepared: PreparedFrame, T_world_camera: NDArray[np.float64], features: Features) -> Keyframe:
        """Fuse a frame into the map, refine, and make it a reference for tracking."""
        keyframe = self._make_keyframe(prepared, T_world_camera, features)
        self.keyframes.append(keyframe)
        self._weigh(keyframe)
        self._add(keyframe)
        self._prune()
        self._refiner.refine(self.model, self.keyframes, self.config.mapping.refine_iterations)
        self._prune()  # or what refinement made faint, huge or not finite would be rendered
        keyframe.reference = self._model_reference(prepared, keyframe)
        self._version += 1
        self._stamp = prepared.frame.stamp
        return keyframe

    def finish(self) -> None:
        """Refine over all keyframes once no more will come."""
        self._refiner.refine_all(self.model, self.keyframes, self.config.mapping.final_iterations)
        self._prune()
        self._version += 1

    def snapshot(self) -> Snapshot:
        """The map as it is, copied."""
        return Snapshot(self.model.clone(), self._version, self._stamp)

    def _make_keyframe(
        self, prepared: PreparedFrame, T_world_camera: NDArray[np.float64], features: Features
    ) -> Keyframe:
        camera, rgb, depth = mapping_images(prepared.frame, self.config.mapping, self.config.tracking)
        return Keyframe(
            number=len(self.keyframes),
            camera=camera,
            rgb=torch.from_numpy(np.ascontiguousarray(rgb)),
            depth=torch.from_numpy(depth),
            T_world_camera=T_world_camera,
            features=features,
            reference=Reference(T_world_camera, ()),
        )

    def _weigh(self, keyframe: Keyframe) -> None:
        evidence = weigh(self.model, keyframe, self.config.mapping)
        self.model.observations += evidence.supported.int()
        # Seen through once may be a wrong depth; its opacity halves, roughly, each time, until it is pruned. A guess
        # that is seen through was wrong.
        self.model.opacity_logits -= evidence.seen_through.float()
        self.model.opacity_logits[evidence.seen_through & (self.model.observations == 0)] = -10.0

    def _add(self, keyframe: Keyframe) -> None:
        view = view_of(self.model, keyframe.camera, keyframe.T_world_camera)
        measured = new_gaussians(keyframe, unexplained(view, keyframe.depth, self.config.mapping), self.config.mapping)
        guessed = guessed_gaussians(view, keyframe, self.config.mapping)
        self.model = GaussianModel.concatenate([self.model, measured, guessed])
        self._refiner.adam.extend(self.model)

    def _prune(self) -> None:
        keep = worth_keeping(self.model, self.config.mapping)
        if not keep.all():
            self._select(keep.nonzero()[:, 0])
        if len(self.model) > self.config.mapping.max_gaussians:
            self._select(fittest(self.model, self.config.mapping.max_gaussians))

    def _select(self, index: torch.Tensor) -> None:
        self.model = self.model.select(index)
        self._refiner.adam.select(index)

    def _model_reference(self, prepared: PreparedFrame, keyframe: Keyframe) -> Reference:
        """What later frames are aligned to: the frame's own grey, the map's depth where the map is solid."""
        finest = prepared.levels[0]
        view = view_of(self.model, finest.camera, keyframe.T_world_camera)
        depth = model_depth(view, finest.depth, self.config.mapping)
        levels = with_depth(prepared.levels, depth)
        return make_reference(levels, keyframe.T_world_camera, self.config.tracking.n_pixels)
