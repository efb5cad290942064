"""Everything that a running service holds, and how it begins and ends."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from typing import Any

from splatbot.config import Config
from splatbot.errors import ConfigError, InputError, MapNotFoundError, SplatbotError
from splatbot.frame import Frame
from splatbot.logs import Log
from splatbot.protocols import Array, FrameSource
from splatbot.rasterize.native import native
from splatbot.robots.robot import RobotModel
from splatbot.services.arms import Arms, known_robot
from splatbot.services.history import MapHistory
from splatbot.services.jobs import Job, Jobs, Work
from splatbot.services.library import MapLibrary
from splatbot.services.live import LiveMapper, LiveMapping
from splatbot.services.metrics import Metrics
from splatbot.services.plans import Plans
from splatbot.services.pushed import PushedFrames, StreamEndedError
from splatbot.services.quotas import Quotas
from splatbot.services.robot_mask import MaskedSource, RobotMask
from splatbot.services.ros.robot_topics import RobotTopics
from splatbot.services.scratch import sweep_scratch
from splatbot.services.settings import ServiceSettings
from splatbot.services.steady_camera import SteadyCamera
from splatbot.services.store import MapExistsError, MapStore, ServedMap
from splatbot.services.threads import join_started
from splatbot.services.topics import JOINTS, ROS_ROBOT, JointState, robot_topic
from splatbot.services.versions import FOLDER as VERSIONS
from splatbot.services.versions import Versions
from splatbot.slam import FrameResult
from splatbot.workspace import Workspace

ROS_MAP = "ros"
"""Map of the frames of ROS topics."""
_WAITING_NEWS = 2000  # messages of TF: 2 s of a robot at 1 kHz

_log = logging.getLogger(__name__)


class Runtime:
    """The parts of one service, put together.

    Args:
        settings: address, keys and limits.
        store: the maps; None makes one.
        config: of the mapping that clients ask for.

    Raises:
        InputError: the robot of the settings is unknown.
        FormatError: the scene of the settings, or the index of versions, is damaged.

    Attributes:
        store: maps and their bus.
        jobs: work that outlasts a request.
        arms: that follow plans.
        plans: the latest ones.
        metrics: for Prometheus.
        library: maps on disk. If None, maps live in memory only.
        quotas: of clients.
        history: versions of maps.
        draining: the service is about to end.
        robot, workspace: the settings' robot and its scene, for frames of ROS topics.
    """

    def __init__(
        self, settings: ServiceSettings, store: MapStore | None = None, *, config: Config | None = None
    ) -> None:
        self.settings = settings
        self.store = store or MapStore(most=settings.max_maps, most_of_owner=settings.max_client_maps)
        self.bus = self.store.bus
        self.config = config or Config()
        self.robot = None if settings.robot is None else known_robot(settings.robot)
        self.workspace = None if settings.scene is None else Workspace.load(settings.scene)
        self._robot_topics = RobotTopics()
        self._mask_of_topics = self._new_mask_of_topics()
        self.library = MapLibrary(settings.data_dir) if settings.data_dir is not None else None
        if self.library is not None:
            self.library.lock()
        self.jobs = Jobs(
            self.bus,
            workers=settings.job_workers,
            capacity=settings.max_jobs,
            client_capacity=settings.max_client_jobs,
        )
        self.arms = Arms(self.store)
        self.plans = Plans()
        self.metrics = Metrics(self.store, self.jobs, self.library)
        self.draining = False
        self._deadline = math.inf
        # Writers by the generation of their map.
        self._streams: dict[int, PushedFrames] = {}
        self._mappings: dict[int, LiveMapping] = {}
        self._jobs_of: dict[int, str] = {}
        self._waiting: list[LiveMapping] = []
        self._started = False
        self._lock = threading.Lock()
        self._disk = threading.Lock()  # a map is either saved or deleted
        versions = self._open_versions()
        self.quotas = Quotas(settings, self.store, self.jobs, versions)
        self.history = MapHistory(self.store, self.library, versions, self.quotas, self._disk, self._mappings.get)
        self._robot_news = self.bus.subscribe(ROS_ROBOT, capacity=_WAITING_NEWS, latched=False)
        self._robot_listener = threading.Thread(target=self._take_robot_news, name="robot", daemon=True)
        self._ended = threading.Event()
        self._keeper = threading.Thread(target=self._keep, name="keeper", daemon=True)
        # A thread has the priority of the one that starts it, and those that answer have a lower one.
        self._starter = ThreadPoolExecutor(1, "starter")
        self._starter.submit(native().num_threads).result()  # the kernels' threads, too

    def start(self) -> None:
        """Serve the saved maps, start saving, and start to map the sources that are followed."""
        sweep_scratch()
        self._robot_listener.start()
        if self.library is not None:
            self.library.load_all(self.store)
            self._keeper.start()
        with self._lock:
            self._started, waiting = True, list(self._waiting)
            self._waiting.clear()
        for mapping in waiting:
            self._begin(mapping)

    def follow(self, served: ServedMap, source: Iterable[Frame], mapper: LiveMapper) -> None:
        """Map frames in a thread of their own, once the service has begun; the robot in them is masked by the map."""
        if isinstance(source, FrameSource):
            source = SteadyCamera(
                source, self.settings.camera_wait_s, lambda problem: self._report_camera(served, problem)
            )
        frames = source if served.mask is None else MaskedSource(source, served.mask)
        mapping = self.mapping(served, frames, mapper)
        with self._lock:
            if not self._started:
                self._waiting.append(mapping)  # a recording of the service holds its first frame too
                return
        self._begin(mapping)

    def mapping(
        self,
        served: ServedMap,
        source: Iterable[Frame],
        mapper: LiveMapper,
        *,
        on_result: Callable[[FrameResult], None] | None = None,
        on_error: Callable[[int, SplatbotError], None] | None = None,
        on_end: Callable[[], None] = lambda: None,
    ) -> LiveMapping:
        """Return the mapping of frames into a map, which the service knows until it ends.

        Args:
            served, source, mapper, on_result, on_error, on_end: as for :class:`LiveMapping`.
        """

        def ended() -> None:
            with self._lock:
                self._mappings.pop(served.generation, None)
            on_end()

        mapping = LiveMapping(
            self.store,
            served,
            source,
            mapper,
            on_result=on_result,
            on_error=on_error,
            on_mapped=partial(self.history.save_end, served),
            on_end=ended,
        )
        with self._lock:
            self._mappings[served.generation] = mapping
        return mapping

    def _open_versions(self) -> Versions | None:
        """Open the saved versions in the locked data folder, if there is one."""
        if self.library is None:
            return None
        return Versions(
            self.library.folder / VERSIONS,
            most=self.settings.max_versions,
            most_bytes=self.settings.max_versions_bytes,
            served=self.store.find,
        )

    def _report_camera(self, served: ServedMap, problem: str | None) -> None:
        with suppress(MapNotFoundError):  # deleted meanwhile
            self.store.set_state(served.id, "mapping", problem, generation=served.generation)

    def open_stream(
        self,
        map_id: str,
        *,
        workspace: Workspace | None = None,
        mask: RobotMask | None = None,
        config: Config | None = None,
        owner: str = "",
    ) -> ServedMap:
        """Create a map that receives its frames through :meth:`stream`; ``mask`` masks the robot in them.

        Args:
            config: of its mapping, with its further cameras. If None, that of the service.
            owner: client whose quota it counts in; empty if the service makes it.

        Raises:
            MapExistsError: the name is taken.
            TooManyMapsError, QuotaError: there are as many maps, of all clients or of this one, as may be.
        """
        from splatbot.slam import Slam

        config = config or self.config
        served = self.store.add(
            map_id,
            source="pushed frames",
            state="mapping",
            workspace=workspace,
            mask=mask,
            awaited=False,
            owner=owner,
        )
        frames = PushedFrames(self.settings.max_waiting_frames, mask, config.cameras)
        mapping = self.mapping(
            served,
            frames,
            Slam(config),
            on_result=frames.answer,
            on_error=frames.refuse,
            on_end=lambda: frames.abandon("mapping has ended"),
        )
        with self._lock:
            self._streams[served.generation] = frames
        self._begin(mapping)
        return served

    def stream(self, map_id: str) -> PushedFrames:
        """Return the frame queue of a map.

        Raises:
            MapNotFoundError: no map of that name.
            StreamEndedError: it is not made of pushed frames.
        """
        generation = self.store.get(map_id).generation
        with self._lock:
            frames = self._streams.get(generation)
        if frames is None:
            hint = 'create a map for frames: POST /v1/maps {"id": ...}'
            raise StreamEndedError(f"map {map_id!r} is not made of pushed frames.", hint=hint)
        return frames

    def take(self, frame: Frame, map_id: str = ROS_MAP) -> None:
        """Map a frame that was published, not pushed into a map: the first one makes the map.

        Raises:
            BusyError: as many frames wait as may; this one is dropped.
            InputError: the frame does not fit those before, or the map is made of something else.
        """
        with suppress(MapExistsError):
            self.open_stream(map_id, workspace=self.workspace, mask=self._mask_of_topics)
            self._mask_of_topics = self._new_mask_of_topics()  # of the next map of that name
        if self.robot is not None and self.store.get(map_id).mask is None:
            hint = f"delete it: the robot in frames of ROS topics is masked in a map {map_id!r} of its own"
            raise InputError(f"map {map_id!r} masks no robot.", field="map", hint=hint)
        self.stream(map_id).push(frame)

    def new_mask(
        self,
        workspace: Workspace | None,
        further: Mapping[str, Workspace] | None = None,
        *,
        log: Log | None = None,
    ) -> RobotMask | None:
        """Return a mask of the settings' robot for the camera of a workspace; None without such a robot.

        Args:
            workspace: of the first camera.
            further: of further cameras by name.
            log: the recording whose frames are masked, if they are not live.

        Raises:
            InputError: the pose of a camera is unknown, or a workspace does not fit the robot.
        """
        if self.robot is None:
            return None
        return RobotMask(self.robot, workspace, self._robot_topics, further=further, log=log)

    def mask_of_stream(
        self,
        map_id: str,
        robot: RobotModel,
        workspace: Workspace | None,
        further: Mapping[str, Workspace] | None = None,
    ) -> RobotMask:
        """Return a mask of a robot for the map of a stream; for frames of ROS topics, TF may have the camera's pose.

        Args:
            map_id: name of the map.
            robot: the robot.
            workspace: pose of the camera on its link, and names, offsets and delay of the joints.
            further: workspaces of further cameras by name.

        Raises:
            InputError: the pose of a camera is unknown, or a workspace does not fit the robot.
        """
        topics, in_tf = self._robot_topics, map_id == ROS_MAP
        return RobotMask(robot, workspace, topics, camera_in_tf=in_tf, further=further)

    def _new_mask_of_topics(self) -> RobotMask | None:
        return None if self.robot is None else self.mask_of_stream(ROS_MAP, self.robot, self.workspace)

    def report_joints(self, robot: str, state: JointState) -> int:
        """Publish a robot's joints, and keep them for the frames of each map in which it is masked.

        Returns:
            The number of masks that keep them: those of maps, and that of the next map of ROS topics.

        Raises:
            InputError: no mask can keep them, because joints are missing or a value is not finite.
        """
        self.bus.publish(robot_topic(robot, JOINTS), state)
        masks = [self._mask_of_topics, *(served.mask for served in self.store.list() if served.state == "mapping")]
        kept, problem = 0, None
        for mask in masks:
            if mask is None or mask.robot.name != robot:
                continue
            try:
                kept += mask.history.add(state)
            except InputError as error:  # the other masks keep them all the same
                problem = error
        if problem is not None and not kept:
            raise problem
        return kept

    def find_transform(self, target: str, source: str) -> Array | None:
        """Return T_target_source (4, 4) [m] by clients' static TF; None if that does not connect the frames."""
        return self._robot_topics.transforms.fixed(target, source)

    def _take_robot_news(self) -> None:
        for news in self._robot_news:
            topic, message = news.value
            try:
                self._robot_topics.take(topic, message)
            except SplatbotError as error:
                _log.warning("%s from a client: %s", topic, error)
            except Exception:  # one odd message must not end the others
                _log.exception("%s from a client could not be used", topic)

    def make(self, served: ServedMap, work: Work, *, kind: str = "map", **more: Any) -> Job:
        """Queue the job that makes a map; deleting the map cancels it.

        Args:
            kind: of the job.
            more: arguments of :meth:`splatbot.services.jobs.Jobs.submit`.

        Raises:
            BusyError, TooManyJobsError: as many jobs wait, or as many of the client, as may.
            IdempotencyError: the key belongs to another request.
        """
        job, _ = self.jobs.submit(kind, work, client=served.owner, **more)
        with self._lock:
            self._jobs_of[served.generation] = job.id
        return job

    def remove(self, served: ServedMap) -> None:
        """Remove a map and its saved versions, and end its mapping; wait for that up to ``shutdown_s``.

        Raises:
            MapNotFoundError: the map was deleted.
            SaveError: the saved versions cannot be deleted; the map is still served.
        """
        with self._disk:
            self.store.get(served.id, generation=served.generation)
            if self.library is not None:
                self.history.versions.remove_map(served.id)
                self.library.remove(served.id)
            self.store.remove(served.id, generation=served.generation)
        with self._lock:
            job_id = self._jobs_of.pop(served.generation, None)
        timeout = float(self.settings.shutdown_s)
        if job_id is not None:
            self.jobs.end(job_id, timeout)
        self._end(served.generation, "the map was deleted", timeout)

    def withdraw(self, served: ServedMap) -> None:
        """Remove a map whose making failed or never began; its job, which may call this, is not awaited."""
        with self._lock:
            self._jobs_of.pop(served.generation, None)
        with suppress(MapNotFoundError):  # deleted meanwhile
            self.remove(served)

    def save(self, served: ServedMap) -> None:
        """Keep the map's present state on disk if there is a folder for it and the map is not deleted.

        Raises:
            SaveError: it cannot be written.
        """
        if self.library is None:
            return
        with self._disk, suppress(MapNotFoundError):
            self.store.get(served.id, generation=served.generation)
            self.library.save(served)

    def drain(self) -> None:
        """Begin to end: take no more work, cancel jobs, close event streams; answers under way are still given.

        Searches for motions end with their best paths so far.
        """
        self.draining = True
        self.store.searches.stop()
        self._deadline = min(self._deadline, time.monotonic() + self.settings.shutdown_s)
        self.jobs.stop()
        self.arms.motions.stop()
        self.bus.close()

    def close(self) -> None:
        """End jobs, motions and mappings, and save every map."""
        self.drain()
        self.arms.close(self._time_left())
        self.jobs.close(self._time_left())
        for generation in list(self._mappings):
            self._end(generation, "the service stops", self._time_left())
        if not self._ended.is_set():
            self._ended.set()
            self._save_all()
            if self.library is not None:
                self.library.unlock()
        join_started([self._robot_listener], self._time_left())
        self.metrics.close()

    def _time_left(self) -> float:
        """Return the time [s] that one part may take to end: the rest of ``shutdown_s``, at least 0.5 s."""
        return max(0.5, self._deadline - time.monotonic())

    def _begin(self, mapping: LiveMapping) -> None:
        self._starter.submit(mapping.start).result()

    def _end(self, generation: int, why: str, timeout_s: float) -> None:
        with self._lock:
            frames, mapping = self._streams.pop(generation, None), self._mappings.pop(generation, None)
        if frames is not None:
            frames.end(why)
        if mapping is not None:
            mapping.stop(timeout_s)

    def _keep(self) -> None:
        while not self._ended.wait(self.settings.save_every_s):
            self._save_all()

    def _save_all(self) -> None:
        if self.library is None:
            return
        for served in self.store.list():
            if served.state == "static":
                continue  # it is a file already
            try:
                self.save(served)
            except SplatbotError as error:
                _log.error("%s", error)
            except Exception:  # a defect: the other maps are saved all the same, and this one is tried again
                _log.exception("map %s cannot be saved", served.id)
                self.library.failing[served.id] = "a defect of the service; its log has the traceback"


