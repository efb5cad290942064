"""Bit flips, zeroed blocks and truncations in every stored file of a data folder and of a run, and in recordings.

Run `python -m tests.attacks.bit_flips --count 2000`. Each damage must be detected and reported with the file's name.
"""

from __future__ import annotations

import logging
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from splatbot.checksums import NAME as SUMS
from splatbot.cli import main as splatbot
from splatbot.errors import SplatbotError
from splatbot.logs import open_log
from splatbot.logs.mcap import record_mcap
from splatbot.results.folder import RunFolder
from splatbot.run.state import SavedRun
from splatbot.services.library import MapLibrary
from splatbot.services.store import MapStore
from splatbot.trajectory import Trajectory
from splatbot.workspace import Workspace
from tests.attacks.command_line import exit_code, seeded_parser
from tests.attacks.crash_points import LOG
from tests.contracts.conftest import wall


@dataclass
class Tally:
    """Counts of a run.

    Args:
        detected: damages that were reported, by file.
        missed: damages that were not.
    """

    detected: Counter[str] = field(default_factory=Counter)
    missed: list[str] = field(default_factory=list)


class _Warnings(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.text = ""

    def emit(self, record: logging.LogRecord) -> None:
        self.text += record.getMessage() + "\n"


def make_data(folder: Path) -> None:
    """Save two states of a map."""
    store, library = MapStore(), MapLibrary(folder)
    store.add("desk", source="log", state="mapping", workspace=Workspace(np.eye(4)))
    for version in (1, 2):
        poses = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
        store.publish("desk", wall(version, z=float(version)), poses)
        library.save(store.get("desk"))


def make_run(folder: Path) -> None:
    """Map a short log with saved states."""
    small = ["mapping.refine_iterations=1", "expert.tracking.n_features=200", "mapping.final_iterations=1"]
    words = [word for setting in small for word in ("--set", setting)]
    splatbot(["map", LOG, "--out", str(folder), "--quiet", "--save-every", "0.01", *words])


def damage(path: Path, rng: np.random.Generator) -> str:
    """Write damage into a file, and return its kind."""
    data = bytearray(path.read_bytes())
    before = bytes(data)
    kind = str(rng.choice(["flip", "zeros", "cut"]))
    while bytes(data) == before:
        at = int(rng.integers(0, len(data)))
        if kind == "flip":
            data[at] ^= 1 << int(rng.integers(0, 8))
        elif kind == "zeros":
            size = int(rng.choice([16, 512, 4096]))
            data[at : at + size] = bytes(len(data[at : at + size]))
        else:
            del data[at:]
    path.write_bytes(data)
    return f"{kind} at {at}"


def _data_reports(folder: Path, name: str) -> bool:
    """Return whether the damage is logged and whole states only are served."""
    warnings, store = _Warnings(), MapStore()
    logging.getLogger("splatbot").addHandler(warnings)
    try:
        MapLibrary(folder).load_all(store)
    finally:
        logging.getLogger("splatbot").removeHandler(warnings)
    served = store.get("desk")
    right = np.array_equal(served.ready.model.means, wall(z=float(served.map_version)).model.means)
    return name in warnings.text and right and served.map_version == (2 if name == "current" else 1)


def _run_reports(folder: Path, path: Path) -> bool:
    """Return whether opening the run is an error of the damaged file, or of any file if the checksums are damaged."""
    try:
        RunFolder(folder).check()
        SavedRun.load(folder)
    except SplatbotError as error:
        return error.file is not None and path.name in (Path(error.file).name, SUMS)
    return False


def _recording_reports(path: Path) -> bool:
    """Return whether reading the recording is an error that names its file."""
    try:
        log = open_log(str(path))
        for number in range(len(log)):
            _ = log[number]
    except SplatbotError as error:
        return error.file is not None and Path(error.file).name == path.name
    return False


def run(count: int, seed: int = 0) -> Tally:
    """Write damage into random files ``count`` times."""
    rng, tally = np.random.default_rng(seed), Tally()
    logging.getLogger("splatbot").propagate = False
    with tempfile.TemporaryDirectory(prefix="splatbot-flips-") as made:
        home, copy = Path(made), Path(made) / "copy"
        make_data(home / "data")
        make_run(home / "run")
        record_mcap(open_log(LOG), home / "recordings" / "log.mcap")
        states = [home / "data" / "desk" / "v2" / p.name for p in (home / "data" / "desk" / "v2").iterdir()]
        data = [*states, home / "data" / "desk" / "current"]
        kept = [path for path in (home / "run").rglob("*") if path.is_file()]
        recordings = [home / "recordings" / "log.mcap"]
        kinds: list[tuple[str, list[Path], Callable[[Path], bool]]] = [
            ("data", data, lambda path: _data_reports(copy, path.name)),
            ("run", kept, lambda path: _run_reports(copy, path)),
            ("recordings", recordings, _recording_reports),
        ]
        for number in range(count):
            source, files, reports = kinds[number % len(kinds)]
            path = copy / files[number // len(kinds) % len(files)].relative_to(home / source)
            shutil.copytree(home / source, copy)
            how = damage(path, rng)
            found = reports(path)
            shutil.rmtree(copy)
            if found:
                tally.detected[path.name] += 1
            else:
                tally.missed.append(f"{path.relative_to(copy)}: {how}")
    logging.getLogger("splatbot").propagate = True
    return tally


def main() -> int:
    """Run and print the counts."""
    given = seeded_parser(__doc__, 2000).parse_args()
    tally = run(given.count, given.seed)
    print(f"detected and reported: {sum(tally.detected.values())} of {given.count}; {dict(tally.detected)}")
    return exit_code(tally.missed)


if __name__ == "__main__":
    sys.exit(main())
