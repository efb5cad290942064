"""SBZ: decoded ellipsoids contain the encoded ones, fields stay conservative, sizes, images and hostile files."""

from __future__ import annotations

import lzma
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from splatbot.collision import GaussianCollisionField
from splatbot.collision.solids import MIN_OPACITY, SolidGate
from splatbot.errors import FormatError, InputError
from splatbot.formats import load_gaussians
from splatbot.formats.sbz import GATES, load_sbz, save_sbz
from splatbot.gaussians import GaussianModel
from splatbot.logs import open_log
from splatbot.rasterize.views import render_view
from splatbot.run import map_log
from splatbot.segmentation.objects import CONSTANTS as OBJECTS
from splatbot.trajectory import Trajectory
from tests.unit.formats.models import detailed_model, errors
from tests.unit.formats.solids import HARD, Array, farthest, hard_model

HEADER = struct.Struct("<3sBIBhIII3f18B")
FILTERS = [{"id": lzma.FILTER_LZMA1, "preset": 6, "lc": 0, "lp": 0, "pb": 0}]
N_SIGMAS = (1.0, 2.0, 3.0)


def coded(model: GaussianModel, path: Path) -> GaussianModel:
    """Return a model after a round trip, in the order of its anchors."""
    save_sbz(model, path)
    back = load_sbz(path)
    return back.select(torch.argsort(back.anchors))


def spheres(model: GaussianModel, count: int, rng: np.random.Generator) -> Array:
    """Return spheres (count, 4) [m] of which about half touch the map: near Gaussians, of radii up to 5 cm."""
    near = model.means.numpy()[rng.integers(0, len(model), count)]
    return np.concatenate([near + rng.normal(0.0, 0.03, (count, 3)), rng.uniform(0.0, 0.05, (count, 1))], axis=1)


def surface_map(n: int = 3000) -> GaussianModel:
    """Return flat Gaussians of 5 mm by 5 mm by 0.5 mm on a sphere of 30 cm, as in a mapped log."""
    rng = np.random.default_rng(5)
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    x, y, z = normals.T
    quats = np.stack([1.0 + z, -y, x, np.zeros(n)], axis=1)  # turn the axis z to the normal
    model = hard_model("common", n)
    return replace(
        model,
        means=torch.from_numpy(0.3 * normals).float(),
        quats=torch.from_numpy(quats).float(),
        log_scales=torch.from_numpy(np.log((0.005, 0.005, 0.0005)) + rng.normal(0.0, 0.4, (n, 3))).float(),
        opacity_logits=torch.full((n,), 2.0),
        observations=torch.ones(n, dtype=torch.int32),
    )


def free_but_hit(before: GaussianModel, after: GaussianModel, balls: Array, n_sigma: float) -> int:
    """Return how many spheres collide with the first map, but not with the second one."""
    was, now = (GaussianCollisionField(model, n_sigma).in_collision(balls) for model in (before, after))
    assert 0.1 < was.mean() < 0.9
    return int(np.count_nonzero(was & ~now))


@pytest.mark.parametrize("kind", HARD)
def test_decoded_ellipsoids_contain_the_encoded_ones(tmp_path: Path, kind: str) -> None:
    model = hard_model(kind)
    back = coded(model, tmp_path / "map.sbz")
    for n_sigma in (*N_SIGMAS, 1000.0):
        assert farthest(model, back, n_sigma).max() <= 1.0


def test_no_sphere_that_hits_a_map_is_free_in_the_decoded_one(tmp_path: Path, rng: np.random.Generator) -> None:
    model = surface_map()
    back = coded(model, tmp_path / "map.sbz")
    balls = spheres(model, 1_000_000, rng)
    for n_sigma, part in zip(N_SIGMAS, np.array_split(balls, 3), strict=True):
        assert free_but_hit(model, back, part, n_sigma) == 0


@pytest.mark.parametrize("n_sigma", N_SIGMAS)
def test_a_sphere_that_just_touches_a_map_is_not_free(tmp_path: Path, rng: np.random.Generator, n_sigma: float) -> None:
    model = surface_map()
    back = coded(model, tmp_path / "map.sbz")
    points = spheres(model, 100_000, rng)[:, :3]
    distance = GaussianCollisionField(model, n_sigma).clearance(points).distance
    touching = np.column_stack([points, distance + 1e-9])[distance > 0]
    assert GaussianCollisionField(back, n_sigma).in_collision(touching).all()