def check_exposure(settings: ServiceSettings) -> None:
    """Check that services other machines can reach require keys, and that TLS is complete.

    Raises:
        ConfigError: it is not so.
    """
    if settings.insecure_no_auth and (settings.api_keys or not settings.loopback):
        hint = "leave it out, or listen on 127.0.0.1 without api_keys"
        raise ConfigError("is for loopback without keys.", field="insecure_no_auth", hint=hint)
    if not settings.loopback and not settings.api_keys:
        hint = "make one with `splatbot serve --new-key` and set SPLATBOT_API_KEYS, or listen on 127.0.0.1"
        raise ConfigError(f"{settings.host} can be reached by others and there is no key.", field="api_keys", hint=hint)
    if settings.trusted_proxies and not settings.api_keys:
        hint = "make one with `splatbot serve --new-key` and set SPLATBOT_API_KEYS"
        raise ConfigError("a proxy lets others reach the service and there is no key.", field="api_keys", hint=hint)
    if (settings.tls_cert is None) != (settings.tls_key is None):
        raise ConfigError("one of the two is missing.", field="tls_cert, tls_key", hint="give both")
    for name in ("tls_cert", "tls_key"):
        path = getattr(settings, name)
        if path is not None and not path.is_file():
            raise ConfigError("does not exist.", file=path, field=name, hint="check the path")
