"""Merges and comparisons of two states of maps, as jobs; see :mod:`splatbot.run.merging`."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

from splatbot.errors import InputError, MapNotFoundError
from splatbot.run.comparing import compare_saved
from splatbot.run.merging import later_by, load_run, locate_run, merge_figures, merged_slam
from splatbot.run.state import SavedRun
from splatbot.services.history import NoKeyframesError
from splatbot.services.jobs import JobCancelled, JobHandle, Work
from splatbot.services.problems import TooLargeError
from splatbot.services.runtime import Runtime
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import ServedMap
from splatbot.services.version_index import Version
from splatbot.slam import Slam

_LOCATING, _REFINING = 0.1, 0.7  # progress at which these begin
_MOST_OBJECTS = 500  # of a result, which stays in memory


@dataclass(frozen=True)
class StateOfMap:
    """A state of a map: one of its versions, or, without ``version``, the map as it is when the work begins."""

    served: ServedMap
    version: Version | None

    @property
    def world(self) -> str:
        """Name of its world frame."""
        return self.served.world if self.version is None else self.version.world

    @property
    def gaussians(self) -> int:
        """Number of Gaussians."""
        return len(self.served.ready.model) if self.version is None else self.version.gaussians

    @property
    def keyframes(self) -> int:
        """Number of keyframes; 0 if it is not known yet."""
        return 0 if self.version is None else self.version.keyframes

    def names(self) -> tuple[str, int | None]:
        """Return the names of map and version."""
        return self.served.id, None if self.version is None else self.version.number


def find_states(
    runtime: Runtime, served: ServedMap, number: int | None, other: str, other_number: int | None
) -> tuple[StateOfMap, StateOfMap]:
    """Find two states, and check that they can be merged or compared.

    Raises:
        MapNotFoundError: there is no map ``other``.
        VersionNotFoundError, VersionsOffError: there is no such version.
        MapNotReadyError: a map has no state.
        NoKeyframesError: a version has no keyframes.
        InputError: both are one state.
        TooLargeError: together they are larger than the service merges.
    """
    b = runtime.store.get(other)
    states = tuple(
        StateOfMap(one, None if n is None else runtime.history.versions.get(one.id, n))
        for one, n in ((served, number), (b, other_number))
    )
    if states[0].names() == states[1].names():
        raise InputError("is the same state.", field="other", hint="name another map, or a version")
    for state in states:
        if state.version is not None and not state.keyframes:
            hint = "choose a version whose `keyframes` is not 0"
            why = f"version {state.version.number} of map {state.served.id!r} has no keyframes."
            raise NoKeyframesError(why, field="version", hint=hint)
    _check_size(runtime.settings, sum(s.gaussians for s in states), sum(s.keyframes for s in states))
    return states[0], states[1]


def merge_maps(runtime: Runtime, made: ServedMap, a: StateOfMap, b: StateOfMap) -> Work:
    """Return the work of a job that merges B into the world of A, as the map ``made``; a failure removes that map."""

    def work(handle: JobHandle) -> dict[str, Any]:
        try:
            return _merge(runtime, made, a, b, handle)
        except BaseException:
            runtime.withdraw(made)
            raise

    return work


def compare_maps(runtime: Runtime, a: StateOfMap, b: StateOfMap, *, aligned: bool | None) -> Work:
    """Return the work of a job that finds the objects that differ between A and B, in the world of A.

    Args:
        aligned: whether both have one world. If None, they have if they are states of one map.
    """
    shared = a.world == b.world if aligned is None else aligned

    def work(handle: JobHandle) -> dict[str, Any]:
        run_a, run_b = _load(runtime, a, b, handle)
        begins = {"locating B in A": _LOCATING, "comparing depth": _LOCATING if shared else _REFINING}

        def on_share(step: str, share: float) -> None:
            begin = begins[step]
            end = 1.0 if step == "comparing depth" else _REFINING
            handle.report(begin + (end - begin) * share, step)

        found = compare_saved(run_a, run_b, aligned=shared, on_share=on_share).summary()
        return {**_names(a, b), **found, "objects": found["objects"][:_MOST_OBJECTS]}

    return work


def _merge(runtime: Runtime, made: ServedMap, a: StateOfMap, b: StateOfMap, handle: JobHandle) -> dict[str, Any]:
    run_a, run_b = _load(runtime, a, b, handle)

    def located(share: float) -> None:
        handle.report(_LOCATING + (_REFINING - _LOCATING) * share, "locating B in A")

    alignment = locate_run(run_a, run_b, located)
    handle.report(_REFINING, "joining")
    first, later = ([result.stamp for result in run.slam.results] for run in (run_a, run_b))
    offset = later_by(first, later)
    slam, joined = merged_slam(run_a, run_b, alignment, first_index=run_a.place.frames, time_offset=offset)
    try:
        _refine(slam, handle)
        version = _publish(runtime, made, slam)
    finally:
        slam.close()
    outcome = {"made": made.id, "made_version": version, "gaussians": len(slam.snapshot().model)}
    return {**_names(a, b), **outcome, **merge_figures(alignment, joined, offset)}


def _load(runtime: Runtime, a: StateOfMap, b: StateOfMap, handle: JobHandle) -> tuple[SavedRun, SavedRun]:
    """Load the mapper's states of A and B, and check their size before work begins on them."""
    handle.report(0.0, "reading the maps")
    with ExitStack() as stack:
        folders = [stack.enter_context(runtime.history.opened(state.served, state.version)) for state in (a, b)]
        runs = load_run(folders[0]), load_run(folders[1])
    gaussians = sum(len(run.slam.snapshot().model) for run in runs)
    _check_size(runtime.settings, gaussians, sum(len(run.slam.keyframes) for run in runs))
    handle.report(_LOCATING)
    return runs


