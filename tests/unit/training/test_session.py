"""A whole training from a dataset to a folder."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatbot.camera import Camera
from splatbot.errors import FormatError, InputError
from splatbot.gaussians import GaussianModel
from splatbot.training.datasets import TrainingData, TrainingView
from splatbot.training.distributed import planned_group
from splatbot.training.folder import TrainingFolder, TrainingSettings
from splatbot.training.images import check_memory
from splatbot.training.options import TrainingOptions
from splatbot.training.session import TrainingSession
from tests.unit.training.rendered import CAMERA, rendered_data, true_model


def session_of(
    folder: Path, data: TrainingData, *, every: int = 8, resume: bool = False, **options: Any
) -> TrainingSession:
    given: dict[str, Any] = {"iterations": 30, "background": "white", "strategy": "default"} | options
    settings = TrainingSettings(data.folder, 1, every, TrainingOptions(**given))
    place = TrainingFolder(folder)
    if not resume:
        place.begin(settings)
    return TrainingSession(data, place, settings, resume=resume)


@pytest.fixture(scope="module")
def data() -> TrainingData:
    return rendered_data(6, points=100)


def test_without_held_out_views_the_map_is_saved_and_the_scores_are_null(data: TrainingData, tmp_path: Path) -> None:
    session = session_of(tmp_path, data, every=0)
    session.run()
    scores = session.score()
    assert len(GaussianModel.load(tmp_path / "map.ply")) == scores["gaussians"]
    assert (scores["held_out"], scores["psnr_db"], scores["complete"]) == (0, None, True)
    assert json.loads((tmp_path / "scores.json").read_text())["ssim"] is None


def test_pixels_that_may_not_be_trained_on_do_not_count(data: TrainingData, tmp_path: Path) -> None:
    left = np.zeros((CAMERA.height, CAMERA.width), bool)
    left[:, : CAMERA.width // 2] = True
    spoilt = data.views[0].read()
    spoilt[left] = (255, 0, 255, 255)
    masks = {"clean": data.views[0], "all": replace(data.views[0], read_mask=partial(np.ones_like, left))}
    masks["spoilt"] = replace(data.views[0], read=partial(np.copy, spoilt), read_mask=partial(np.copy, left))
    found = {}
    for name, view in masks.items():
        session = session_of(tmp_path / name, replace(data, views=(view, *data.views[1:])), iterations=1)
        session.run()
        found[name] = session.score()
    assert found["all"]["held_out"] == 0
    assert found["spoilt"]["psnr_db"] == pytest.approx(found["clean"]["psnr_db"], abs=3)
    assert found["spoilt"]["ssim"] == pytest.approx(found["clean"]["ssim"], abs=0.25)


def test_a_folder_with_a_map_of_another_origin_is_not_overwritten(data: TrainingData, tmp_path: Path) -> None:
    (tmp_path / "map.ply").touch()
    with pytest.raises(InputError, match="holds a map already"):
        TrainingFolder(tmp_path).check_free(overwrite=True)


def test_other_images_than_at_the_start_are_refused_and_a_missing_checkpoint_begins_again(
    data: TrainingData, tmp_path: Path
) -> None:
    session = session_of(tmp_path, data, every=0, resume=True)
    assert session.trainer.iteration == 0
    session.run()
    with pytest.raises(InputError, match="other images"):
        session_of(tmp_path, replace(data, views=data.views[1:]), every=0, resume=True)
    assert session_of(tmp_path, data, every=0, resume=True).trainer.iteration == 30
    (tmp_path / "checkpoint.pt").write_bytes((tmp_path / "checkpoint.pt").read_bytes()[:-200])
    with pytest.raises(FormatError, match="damaged"):
        session_of(tmp_path, data, every=0, resume=True)


def test_a_resumed_training_ends_with_the_cameras_exposures_and_scores_of_one_that_was_not_stopped(
    data: TrainingData, tmp_path: Path
) -> None:
    options = {"refine_intrinsics": True, "exposure": True}
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    session = session_of(whole, data, **options)
    session.run()
    scores = session.score()
    stopped = session_of(cut, data, **options)
    stopped.run(stop=lambda: stopped.trainer.iteration == 17)
    resumed = session_of(cut, data, resume=True, **options)
    assert resumed.trainer.iteration == 17
    resumed.run()
    assert resumed.score() | {"seconds": 0.0} == scores | {"seconds": 0.0}
    assert scores["corrected_psnr_db"] >= scores["psnr_db"]
    for name in ("map.ply", "cameras.json", "exposures.json"):
        assert (cut / name).read_bytes() == (whole / name).read_bytes()
    (camera,) = TrainingFolder(cut).load_cameras()
    assert (camera.given, camera.views) == (CAMERA, 5)
    assert camera.refined != CAMERA
    transforms = json.loads((cut / "exposures.json").read_text())
    assert list(transforms) == [view.name for view in data.views[1:]]
    np.testing.assert_allclose(np.mean(list(transforms.values()), axis=0), np.eye(3, 4), atol=1e-12)


def test_images_beyond_the_free_memory_are_refused_with_a_scale_that_fits() -> None:
    def never() -> Any:
        raise AssertionError

    camera = Camera(1000.0, 1000.0, 0.0, 0.0, 60_000, 40_000)
    views = tuple(TrainingView(str(i), camera, np.eye(4), never) for i in range(1000))
    with pytest.raises(InputError, match=r"needs 12800.0 GB .*--scale \d+"):
        check_memory(Path("huge"), views)


def test_the_images_of_each_process_of_a_machine_count_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splatbot.training.images._free_memory", lambda: 1e9)
    camera = Camera(1000.0, 1000.0, 0.0, 0.0, 10_000, 10_000)
    views = [TrainingView("0", camera, np.eye(4), lambda: np.zeros((1, 1, 3), np.uint8))]  # 4/3 of 0.4 GB
    check_memory(Path("scene"), views)
    with pytest.raises(InputError, match=r"needs 1.1 GB for its images in 2 processes.* fewer --processes"):
        check_memory(Path("scene"), views, views)


def test_two_local_processes_need_the_memory_of_two(data: TrainingData, monkeypatch: pytest.MonkeyPatch) -> None:
    each = 4 / 3 * 4 * sum(view.camera.width * view.camera.height for view in data.views)
    monkeypatch.setattr("splatbot.training.images._free_memory", lambda: 1.5 * each / 0.7)
    settings = TrainingSettings(data.folder, 1, 0, TrainingOptions(iterations=1, batch=2))
    TrainingSession(data, TrainingFolder("unused"), settings)
    with pytest.raises(InputError, match="in 2 processes"):
        TrainingSession(data, TrainingFolder("unused"), settings, group=planned_group(2))


def test_a_new_training_removes_all_files_of_the_earlier_one_and_drafts_of_killed_ones(
    data: TrainingData, tmp_path: Path
) -> None:
    session = session_of(tmp_path, data, every=0)
    session.run()
    session.score(lambda rows, scores: {"course.png": b"", "held_out.jpg": b""})
    (tmp_path / "blocks" / "0").mkdir(parents=True)
    (tmp_path / ".map.ply.0123.tmp").touch()
    (tmp_path / ".0123.draft").mkdir()
    (tmp_path / "notes.txt").touch()  # not its own
    session_of(tmp_path, data, every=0)
    assert {path.name for path in tmp_path.iterdir()} == {"training.json", "notes.txt"}


def test_a_resumed_training_removes_drafts_of_killed_ones(data: TrainingData, tmp_path: Path) -> None:
    session_of(tmp_path, data, every=0).run()
    (tmp_path / ".map.ply.0123.tmp").touch()
    session_of(tmp_path, data, every=0, resume=True)
    assert not list(tmp_path.glob(".*"))


def test_the_start_of_a_higher_degree_is_cut_and_one_of_a_lower_degree_is_used_from_the_first_step(
    data: TrainingData, tmp_path: Path
) -> None:
    start = rendered_model(degree=2)
    for degree, expected in ((1, 1), (3, 2)):
        settings = TrainingSettings(data.folder, 1, 0, TrainingOptions(iterations=100, sh_degree=degree))
        session = TrainingSession(data, TrainingFolder(tmp_path), settings, start=start)
        session.trainer.step(0.0)
        assert session.trainer.model.sh_degree == expected


def rendered_model(degree: int) -> GaussianModel:
    model = true_model()
    sh = model.sh.new_zeros(len(model), (degree + 1) ** 2, 3)
    sh[:, :1] = model.sh
    return replace(model, sh=sh)
