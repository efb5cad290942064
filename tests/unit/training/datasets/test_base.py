"""Split and extent of a dataset, and the recognition of its kind."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.layouts import dataset_kind
from splatbot.training.datasets import TrainingData, TrainingView, open_dataset
from tests.unit.training.datasets.scenes import transforms_scene


def dataset(centers: Sequence[Sequence[float]], held_out_names: tuple[str, ...] = ()) -> TrainingData:
    """Build a dataset with cameras at ``centers``."""
    views = []
    for index, center in enumerate(centers):
        T = np.eye(4)
        T[:3, 3] = center
        image = np.zeros((3, 4, 3), np.uint8)
        views.append(TrainingView(f"{index:03d}", Camera(4, 4, 1.5, 1, 4, 3), T, image.copy))
    return TrainingData(
        "colmap", Path("scene"), tuple(views), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), held_out_names
    )


def names(views: Sequence[TrainingView]) -> list[str]:
    """Return the names of views."""
    return [view.name for view in views]


def test_each_eighth_view_is_held_out_if_the_dataset_marks_none() -> None:
    train, held_out = dataset([(i, 0, 0) for i in range(20)]).split()
    assert names(held_out) == ["000", "008", "016"]
    assert sorted(names(train) + names(held_out)) == [f"{i:03d}" for i in range(20)]


def test_marked_views_are_held_out_instead() -> None:
    train, held_out = dataset([(i, 0, 0) for i in range(4)], ("002", "003")).split(every=2)
    assert (names(train), names(held_out)) == (["000", "001"], ["002", "003"])


@pytest.mark.parametrize("marked", [(), ("001",)])
def test_every_0_trains_on_all_views(marked: tuple[str, ...]) -> None:
    train, held_out = dataset([(i, 0, 0) for i in range(4)], marked).split(every=0)
    assert (len(train), held_out) == (4, ())


@pytest.mark.parametrize("every", [-1, 1])
def test_split_without_training_views_is_refused(every: int) -> None:
    with pytest.raises(InputError, match="every"):
        dataset([(i, 0, 0) for i in range(4)]).split(every)


def test_extent_is_1_1_times_the_largest_distance_from_the_mean_camera() -> None:
    assert dataset([(0, 0, 0), (4, 0, 0), (2, 0, 3), (2, 0, -3)]).scene_extent == pytest.approx(3.3)
    assert 0 < dataset([(5, 5, 5)]).scene_extent < 0.01


def test_folder_of_no_known_kind_names_the_expected_files(tmp_path: Path) -> None:
    for folder, problem in ((tmp_path, "holds no dataset"), (tmp_path / "none", "does not exist")):
        with pytest.raises(InputError, match=rf"{problem}.*sparse/0.*transforms_train\.json.*splatbot map"):
            open_dataset(folder)


def test_kinds_are_recognized_by_names_alone(tmp_path: Path) -> None:
    kinds = {
        "colmap": ["sparse/0/cameras.bin"],
        "blender": ["transforms_train.json"],
        "nerfstudio": ["transforms.json"],
        "run": ["map.ply", "trajectory.tum", "config.yaml"],
    }
    for kind, files in kinds.items():
        for name in files:
            (tmp_path / kind / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / kind / name).touch()
        assert dataset_kind(tmp_path / kind) == kind


def test_scale_below_1_is_refused(tmp_path: Path) -> None:
    transforms_scene(tmp_path)
    with pytest.raises(InputError, match="scale"):
        open_dataset(tmp_path, scale=0)