def test_the_gates_of_a_field_keep_each_gaussian(tmp_path: Path) -> None:
    assert (MIN_OPACITY, OBJECTS.min_opacity) == GATES
    model = hard_model("common", 5000)
    back = coded(model, tmp_path / "map.sbz")
    for gate in GATES:
        for observations in (0, 1, 5):
            solid = [SolidGate(gate, observations).solid(either) for either in (model, back)]
            assert (solid[1] >= solid[0]).all()
            assert np.count_nonzero(solid[1] != solid[0]) <= 0.02 * len(model)


def test_bookkeeping_is_kept(tmp_path: Path) -> None:
    model = hard_model("common", 300)
    model.anchors[:2] = torch.tensor([-(2**31), 2**31 - 1], dtype=torch.int32)
    save_sbz(model, tmp_path / "map.sbz")
    back = load_gaussians(tmp_path / "map.sbz")
    rows, own = torch.argsort(back.anchors), torch.argsort(model.anchors)
    for name in ("observations", "anchors", "misses"):
        assert torch.equal(getattr(back, name)[rows], getattr(model, name)[own])
    was, now = model.uncertainty[own].double(), back.uncertainty[rows].double()
    assert torch.equal(was == 0, now == 0)
    assert (now >= 0.9999 * was).all()
    assert (now <= 1.4143 * was).all()


def test_colours_are_within_their_steps(tmp_path: Path) -> None:
    model = hard_model("common", 500)
    back = coded(model, tmp_path / "map.sbz")
    colors = [either.sh[:, 0] * 0.28209479 + 0.5 for either in (model, back)]
    assert errors(*colors).max() <= 0.5 / 64 + 1 / 64 + 1e-6  # luma, and the two differences


def test_opacities_shrink_as_areas_grow(tmp_path: Path) -> None:
    model = surface_map()
    back = coded(model, tmp_path / "map.sbz")
    light = [either.opacities * either.scales.sort(dim=1)[0][:, 1:].prod(dim=1) for either in (model, back)]
    assert float(light[1].sum() / light[0].sum()) == pytest.approx(1.0, abs=0.02)


def test_a_second_encoding_grows_as_the_first_one(tmp_path: Path) -> None:
    once = coded(surface_map(), tmp_path / "map.sbz")
    twice = coded(once, tmp_path / "map.sbz")
    grown = (twice.log_scales - once.log_scales).numpy()
    assert grown.min() > -1e-6
    assert grown.mean() < 0.12
    assert grown.max() < 0.5
    assert farthest(once, twice, 1.0).max() <= 1.0


def test_files_are_repeatable_and_small(tmp_path: Path) -> None:
    model = surface_map()
    for name in ("a.sbz", "b.sbz"):
        save_sbz(model, tmp_path / name)
    assert (tmp_path / "a.sbz").read_bytes() == (tmp_path / "b.sbz").read_bytes()
    assert (tmp_path / "a.sbz").stat().st_size <= 14 * len(model)  # colours and bookkeeping here are noise


@pytest.mark.parametrize(
    ("field", "value"),
    [("means", 1e7), ("log_scales", 14.0), ("uncertainty", -1.0), ("uncertainty", np.nan), ("means", np.inf)],
)
def test_a_map_that_no_field_takes_is_refused(tmp_path: Path, field: str, value: float) -> None:
    model = hard_model("common", 10)
    getattr(model, field)[3] = value
    with pytest.raises(InputError) as caught:
        save_sbz(model, tmp_path / "map.sbz")
    assert (caught.value.file, caught.value.field) == (str(tmp_path / "map.sbz"), field)
    assert not list(tmp_path.iterdir())


@pytest.fixture
def sound(tmp_path: Path) -> Path:
    """A small file."""
    save_sbz(detailed_model(60), tmp_path / "map.sbz")
    return tmp_path / "map.sbz"


