"""A resumed run has the same bits as an uninterrupted one, and a state that does not fit is refused with a reason."""

from __future__ import annotations

import json
import re
import shutil
import warnings
from collections import deque
from dataclasses import fields as dataclass_fields
from dataclasses import is_dataclass, replace
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import pytest
import torch

from splatbot.camera import Camera
from splatbot.config import Config, MappingConfig
from splatbot.errors import DeprecatedNameWarning, FormatError, InputError, LogError
from splatbot.geometry import inverse
from splatbot.logs import open_log
from splatbot.run import Progress, map_log
from splatbot.run.state import SavedRun
from splatbot.run.state.container import read_container, write_container
from splatbot.run.state.journal import Journal, read_entry
from splatbot.run.state.pixels import pack, unpack
from splatbot.run.state.schema import FORMAT_VERSION, TYPES
from splatbot.run.state.tree import Decoder, Encoder
from splatbot.slam import Slam
from splatbot.tracking.place_recognition import likeliest, votes
from splatbot.tracking.tracker import pose_distance
from tests.rgbd import small_config

OLD_RUN = Path(__file__).parents[2] / "data" / "old_run"
RUN_V2 = Path(__file__).parents[2] / "data" / "run_v2"  # 4 of 6 frames, by the last version with one camera a map
LOG = "synthetic:tabletop?width=160&height=120&frames=14"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was not interrupted."""
    out = tmp_path_factory.mktemp("whole")
    map_log(open_log(LOG), out=out, config=small_config(), report=False)
    return out


@pytest.fixture(scope="module")
def half(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that ended after half of the frames."""
    out = tmp_path_factory.mktemp("half")
    map_log(open_log(LOG), out=out, config=small_config(), max_frames=7, save_every=0.0, report=False)
    return out


@pytest.fixture
def copy(half: Path, tmp_path: Path) -> Path:
    """The half run, to be damaged or gone on with."""
    shutil.copytree(half, tmp_path / "run")
    return tmp_path / "run"


def test_a_resumed_run_is_bit_for_bit_the_uninterrupted_one(whole: Path, copy: Path) -> None:
    saved = SavedRun.load(copy)
    assert saved.place.next_index == 7
    map_log(open_log(LOG), out=copy, resume=saved, report=False)
    for name in ("trajectory.tum", "map.ply", "config.yaml"):
        assert (copy / name).read_bytes() == (whole / name).read_bytes(), name