def _refine(slam: Slam, handle: JobHandle) -> None:
    """Refine the joined map; stop early once the job is cancelled.

    Raises:
        JobCancelled: it was.
    """
    total, done = max(1, slam.iterations_left), 0

    def stop() -> bool:
        nonlocal done
        done += 1
        if not handle.cancelled.is_set():
            handle.report(_REFINING + (1.0 - _REFINING) * min(1.0, done / total), "refining")
        return handle.cancelled.is_set()

    slam.finish(stop)
    handle.check()


def _publish(runtime: Runtime, made: ServedMap, slam: Slam) -> int | None:
    """Serve the merged map and save it; return the number of its version, None if the service keeps none.

    Raises:
        JobCancelled: the map was deleted.
    """
    try:
        runtime.store.publish(made.id, slam.snapshot(), slam.trajectory, generation=made.generation)
        runtime.store.set_state(made.id, "ended", generation=made.generation)
        if not runtime.history.is_on:
            return None
        return runtime.history.save_slam(made, slam, note=f"merged from {made.source}").number
    except MapNotFoundError as error:
        raise JobCancelled from error


def _names(a: StateOfMap, b: StateOfMap) -> dict[str, Any]:
    (map_a, number_a), (map_b, number_b) = a.names(), b.names()
    return {"map": map_a, "version": number_a, "other": map_b, "other_version": number_b}


def _check_size(settings: ServiceSettings, gaussians: int, keyframes: int) -> None:
    """Check the size of two maps.

    Raises:
        TooLargeError: they are larger than the service merges.
    """
    for name, number in (("gaussians", gaussians), ("keyframes", keyframes)):
        most = getattr(settings, f"max_merge_{name}")
        if number > most:
            hint = f"choose smaller maps, or raise SPLATBOT_MAX_MERGE_{name.upper()}"
            raise TooLargeError(f"both maps have {number} {name}, at most {most} are taken.", field="other", hint=hint)
