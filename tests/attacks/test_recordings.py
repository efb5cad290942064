"""Recordings of topics whose process is killed, or whose file is damaged."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader

from splatbot.errors import LogError
from splatbot.logs.mcap import McapFile
from splatbot.logs.ros_types import build

RECORD = """
import os, sys, time
from splatbot.logs.mcap import McapFile
from splatbot.logs.ros_types import build
out = McapFile(sys.argv[1])
for k in range(100_000):
    out.write(f"/t{k % 3}", build("std_msgs/msg/String", data=f"{k} " + os.urandom(2500).hex()), k * 1000)
    if k == 900:
        print("written", flush=True)
        time.sleep(60)
"""


def texts(path: Path) -> list[int]:
    with AnyReader([path]) as reader:
        return [
            int(reader.deserialize(raw, connection.msgtype).data.split()[0])  # type: ignore[attr-defined]
            for connection, _, raw in reader.messages()
        ]


def killed(path: Path) -> int:
    """Record until the process is killed; return the number of messages in whole chunks."""
    process = subprocess.Popen([sys.executable, "-c", RECORD, path], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "written\n"
    with pytest.raises(LogError, match="another process"):
        McapFile(path)
    process.send_signal(signal.SIGKILL)
    process.wait(10)
    return 2**20 // 5050 * (900 * 5050 // 2**20)


def test_a_killed_recording_is_recovered_at_the_next_start(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "a.mcap"
    least = killed(path)
    with McapFile(path) as out:
        out.write("/new", build("std_msgs/msg/String", data="7"), 5)
    found = texts(tmp_path / "a.recovered-1.mcap")
    assert found == list(range(len(found)))
    assert len(found) >= least
    assert "recovered" in caplog.text
    assert texts(path) == [7]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mcap", "a.recovered-1.mcap"]


@pytest.mark.parametrize("how", ["torn", "flip", "zeros", "garbage", "empty", "no file"])
def test_a_damaged_partial_recording_never_prevents_a_start(
    tmp_path: Path, how: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "a.mcap"
    killed(path)
    (left,) = (tmp_path / ".a.mcap.partial").glob("*.mcap")
    data = bytearray(left.read_bytes())
    at = len(data) * 2 // 5
    damaged = {
        "torn": data[: len(data) * 2 // 3],
        "flip": data[:at] + bytes([data[at] ^ 8]) + data[at + 1 :],
        "zeros": data[:at] + bytes(4096) + data[at + 4096 :],
        "garbage": bytearray(b"no recording"),
        "empty": bytearray(),
        "no file": bytearray(),
    }[how]
    left.write_bytes(damaged)
    if how == "no file":
        left.unlink()
    with caplog.at_level(logging.WARNING):
        McapFile(path).close()
    if how in ("torn", "flip", "zeros"):
        found = texts(tmp_path / "a.recovered-1.mcap")
        assert found == list(range(len(found)))
        assert 100 < len(found) < 900
        assert "cut off or damaged" in caplog.text


def test_messages_reach_the_disk_within_a_second_or_two(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    out = McapFile(path)
    out.write("/a", build("std_msgs/msg/String", data="1"), 5)
    time.sleep(1.2)
    out.flush_due()
    (left,) = (tmp_path / ".a.mcap.partial").glob("*.mcap")
    copy = tmp_path / ".b.mcap.partial"
    copy.mkdir()
    (copy / f"{copy.name}.mcap").write_bytes(left.read_bytes())
    McapFile(tmp_path / "b.mcap").close()
    assert texts(tmp_path / "b.recovered-1.mcap") == [1]
    out.close()


def test_a_flipped_bit_in_a_chunk_is_an_error_of_its_reader(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with McapFile(path) as out:
        for k in range(50):
            out.write("/a", build("std_msgs/msg/String", data=f"{k} {os.urandom(200).hex()}"), k)
    data = bytearray(path.read_bytes())
    for at in range(2000, 2400, 8):
        flipped = bytearray(data)
        flipped[at] ^= 1
        path.write_bytes(flipped)
        with pytest.raises(Exception, match=r".+"):
            texts(path)