def test_a_resumed_run_of_a_later_part_is_bit_for_bit_the_uninterrupted_one(tmp_path: Path) -> None:
    part, log = {"config": small_config(), "first_frame": 5, "report": False}, open_log(LOG)
    map_log(log, out=tmp_path / "whole", max_frames=6, **part)  # type: ignore[arg-type]
    map_log(log, out=tmp_path / "run", max_frames=2, save_every=0.0, **part)  # type: ignore[arg-type]
    saved = SavedRun.load(tmp_path / "run")
    assert saved.place.next_index == 7
    resumed = map_log(log, out=tmp_path / "run", resume=saved, max_frames=6, save_every=1e9, report=False)
    for name in ("trajectory.tum", "map.ply"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    assert resumed.metrics["frames_planned"] == 6
    assert SavedRun.load(tmp_path / "run").place.next_index == 11


def test_a_run_resumed_three_times_is_still_the_same(whole: Path, tmp_path: Path) -> None:
    map_log(open_log(LOG), out=tmp_path, config=small_config(), max_frames=3, save_every=0.0, report=False)
    for frames in (4, 9, 14):
        map_log(
            open_log(LOG), out=tmp_path, resume=SavedRun.load(tmp_path), max_frames=frames, save_every=1e9, report=False
        )
    assert (tmp_path / "trajectory.tum").read_bytes() == (whole / "trajectory.tum").read_bytes()
    assert len(list((tmp_path / "state").iterdir())) == 2


def test_a_paced_run_is_resumed_with_its_counts(tmp_path: Path) -> None:
    patient = small_config(tracking__budget_ms=1000.0)  # on a busy machine no stage is skipped for lack of time
    map_log(open_log(LOG), out=tmp_path, config=patient, max_frames=7, rate=4.0, save_every=0.0, report=False)
    saved = SavedRun.load(tmp_path)
    assert saved.config.mapping.threaded
    result = map_log(open_log(LOG), out=tmp_path, resume=saved, rate=4.0, report=False)
    counts = result.metrics
    assert counts["frames"] + counts["dropped"] == 14
    assert counts["lost"] == 0
    assert counts["ate_rmse_m"] < 2e-3


def test_saving_does_not_change_the_run(whole: Path, tmp_path: Path) -> None:
    map_log(open_log(LOG), out=tmp_path, config=small_config(), save_every=0.0, report=False)
    assert (tmp_path / "map.ply").read_bytes() == (whole / "map.ply").read_bytes()


@pytest.mark.parametrize("rate", [None, 6.0])
@pytest.mark.parametrize(("after", "always"), [(1, False), (5, False), (5, True)])
def test_a_run_that_a_callback_interrupts_is_saved(
    rate: float | None, after: int, always: bool, tmp_path: Path
) -> None:
    def interrupt(progress: Progress) -> None:
        if progress.done >= after and (always or progress.phase == "mapping"):
            raise KeyboardInterrupt

    log, run = open_log(LOG), tmp_path / "run"
    result = map_log(
        log, out=run, config=small_config(), rate=rate, save_every=1e9, on_progress=interrupt, report=False
    )
    assert result.metrics["interrupted"]
    saved = SavedRun.load(run)
    assert saved.place.next_index == len((run / "frames.jsonl").read_text().splitlines()) >= after
    resumed = map_log(log, out=run, resume=saved, max_frames=9, report=False)
    assert resumed.metrics["frames"] + resumed.metrics["dropped"] == 9


def test_images_are_written_once(tmp_path: Path) -> None:
    sizes: list[tuple[int, int]] = []

    def watch(progress: Progress) -> None:
        journal = next((tmp_path / "state").glob("images-*.bin"), None)
        if journal is not None and progress.phase == "mapping":
            sizes.append((progress.keyframes, journal.stat().st_size))

    map_log(open_log(LOG), out=tmp_path, config=small_config(), save_every=0.0, on_progress=watch, report=False)
    (few, small), (many, large) = sizes[0], sizes[-1]
    assert many > few
    assert large < 1.5 * small * many / few


def test_the_world_stays_the_maps_when_a_log_is_only_localised(copy: Path, tmp_path: Path) -> None:
    log = open_log("synthetic:tabletop?width=160&height=120&frames=9")
    saved = SavedRun.load(copy)
    before = saved.slam.snapshot().model.clone()
    shifted = [replace(log[i], index=i - 4) for i in range(4, 9)]  # begins where the map's first frame is not
    slam = saved.slam
    slam.localise_only()
    truth = log.ground_truth
    assert truth is not None
    assert slam.process(shifted[0]).reasons == ("found again, the next frame must confirm it",)
    for frame in shifted[1:]:
        T = slam.process(frame).T_world_camera
        assert T is not None
        exact = inverse(truth.T_world_camera[0]) @ truth.T_world_camera[frame.index + 4]
        assert pose_distance(exact, T)[0] < 3e-3
    slam.finish()
    assert torch.equal(slam.snapshot().model.means, before.means)
    assert torch.equal(slam.snapshot().model.observations, before.observations)


def test_a_localised_log_says_in_which_map(copy: Path, tmp_path: Path) -> None:
    result = map_log(open_log(LOG), out=tmp_path / "again", localise=SavedRun.load(copy), max_frames=5, report=False)
    assert result.metrics["localised_in"] == str(copy.resolve())
    assert result.metrics["keyframes"] == 0
    assert result.metrics["ate_rmse_m"] < 2e-3


def test_an_empty_map_cannot_be_localised_in() -> None:
    with pytest.raises(InputError, match="no keyframes"):
        Slam(small_config()).localise_only()


def test_the_place_that_looks_alike_gets_most_votes(half: Path) -> None:
    keyframes = SavedRun.load(half).slam.keyframes
    for k, keyframe in enumerate(keyframes):
        assert likeliest(keyframe.features, keyframes, 1) == [k]
    assert votes(keyframes[0].features, []).shape == (0,)


@pytest.mark.parametrize("name", ["run.state", "images-0.bin"])
@pytest.mark.parametrize("share", [0.0, 0.001, 0.4, 0.999])
def test_a_state_that_is_cut_off_is_refused_with_its_file(copy: Path, name: str, share: float) -> None:
    path = copy / "state" / name
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(FormatError, match=name):
        SavedRun.load(copy)


@pytest.mark.parametrize("name", ["run.state", "images-0.bin"])
@pytest.mark.parametrize("share", [0.01, 0.3, 0.6, 0.95])
def test_a_flipped_bit_is_found(copy: Path, name: str, share: float) -> None:
    path = copy / "state" / name
    data = bytearray(path.read_bytes())
    data[int(share * len(data))] ^= 0x10
    path.write_bytes(bytes(data))
    with pytest.raises(FormatError, match=name):
        SavedRun.load(copy)


def test_a_folder_without_a_state_says_how_to_get_one(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="--save-every"):
        SavedRun.load(tmp_path)


@pytest.mark.parametrize(
    ("uri", "what"),
    [
        ("synthetic:tabletop?width=160&height=120&frames=5", "frames"),
        ("synthetic:tabletop?width=160&height=120&frames=14&rate=20", "frame 6"),
        ("synthetic:tabletop?width=160&height=120&frames=14&arc=20", "frame 6"),
    ],
)
def test_another_log_than_the_one_begun_with_is_refused(copy: Path, uri: str, what: str) -> None:
    with pytest.raises(LogError, match=what):
        map_log(open_log(uri), out=copy, resume=SavedRun.load(copy), report=False)


@pytest.mark.parametrize(
    "array",
    [
        np.random.default_rng(0).integers(0, 256, (7, 5, 3), dtype=np.uint8),
        np.array([[1.5, np.nan, -0.0], [np.inf, 1e-40, 3.0]], np.float32),
        np.arange(6, dtype=np.float64).reshape(2, 3),
        np.zeros((0, 32), np.uint8),
        np.float32(3.0).reshape(()),
    ],
)
def test_arrays_are_packed_without_losing_a_bit(array: Any) -> None:
    again = unpack(pack(array, compress=True))
    assert again.dtype == array.dtype
    assert again.shape == array.shape
    assert again.tobytes() == array.tobytes()


def test_values_of_every_kind_come_back_and_shared_ones_stay_shared() -> None:
    config = Config()
    camera = Camera(1.0, 2.0, 3.0, 4.0, 5, 6)
    generator = np.random.default_rng(3)
    generator.random(5)
    shared = np.arange(3.0)
    value: dict[str, Any] = {
        "plain": [None, True, 3, -2.5, "text", float("nan"), float("inf")],
        "nested": (1, {2: {3.5}}, deque([4])),
        "shared": [shared, shared, torch.arange(3)],
        "object": camera,
        "section": config.mapping,
        "random": generator,
    }
    encoder = Encoder(config, lambda owner, array: None)
    tree = encoder.encode(value)
    back = Decoder(config, [a.copy() for a in encoder.arrays], lambda entry: shared).decode(tree)
    assert back["plain"][:5] == value["plain"][:5]
    assert np.isnan(back["plain"][5])
    assert back["nested"] == value["nested"]
    assert back["shared"][0] is back["shared"][1]
    assert torch.equal(back["shared"][2], torch.arange(3))
    assert back["object"] == camera
    assert back["section"] is config.mapping
    assert back["random"].random() == generator.random()


def test_weak_references_to_an_object_that_others_hold_are_saved() -> None:
    key = Camera(1.0, 2.0, 3.0, 4.0, 5, 6)
    encoder = Encoder(Config(), lambda owner, array: None)
    tree = encoder.encode([key, WeakKeyDictionary({key: 7})])
    held, weak = Decoder(Config(), [], lambda entry: np.zeros(0)).decode(tree)
    assert weak[held] == 7


@pytest.mark.parametrize("value", [open, object(), np.array([object()]), Path(), MappingConfig(stride=7)])
def test_values_that_cannot_be_saved_are_refused_not_dropped(value: object) -> None:
    with pytest.raises(TypeError):
        Encoder(Config(), lambda owner, array: None).encode({"value": value})


@pytest.mark.parametrize("version", [1, FORMAT_VERSION])
@pytest.mark.parametrize("name", ["os:system", "splatbot.slam:time", "splatbot.slam:Nothing", "splatbot.cli:main"])
def test_a_state_makes_no_object_but_those_of_the_slam(name: str, version: int) -> None:
    tree = {"$": "object", "class": name, "type": name, "is": {}}
    with pytest.raises(ValueError, match=name):
        Decoder(Config(), [], lambda entry: np.zeros(0), version).decode(tree)


def test_an_attribute_that_the_schema_does_not_list_is_refused() -> None:
    camera = Camera(1.0, 2.0, 3.0, 4.0, 5, 6)
    object.__setattr__(camera, "shutter", 0.01)
    with pytest.raises(TypeError, match=r"Camera\.shutter"):
        Encoder(Config(), lambda owner, array: None).encode(camera)


@pytest.mark.parametrize("fields", [{}, {"number": 1}, {"first": 1, "unknown": 2}])
def test_an_object_with_other_fields_than_the_schema_is_refused(fields: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="edge has other fields"):
        Decoder(Config(), [], lambda entry: np.zeros(0)).decode({"$": "object", "type": "edge", "is": fields})


def test_a_saved_run_names_no_module_class_or_private_attribute(half: Path) -> None:
    header, _ = read_container(half / "state" / "run.state")
    assert header["format"] == FORMAT_VERSION
    text = json.dumps(header["tree"])
    assert "splatbot" not in text
    assert not re.search(r'"_\w+":', text)


def test_the_schema_lists_each_type_and_attribute_once() -> None:
    assert len({saved.cls for saved in TYPES.values()}) == len(TYPES)
    for name, saved in TYPES.items():
        assert len(set(saved.fields.values())) == len(saved.fields), name
        assert not saved.transient & set(saved.fields.values()), name
        if is_dataclass(saved.cls):
            assert set(saved.fields.values()) == {field.name for field in dataclass_fields(saved.cls)}, name


def test_a_state_of_a_later_version_is_refused(copy: Path) -> None:
    path = copy / "state" / "run.state"
    header, arrays = read_container(path)
    write_container(path, header | {"format": FORMAT_VERSION + 1}, arrays)
    with pytest.raises(FormatError, match=f"version {FORMAT_VERSION + 1}"):
        SavedRun.load(copy)


def test_a_run_of_the_second_format_resumes(tmp_path: Path) -> None:
    shutil.copytree(RUN_V2, tmp_path / "run")
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecatedNameWarning)
        saved = SavedRun.load(tmp_path / "run")
    assert saved.place.next_index == 4
    assert saved.slam._image_sizes == {"": (64, 48)}
    assert saved.slam._mapper._unmapped_seen == set()
    assert saved.slam._mapper._observed_stamps.keys() == {""}
    log = open_log("synthetic:tabletop?width=64&height=48&frames=6")
    resumed = map_log(log, out=tmp_path / "run", resume=saved, save_every=0.0, report=False)
    assert (resumed.metrics["frames"], resumed.metrics["lost"]) == (6, 0)
    assert resumed.metrics["ate_rmse_m"] < 2e-3
    assert SavedRun.load(tmp_path / "run").place.next_index == 6


