"""The maps that are served, each at its latest immutable state."""

from __future__ import annotations

import dataclasses
import itertools
import secrets
import threading
from dataclasses import dataclass, replace
from typing import Any, Literal

from splatbot.camera import Camera
from splatbot.collision import GaussianCollisionField
from splatbot.errors import InputError, MapNotFoundError
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.protocols import Array
from splatbot.results.folder import RunFolder
from splatbot.services.bus import Bus
from splatbot.services.camera_states import CameraStates
from splatbot.services.derived import Derived
from splatbot.services.frames_first import FramesFirst
from splatbot.services.problems import MapNotReadyError
from splatbot.services.robot_mask import RobotMask
from splatbot.services.searches import Searches
from splatbot.services.topics import REMOVED, STATE, TRAJECTORY, map_topic
from splatbot.tiles import TiledMap
from splatbot.trajectory import Trajectory
from splatbot.workspace import Workspace


class TooManyMapsError(InputError):
    """As many maps are served as clients may add."""

    http_status = 409


class QuotaError(InputError):
    """A client has as many maps, or bytes of them, as it may."""

    http_status = 403


class MapExistsError(InputError):
    """A map of that name is served already."""

    http_status = 409


# "static": from a file; the others: being mapped from a log, which ended, or broke (the part mapped so far is served).
State = Literal["static", "mapping", "ended", "failed"]


