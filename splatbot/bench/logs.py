"""`splatbot bench logs`: frames per second that logs of each layout deliver, on one core."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

from tyro.conf import arg

from splatbot.bench.benchmark import Benchmark, ReportProgress, Settings
from splatbot.bench.results import Results
from splatbot.bench.tables import Table, per_case
from splatbot.errors import InputError


@dataclass(frozen=True)
class LogsSettings(Settings):
    """Read the same frames from each layout on one core, and the images of the TUM folder with OpenCV alone.

    A frame is decoded, checked, undistorted and in metres. MCAP is written raw and with zstd.

    Examples:
        splatbot bench logs
        splatbot bench logs --log ../shared/data/redkitchen_000_199

    Args:
        log: Recording whose frames are used.
        frames: Number of frames.
    """

    name: ClassVar[str] = "logs"
    quick_values: ClassVar[Mapping[str, Any]] = {"frames": 2, "log": "synthetic:tabletop?frames=2&width=160&height=120"}

    log: Annotated[str, arg(metavar="LOG")] = "synthetic:tabletop?frames=60&width=640&height=480"
    frames: Annotated[int, arg(metavar="N")] = 60

    def validate(self) -> None:
        """Raise an InputError for fewer than two frames."""
        if self.frames < 2:
            raise InputError(f"is {self.frames}.", field="--frames", hint="give 2 or more")


def _measure(settings: LogsSettings, report_progress: ReportProgress) -> Results:
    import cv2

    from splatbot.bench.machine import describe_machine
    from splatbot.logs import open_log
    from splatbot.logs.mcap import record_mcap
    from splatbot.logs.record import record

    results = Results(describe_machine((1,), peak_ms=settings.peak_ms))
    report_progress(f"reading {settings.log}")
    log = open_log(settings.log)
    frames = [log[i] for i in range(min(settings.frames, len(log)))]
    size = f"{log.camera.width}x{log.camera.height}"
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with tempfile.TemporaryDirectory() as folder:
            report_progress("writing TUM and MCAP")
            tum = record(frames, Path(folder) / "tum")
            packed = record_mcap(open_log(tum), Path(folder) / "zstd.mcap")
            raw = _write_raw(packed, Path(folder) / "raw")
            for name, path in (("TUM, PNG and PNG", tum), ("MCAP, zstd", packed), ("MCAP, raw", raw)):
                report_progress(name)
                results.add(f"{size}, {name}", "frames/s", _rate(iter(open_log(path)), len(frames)), "frames/s")
            alone = _rate(_images(tum), len(frames))
            results.add(f"{size}, TUM, PNG and PNG", "frames/s", alone, "frames/s", peer="cv2.imread")
    finally:
        cv2.setNumThreads(threads)
    return results


def _rate(items: Iterator[Any], count: int) -> float:
    """Return the items per second."""
    begin = time.perf_counter()
    found = sum(1 for _ in items)
    if found != count:
        raise RuntimeError(f"{found} of {count} frames were read")
    return count / (time.perf_counter() - begin)


def _images(folder: Path) -> Iterator[Any]:
    """Yield colour and depth of a TUM folder as OpenCV decodes them."""
    import cv2

    for color in sorted((folder / "rgb").iterdir()):
        yield cv2.imread(str(color)), cv2.imread(str(folder / "depth" / color.name), cv2.IMREAD_UNCHANGED)


def _write_raw(packed: Path, folder: Path) -> Path:
    """Write the messages of a recording into an MCAP file without compression; return its path."""
    from rosbags.highlevel import AnyReader
    from rosbags.rosbag2 import StoragePlugin, Writer

    from splatbot.logs.ros_types import typestore

    reader = AnyReader([packed], default_typestore=typestore())
    with reader, Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = {}
        for connection in reader.connections:
            added = writer.add_connection(connection.topic, connection.msgtype, typestore=typestore())
            topics[connection.topic] = added
        for connection, received, data in reader.messages():
            writer.write(topics[connection.topic], received, data)
    (path,) = folder.glob("*.mcap")
    return path


BENCHMARK = Benchmark(
    LogsSettings, _measure, tables=(Table("Frames per second on one core", lambda row: True, layout=per_case),)
)