def rewrite(path: Path, header: dict[int, int], stream: dict[int, int] | None = None) -> None:
    """Replace fields of the header and bytes of the stream, and correct the checksum."""
    data = path.read_bytes()
    values = list(HEADER.unpack_from(data))
    body = bytearray(lzma.decompress(data[HEADER.size :], lzma.FORMAT_RAW, filters=FILTERS))
    for place, value in header.items():
        values[place] = value
    for place, value in (stream or {}).items():
        body[place] = value
    claimed = values[5] + values[2] * sum(values[11:]) + values[6]
    values[7] = 0
    values[7] = zlib.crc32(body[:claimed], zlib.crc32(HEADER.pack(*values)))
    path.write_bytes(HEADER.pack(*values) + lzma.compress(bytes(body), lzma.FORMAT_RAW, filters=FILTERS))


@pytest.mark.parametrize("keep", [3, 30, 60, 0.5, 0.99])
def test_a_truncated_file_is_named(sound: Path, keep: float) -> None:
    data = sound.read_bytes()
    sound.write_bytes(data[: int(keep if keep > 1 else keep * len(data))])
    with pytest.raises(FormatError, match=r"damaged or truncated.*Fix: ") as caught:
        load_gaussians(sound)
    assert caught.value.file == str(sound)


def test_each_flipped_bit_is_found(sound: Path) -> None:
    data = sound.read_bytes()
    for place in range(3, len(data), 7):
        sound.write_bytes(data[:place] + bytes([data[place] ^ 16]) + data[place + 1 :])
        with pytest.raises(FormatError) as caught:
            load_sbz(sound)
        assert caught.value.file == str(sound)


@pytest.mark.parametrize(
    ("place", "value", "field"),
    [
        (1, 2, "version"),
        (2, 0, "count"),
        (2, 2**32 - 1, "count"),
        (2, 49_000_000, "count"),
        (2, 59, "octree"),
        (3, 22, "octree"),
        (3, 1, "octree"),
        (4, 99, "octree"),
        (5, 2**31, "count"),
        (5, 3, "octree"),
        (6, 0, "turns"),
        (11, 5, "columns"),
    ],
)
def test_a_wrong_header_with_its_checksum_is_refused(sound: Path, place: int, value: int, field: str) -> None:
    rewrite(sound, {place: value})
    with pytest.raises(FormatError) as caught:
        load_sbz(sound)
    assert caught.value.file == str(sound)
    assert caught.value.field == field


def test_streams_with_any_values_are_refused_or_finite(sound: Path, rng: np.random.Generator) -> None:
    data = sound.read_bytes()
    size = len(lzma.decompress(data[HEADER.size :], lzma.FORMAT_RAW, filters=FILTERS))
    refused = 0
    for _ in range(120):
        sound.write_bytes(data)
        rewrite(sound, {}, {int(rng.integers(0, size)): int(rng.integers(0, 256)) for _ in range(3)})
        try:
            model = load_sbz(sound)
        except FormatError:
            refused += 1
        else:
            assert torch.isfinite(model.means).all()
            assert torch.isfinite(model.scales).all()
    assert 0 < refused < 120


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", ["arm_wrist_48", "apc_shelf_robot"])
def test_a_mapped_log_is_small_and_stays_conservative(data_root: Path, tmp_path: Path, name: str) -> None:
    log = open_log(data_root / name)
    map_log(log, out=tmp_path, report=False)
    model = GaussianModel.load(tmp_path / "map.ply")
    save_sbz(model, tmp_path / "map.sbz")
    back = load_sbz(tmp_path / "map.sbz")
    assert (tmp_path / "map.sbz").stat().st_size <= 10 * len(model)
    rng = np.random.default_rng(1)
    for n_sigma in N_SIGMAS:
        for _ in range(7):
            assert free_but_hit(model, back, spheres(model, 500_000, rng), n_sigma) == 0
    path = Trajectory.load(tmp_path / "trajectory.tum")
    losses = []
    for index in range(2, len(log), 4):
        frame = log[index]
        pose = path.T_world_camera[int(np.abs(path.stamps - frame.stamp).argmin())]
        noise = [np.mean((render_view(m, frame.camera, pose) - frame.rgb / 255.0) ** 2) for m in (model, back)]
        losses.append(10.0 * np.log10(noise[1] / noise[0]))
    assert np.mean(losses) <= 0.1  # [dB]