@dataclass(frozen=True)
class ServedMap:
    """One map at one moment; holds still while a request works on it.

    Args:
        id: its name in URLs.
        source: its origin, for display.
        state: origin, and whether it still grows.
        detail: why it failed, or waits for its camera.
        snapshot: None before the first state is published.
        trajectory: of the camera, as far as ``snapshot`` knows it; None where there was none.
        workspace: pose of the robot's base in it, if known.
        awaited: the service counts as ready only once this map has a state.
        run: folder of the run that made it; None if there is no such run.
        mask: of the robot in its frames, while it is mapped; None if no robot is masked.
        generation: number of the map in this process; a later map of the same name has another.
        derived: results computed from the snapshot.
        cameras: further cameras, while it is mapped.
        world: name of its world frame; a later map of the same name has another, a map that a restart loads the same.
        owner: client that made it, whose quota it counts in; empty if the service made it.
        tiles: a map on disk, which has no snapshot. If None, the map is in memory.
    """

    id: str
    source: str
    state: State
    detail: str | None = None
    snapshot: Snapshot | None = None
    trajectory: Trajectory | None = None
    workspace: Workspace | None = None
    awaited: bool = True
    run: RunFolder | None = None
    mask: RobotMask | None = dataclasses.field(default=None, repr=False, compare=False)
    generation: int = 0
    derived: Derived = dataclasses.field(default_factory=Derived, repr=False, compare=False)
    cameras: CameraStates = dataclasses.field(default_factory=CameraStates, repr=False, compare=False)
    world: str = dataclasses.field(default_factory=lambda: secrets.token_hex(8))
    owner: str = ""
    tiles: TiledMap | None = dataclasses.field(default=None, repr=False, compare=False)

    @property
    def map_version(self) -> int:
        """The state's number, 0 before the first; 1 of a tiled map."""
        if self.tiles is not None:
            return 1
        return self.snapshot.map_version if self.snapshot else 0

    @property
    def gaussians(self) -> int:
        """Number of Gaussians, 0 before the first state."""
        if self.tiles is not None:
            return len(self.tiles)
        return len(self.snapshot.model) if self.snapshot else 0

    @property
    def nbytes(self) -> int:
        """Memory of the Gaussians [bytes]."""
        if self.tiles is not None:
            return self.tiles.nbytes
        return self.snapshot.model.nbytes if self.snapshot else 0

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 before the first state."""
        if self.tiles is not None:
            return self.tiles.index.sh_degree
        return self.snapshot.model.sh_degree if self.snapshot else 0

    @property
    def ready(self) -> Snapshot:
        """The snapshot.

        Raises:
            InputError: the map is tiled.
            MapNotReadyError: nothing is published yet.
        """
        if self.tiles is not None:
            hint = "request its views, distances or collisions; or serve the map that it was made of"
            raise InputError("is tiled, and this needs the whole map.", field=f"map {self.id!r}", hint=hint)
        if self.snapshot is None:
            because = f" because mapping failed: {self.detail}" if self.state == "failed" else " yet"
            raise MapNotReadyError(f"Map {self.id!r} has no state{because}.", hint="see GET /v1/maps for its progress")
        return self.snapshot

    @property
    def field(self) -> GaussianCollisionField:
        """The collision field of this state, built by the first question.

        Raises:
            InputError: the map is tiled.
            MapNotReadyError: nothing is published yet.
        """
        return self.derived.get("field", lambda: GaussianCollisionField(self.ready))

    def overview(self) -> GaussianModel:
        """Return the Gaussians, or the coarsest ones of a tiled map.

        Raises:
            MapNotReadyError: nothing is published yet.
        """
        return self.ready.model if self.tiles is None else self.tiles.overview()

    def in_view(self, camera: Camera, T_world_camera: Array) -> tuple[GaussianModel, float]:
        """Return the Gaussians that draw a view, and its pixel error [px]: 0 unless some of them are merged.

        Raises:
            MapNotReadyError: nothing is published yet.
        """
        if self.tiles is None:
            return self.ready.model, 0.0
        view = self.tiles.in_view(camera, T_world_camera)
        return view.model, view.pixel_error


class MapStore:
    """Maps by id. Writers swap whole versions, and readers keep theirs, so no reader waits for a computation.

    Args:
        bus: receives each new version. If None, a bus is created.
        most: maps that clients may add. If None, any number.
        most_of_owner: maps of one owner. If None, any number.
    """

    def __init__(self, bus: Bus | None = None, *, most: int | None = None, most_of_owner: int | None = None) -> None:
        self.bus = bus or Bus()
        self._most, self._most_of_owner = most, most_of_owner
        self.frames_first = FramesFirst()
        self.searches = Searches()
        self._lock = threading.Lock()
        self._maps: dict[str, ServedMap] = {}
        self._generations = itertools.count(1)

    def add(
        self,
        map_id: str,
        *,
        source: str,
        state: State,
        snapshot: Snapshot | None = None,
        trajectory: Trajectory | None = None,
        workspace: Workspace | None = None,
        awaited: bool = True,
        run: RunFolder | None = None,
        mask: RobotMask | None = None,
        counted: bool = True,
        world: str | None = None,
        owner: str = "",
        tiles: TiledMap | None = None,
    ) -> ServedMap:
        """Serve a map under a new name. Saved maps that return at a start are not ``counted``: all of them return.

        Raises:
            MapExistsError: the name is taken.
            TooManyMapsError: there are as many maps as clients may add.
            QuotaError: the owner has as many maps as it may.
        """
        with self._lock:
            if map_id in self._maps:
                raise MapExistsError(f"map {map_id!r} exists.", field="id", hint="delete it, or choose another id")
            if counted and self._most is not None and len(self._maps) >= self._most:
                hint = "delete a map, or raise SPLATBOT_MAX_MAPS"
                raise TooManyMapsError(f"{len(self._maps)} maps are served already.", field="id", hint=hint)
            own = sum(served.owner == owner for served in self._maps.values())
            if counted and owner and self._most_of_owner is not None and own >= self._most_of_owner:
                hint = "delete one of them, or raise SPLATBOT_MAX_CLIENT_MAPS"
                raise QuotaError(f"this client has {own} maps already.", field="id", hint=hint)
            served = ServedMap(
                map_id,
                source,
                state,
                snapshot=snapshot,
                trajectory=trajectory,
                workspace=workspace,
                awaited=awaited,
                run=run,
                mask=mask,
                generation=next(self._generations),
                world=world or secrets.token_hex(8),
                owner=owner,
                tiles=tiles,
            )
            self._put(served)
        return served

    def publish(
        self,
        map_id: str,
        snapshot: Snapshot,
        trajectory: Trajectory | None = None,
        *,
        generation: int | None = None,
    ) -> None:
        """Let ``snapshot`` be the map's latest state; one that is not newer is ignored, so versions only grow.

        ``generation`` is that of the map which the writer was started for.

        Raises:
            MapNotFoundError: no map of that name, or it is of another generation.
        """
        with self._lock:
            current = self._find(map_id, generation)
            if current.snapshot is not None and snapshot.map_version <= current.map_version:
                return
            later = trajectory if trajectory is not None else current.trajectory
            self._put(replace(current, snapshot=snapshot, trajectory=later, derived=Derived()))
            if trajectory is not None:
                self.bus.publish(map_topic(map_id, TRAJECTORY), trajectory)

    def set_state(self, map_id: str, state: State, detail: str | None = None, *, generation: int | None = None) -> None:
        """Set the state of the map's creation.

        Raises:
            MapNotFoundError: no map of that name, or it is of another generation.
        """
        with self._lock:
            self._put(replace(self._find(map_id, generation), state=state, detail=detail))

    def tell(self, served: ServedMap, kind: str, value: Any) -> None:
        """Publish a result about a map on the bus.

        Raises:
            MapNotFoundError: the map was deleted.
        """
        with self._lock:
            self._find(served.id, served.generation)
            self.bus.publish(map_topic(served.id, kind), value)

    def remove(self, map_id: str, *, generation: int | None = None) -> None:
        """Remove a map; readers keep the version that they hold.

        Raises:
            MapNotFoundError: no map of that name, or it is of another generation.
        """
        with self._lock:
            removed = self._find(map_id, generation)
            del self._maps[map_id]
            closing = replace(removed, tiles=None)  # readers alone keep the file open
            self.bus.publish(map_topic(map_id, REMOVED), closing)
            self.bus.forget(map_topic(map_id, ""))

    def get(self, map_id: str, *, generation: int | None = None) -> ServedMap:
        """Return the latest version of a map.

        Raises:
            MapNotFoundError: no map of that name, or it is of another generation.
        """
        with self._lock:
            return self._find(map_id, generation)

    def find(self, map_id: str) -> ServedMap | None:
        """Return the latest version of a map; None if there is no map of that name."""
        with self._lock:
            return self._maps.get(map_id)

    def list(self) -> tuple[ServedMap, ...]:
        """List the latest versions of all maps in the order of their creation."""
        with self._lock:
            return tuple(self._maps.values())

    def _put(self, served: ServedMap) -> None:
        self._maps[served.id] = served
        self.bus.publish(map_topic(served.id, STATE), served)

    def _find(self, map_id: str, generation: int | None = None) -> ServedMap:
        if map_id not in self._maps:
            names = ", ".join(self._maps) or "none"
            raise MapNotFoundError(f"No map {map_id!r}.", hint=f"the maps are: {names}")
        found = self._maps[map_id]
        if generation is not None and found.generation != generation:
            raise MapNotFoundError(f"Map {map_id!r} was deleted.", hint="the map of that name is another one")
        return found
