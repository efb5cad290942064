"""Map files that are damaged at random: an error that names file and field, or a map; no crash, little memory."""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from splatbot.errors import FormatError
from splatbot.formats import FORMATS, load_gaussians, save_gaussians
from splatbot.formats.ksplat import Level, save_ksplat
from splatbot.formats.spz import Version, save_spz
from splatbot.gaussians import GaussianModel
from tests.unit.formats.models import detailed_model

CASES, MANY = 150, 5000
SLOWER = 30  # times, because another process reads each OpenUSD file
MAX_GROWTH_KB = 300_000  # of the process: below the 64 MiB that a header may claim without proof, in float32


def write_version(version: Version) -> Callable[[GaussianModel, Path], None]:
    """Return a writer of a version of SPZ."""
    return lambda model, path: save_spz(model, path, version)


def write_level(level: Level) -> Callable[[GaussianModel, Path], None]:
    """Return a writer of a level of .ksplat."""
    return lambda model, path: save_ksplat(model, path, level)


WRITERS: dict[str, Callable[[GaussianModel, Path], None]] = {
    "map2.spz": write_version(2),
    "map4.spz": write_version(4),
    "map0.ksplat": write_level(0),
    "map2.ksplat": write_level(2),
    **{f"map{entry.suffix}": save_gaussians for entry in FORMATS if entry.suffix != "_sog"},
}


def begin_peak() -> int:
    """Let the peak of this process's memory begin at the present value, and return it [kB]."""
    Path("/proc/self/clear_refs").write_text("5")
    return peak_kb()


def peak_kb() -> int:
    """Return the largest memory [kB] since :func:`begin_peak`."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))


def damage(sound: bytes, rng: np.random.Generator) -> bytes:
    """Return content with a random damage, of which half is in the first 200 bytes."""
    data = bytearray(sound)
    end = len(data) if rng.random() < 0.5 else min(200, len(data))
    kind = rng.integers(0, 5)
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(0, end))
        if kind == 0:
            return bytes(data[:at])
        if kind == 1:
            data[at] ^= 1 << int(rng.integers(0, 8))
        elif kind == 2:
            data[at] = int(rng.choice([0, 1, 127, 128, 255]))
        elif kind == 3:
            data[at : at + 8] = rng.bytes(8)
        else:
            data[at : at + 4] = struct.pack("<i", int(rng.choice([-1, 2**31 - 1, 0, -(2**31), 10**9])))
    return bytes(data)


def load(path: Path) -> GaussianModel | FormatError:
    """Return the map, or the refusal of it; any other error is a failure."""
    try:
        with np.errstate(all="ignore"):
            return load_gaussians(path)
    except FormatError as refusal:
        return refusal


def check(answer: GaussianModel | FormatError, name: str) -> bool:
    """Check a finite map, or a refusal that names file, field and fix; return whether it is a refusal."""
    if isinstance(answer, FormatError):
        assert name in str(answer.file)
        assert answer.field
        assert answer.hint
        return True
    for values in (answer.means, answer.quats, answer.log_scales, answer.opacity_logits, answer.sh):
        assert torch.isfinite(values).all()
    return False


def attack(path: Path, count: int, seed: int) -> int:
    """Load ``count`` damaged copies of a file, and return how many are refused."""
    rng, sound, refused, before = np.random.default_rng(seed), path.read_bytes(), 0, begin_peak()
    for _ in range(count):
        path.write_bytes(damage(sound, rng))
        refused += check(load(path), path.name)
    assert peak_kb() - before < MAX_GROWTH_KB
    return refused


def cases(name: str, usual: int) -> int:
    """Return the number of damaged copies of a file."""
    return usual // SLOWER if ".usd" in name else usual


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_damaged_maps_are_refused_or_read(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    WRITERS[name](detailed_model(80, degree=1), path)
    count = cases(name, CASES)
    assert attack(path, count, seed=1) > count // 10


@pytest.mark.parametrize("name", sorted(WRITERS))
@pytest.mark.long
def test_many_damaged_maps_are_refused_or_read(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    WRITERS[name](detailed_model(80, degree=1), path)
    count = cases(name, MANY)
    assert attack(path, count, seed=2) > count // 10


def test_the_peak_of_memory_is_measured_anew() -> None:
    np.ones(60_000_000)  # 480 MB, freed at once
    before = begin_peak()
    kept = np.ones(50_000_000)
    assert peak_kb() - before > 0.9 * kept.nbytes / 1024


def test_harmonics_count_in_the_size_that_a_glb_claims(tmp_path: Path) -> None:
    path = tmp_path / "map.glb"
    save_gaussians(detailed_model(80, degree=3), path)
    data = path.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + length])
    document["accessors"][0]["count"] = 1_100_000  # 53 MB without harmonics, 264 MB with them
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    path.write_bytes(b"glTF" + struct.pack("<III", 2, 20 + len(text) + len(rest), len(text)) + b"JSON" + text + rest)
    with pytest.raises(FormatError, match="claims 259,600,000 bytes"):
        load_gaussians(path)


def test_damaged_files_of_a_sog_folder_are_refused_or_read(tmp_path: Path) -> None:
    folder, rng = tmp_path / "map_sog", np.random.default_rng(3)
    save_gaussians(detailed_model(80, degree=1), folder)
    files = sorted(folder.iterdir())
    for number in range(CASES):
        file = files[number % len(files)]
        sound = file.read_bytes()
        file.write_bytes(damage(sound, rng))
        check(load(folder), folder.name)
        file.write_bytes(sound)


@pytest.mark.parametrize("field", ["count", "means", "scales", "quats", "sh0", "shN", "version"])
@pytest.mark.parametrize("value", [None, -1, 2**40, 1e308, "x", [], {}, [[]], True])
def test_wrong_kinds_of_values_in_meta_json_are_refused(tmp_path: Path, field: str, value: object) -> None:
    path = tmp_path / "map.sog"
    save_gaussians(detailed_model(20, degree=1), path)
    with zipfile.ZipFile(path) as sound:
        files = {name: sound.read(name) for name in sound.namelist()}
    files["meta.json"] = json.dumps(json.loads(files["meta.json"]) | {field: value}).encode()
    with zipfile.ZipFile(path, "w") as damaged:
        for name, content in files.items():
            damaged.writestr(name, content)
    if field == "shN" and not value:  # no harmonics beyond DC
        assert load_gaussians(path).sh_degree == 0
        return
    if field == "count" and value is True:
        assert len(load_gaussians(path)) == 1
        return
    with pytest.raises(FormatError) as refused:
        load_gaussians(path)
    assert refused.value.file == str(path)
    assert refused.value.field


@pytest.mark.parametrize(
    "content", [b"ply\n", b"ply\nend_header\n", b"NGSP", b"\x1f\x8b", b"PK\3\4", b"glTF", b"{", b""]
)
@pytest.mark.parametrize("size", [0, 1, 27, 40, 5000])
def test_a_bare_magic_number_is_no_map(tmp_path: Path, content: bytes, size: int) -> None:
    path = tmp_path / "map.splat"
    path.write_bytes(content + b"\xff" * size if content else b"")
    with pytest.raises(FormatError) as refused:
        load_gaussians(path)
    assert refused.value.file == str(path)
    assert refused.value.field