def test_a_run_that_version_0_1_saved_is_resumed_and_localized_in_with_one_warning(tmp_path: Path) -> None:
    """The fixture is a threaded run of synthetic frames, saved before the format had a schema."""
    shutil.copytree(OLD_RUN, tmp_path / "run")
    log = open_log("synthetic:tabletop?frames=8&width=64&height=48")
    with pytest.warns(DeprecatedNameWarning, match=r"splatbot 0\.1") as caught:
        saved = SavedRun.load(tmp_path / "run")
    assert len(caught) == 1
    assert saved.place.next_index == 8
    assert len(saved.slam.keyframes) == 2
    assert saved.slam._mapper.version > 0
    assert saved.slam._location.keyframe == 1
    localized = map_log(log, out=tmp_path / "localized", localise=saved, report=False)
    assert localized.metrics["lost"] <= 1  # the first frame, which a second has to confirm
    assert localized.metrics["ate_rmse_m"] < 2e-3
    with pytest.warns(DeprecatedNameWarning):
        saved = SavedRun.load(tmp_path / "run")
    longer = open_log("synthetic:tabletop?frames=12&width=64&height=48")
    resumed = map_log(longer, out=tmp_path / "run", resume=saved, save_every=0.0, report=False)
    assert resumed.metrics["frames"] == 12
    assert resumed.metrics["lost"] == 0
    assert resumed.metrics["ate_rmse_m"] < 2e-3
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert SavedRun.load(tmp_path / "run").place.next_index == 12


def test_a_journal_that_is_mostly_waste_is_begun_anew(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    kept = np.arange(10.0)
    for round_ in range(4):
        journal.begin()
        entry = journal.put(kept, kept)
        journal.put(np.full(50, float(round_)), np.full(50, float(round_)))
        journal.sync()
        journal.finish()
        assert [p.name for p in tmp_path.iterdir()] == [journal.path.name]
        assert np.array_equal(read_entry(journal.path, entry), kept)
    assert journal.number > 0
    assert journal.path.stat().st_size < 4 * 50 * 8


def test_the_progress_of_a_later_part_counts_its_own_frames(tmp_path: Path) -> None:
    steps: list[tuple[int, int]] = []
    log, note = open_log(LOG), lambda step: steps.append((step.done, step.total))
    map_log(log, out=tmp_path, config=small_config(), first_frame=5, max_frames=3, report=False, on_progress=note)
    assert {total for _, total in steps} == {3}
    assert [done for done, _ in steps][:3] == [1, 2, 3]
