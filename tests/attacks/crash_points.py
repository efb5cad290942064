"""Processes killed between any two writes, flushes and renames; a model checks the state after each recovery.

Run `python -m tests.attacks.crash_points --count 500`. A third of the cases is of `serve` (maps saved, deleted and made
again), a third of recordings, a third of mapping. In half of them the file that is not flushed yet is cut off, too.
"""

from __future__ import annotations

import itertools
import os
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from rosbags.highlevel import AnyReader

from splatbot import failpoints
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.logs.mcap import McapFile
from splatbot.logs.ros_types import build
from splatbot.services.library import MapLibrary
from splatbot.services.store import MapStore
from splatbot.trajectory import Trajectory
from splatbot.workspace import Workspace
from tests.attacks.command_line import exit_code, seeded_parser
from tests.models import uniform_model

State = tuple[str, int] | None
STATES: list[State] = [None, ("a", 1), ("a", 2), ("a", 5), None, ("b", 1), ("b", 2), ("b", 9)]
MESSAGES, _BYTES = 900, 2500
LOG = "synthetic:tabletop?width=80&height=60&frames=12"


@dataclass
class Tally:
    """Counts of a run.

    Args:
        killed, ended: cases in which the process was killed, or ended first, by kind.
        wrong: recovered states that are neither the old nor the new one.
        slowest_s: longest recovery [s].
    """

    killed: Counter[str] = field(default_factory=Counter)
    ended: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    slowest_s: float = 0.0


def _child(work: Callable[[int], None], choice: str = "") -> tuple[bool, bytes]:
    """Run ``work`` in a fork with a failpoint; return whether it was killed, and the bytes that it acknowledged."""
    reader, writer = os.pipe()
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            os.close(reader)
            failpoints.arm(choice)
            work(writer)
            code = 0
        finally:
            os._exit(code)
    os.close(writer)
    _, status = os.waitpid(pid, 0)
    with os.fdopen(reader, "rb") as file:
        told = file.read()
    killed = os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL
    if not killed and status != 0:
        raise RuntimeError(f"the child failed with status {status}")
    return killed, told


def _snapshot(state: tuple[str, int]) -> Snapshot:
    n = 50 + 10 * state[1] + ord(state[0])
    means = np.random.default_rng([ord(state[0]), state[1]]).normal(size=(n, 3))
    return Snapshot(uniform_model(means), state[1])


def _serve(folder: Path, ack: int) -> None:
    store, library = MapStore(), MapLibrary(folder)
    library.lock()
    library.load_all(store)
    for before, state in itertools.pairwise(STATES):
        if state is None:
            library.remove("desk")
            store.remove("desk")
        else:
            if before is None:
                store.add("desk", source=state[0], state="mapping", workspace=Workspace(np.eye(4)))
            poses = Trajectory(np.arange(float(state[1])), np.tile(np.eye(4), (state[1], 1, 1)))
            store.publish("desk", _snapshot(state), poses)
            library.save(store.get("desk"))
        os.write(ack, b".")


def _serve_case(folder: Path, choice: str) -> tuple[bool, str, float]:
    killed, told = _child(lambda ack: _serve(folder, ack), choice)
    start = time.monotonic()
    store = MapStore()
    library = MapLibrary(folder)
    library.lock()
    library.load_all(store)
    seconds = time.monotonic() - start
    library.unlock()
    allowed = STATES[len(told) : len(told) + 2]
    if not store.list():
        return killed, "" if None in allowed else f"nothing, not one of {allowed}", seconds
    served = store.get("desk")
    state = served.source, served.map_version
    whole = (
        served.workspace is not None
        and served.trajectory is not None
        and len(served.trajectory) == state[1]
        and np.array_equal(served.ready.model.means, _snapshot(state).model.means)
    )
    drafts = [path.name for path in folder.rglob("*.tmp")]
    wrong = "" if state in allowed and whole and not drafts else f"{state}, whole: {whole}, {drafts}; {allowed}"
    return killed, wrong, seconds


def _record(path: Path, count: int, last: int) -> None:
    rng = np.random.default_rng(0)
    with McapFile(path) as out:
        for k in range(count):
            text = f"{k} {rng.bytes(_BYTES).hex()}"
            out.write(f"/t{k % 3}", build("std_msgs/msg/String", data=text), k)
            if k == last:
                os.kill(os.getpid(), signal.SIGKILL)


def _texts(path: Path) -> list[int]:
    with AnyReader([path]) as reader:
        return [
            int(reader.deserialize(raw, connection.msgtype).data.split()[0])  # type: ignore[attr-defined]
            for connection, _, raw in reader.messages()
        ]


def _record_case(folder: Path, choice: str, rng: np.random.Generator) -> tuple[bool, str, float]:
    path = folder / "a.mcap"
    last = int(rng.integers(1, MESSAGES + 1))  # MESSAGES: it ends, and a failpoint may kill it at the end
    killed, _ = _child(lambda _: _record(path, MESSAGES, last), "" if last < MESSAGES else choice)
    if killed and last < MESSAGES:
        _child(lambda _: McapFile(folder / "a.mcap").close(), choice)  # the recovery is killed, too
    start = time.monotonic()
    McapFile(folder / "b.mcap").close()
    if (folder / ".a.mcap.partial").exists():
        (folder / "a.mcap").unlink(missing_ok=True)
        McapFile(folder / "a.mcap").close()
    seconds = time.monotonic() - start
    found: list[int] = []
    for made in sorted(folder.glob("a*.mcap")):
        texts = _texts(made)
        found = max(found, texts, key=len)
    least = last - 2**20 // (2 * _BYTES) - 2 if last < MESSAGES else MESSAGES
    if choice.endswith("torn"):
        least = 0
    wrong = "" if found == list(range(len(found))) and len(found) >= least else f"{len(found)} of {last} messages"
    return killed, wrong, seconds


def _map(folder: Path) -> None:
    from splatbot.cli import main

    small = ["mapping.refine_iterations=1", "expert.tracking.n_features=200", "mapping.final_iterations=1"]
    words = [word for setting in small for word in ("--set", setting)]
    sys.stdout = sys.stderr = Path(os.devnull).open("w")  # noqa: SIM115 (until the process ends)
    main(["map", LOG, "--out", str(folder / "run"), "--quiet", "--save-every", "0.01", *words])


def _load_run(folder: Path) -> None:
    from splatbot.results.folder import RunFolder
    from splatbot.run.state import SavedRun

    run = RunFolder(folder / "run")
    if (run.path / "state" / "run.state").exists():
        saved = SavedRun.load(run.path)
        if len(saved.slam.results) != saved.place.next_index:
            raise RuntimeError("the state is a mixture")
    if run.metrics.is_file():
        run.load_metrics()
        run.load_poses()
        GaussianModel.load(run.map)


def _map_case(folder: Path, choice: str) -> tuple[bool, str, float]:
    killed, _ = _child(lambda _: _map(folder), choice)
    start = time.monotonic()
    try:
        _child(lambda _: _load_run(folder))
    except RuntimeError as error:
        return killed, str(error), time.monotonic() - start
    return killed, "", time.monotonic() - start


def run(count: int, seed: int = 0, kinds: tuple[str, ...] = ("serve", "record", "map")) -> Tally:
    """Stop ``count`` processes by SIGKILL at random points and check the recovered states."""
    torch.set_num_threads(1)  # a fork of a process with OpenMP threads waits for them forever
    rng, tally = np.random.default_rng(seed), Tally()
    for number in range(count):
        kind = kinds[number % len(kinds)]
        most = {"serve": 220, "record": 8, "map": 60}[kind]
        choice = f"any:{rng.integers(1, most)}" + (":torn" if rng.random() < 0.5 else "")
        folder = Path(tempfile.mkdtemp(prefix="splatbot-crash-"))
        try:
            if kind == "serve":
                killed, wrong, seconds = _serve_case(folder, choice)
            elif kind == "record":
                killed, wrong, seconds = _record_case(folder, choice, rng)
            else:
                killed, wrong, seconds = _map_case(folder, choice)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
        (tally.killed if killed else tally.ended)[kind] += 1
        tally.slowest_s = max(tally.slowest_s, seconds)
        if wrong:
            tally.wrong.append(f"case {number} ({kind}, {choice}): {wrong}")
        if number % 50 == 49:
            print(f"{number + 1} of {count}, {len(tally.wrong)} wrong", flush=True)
    return tally


def main() -> int:
    """Run and print the counts."""
    parser = seeded_parser(__doc__, 500)
    parser.add_argument("--kinds", default="serve,record,map")
    given = parser.parse_args()
    tally = run(given.count, given.seed, tuple(given.kinds.split(",")))
    print(f"killed {dict(tally.killed)}, ended before {dict(tally.ended)}")
    print(f"neither old nor new state: {len(tally.wrong)}; slowest recovery {tally.slowest_s:.2f} s")
    return exit_code(tally.wrong)


if __name__ == "__main__":
    sys.exit(main())
