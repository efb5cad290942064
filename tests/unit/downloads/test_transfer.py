"""One file over HTTP: after each fault of a real server it is the same file, or there is a sentence and no file."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from splatbot.downloads import DownloadError, Patience
from splatbot.downloads.transfer import fetch
from tests.unit.downloads.server import Answer, FileServer, Handler, cut, endless, refuse, send
from tests.unit.downloads.transfers import CONTENT, PATIENCE, StoppedError, get

OTHER = np.random.default_rng(8).bytes(280_000)


def files(folder: Path) -> list[str]:
    """Return the names of the files of a folder."""
    return sorted(path.name for path in folder.iterdir())


def test_a_file_is_fetched_whole_and_alone(server: FileServer, tmp_path: Path) -> None:
    get(server.add("/a.tgz", CONTENT), tmp_path / "a", size=len(CONTENT))
    assert (tmp_path / "a").read_bytes() == CONTENT
    assert files(tmp_path) == ["a"]


def test_cut_connections_are_continued_where_they_ended(server: FileServer, tmp_path: Path) -> None:
    server.answers += [cut(100_000), cut(50_000)]
    notices = get(server.add("/a.tgz", CONTENT), tmp_path / "a")
    assert (tmp_path / "a").read_bytes() == CONTENT
    assert server.ranges == [None, "bytes=100000-", "bytes=150000-"]
    assert len(notices) == 2


def test_cuts_at_any_place_give_the_same_file(server: FileServer, tmp_path: Path, rng: np.random.Generator) -> None:
    url = server.add("/a.tgz", CONTENT)
    for trial in range(20):
        server.answers[:] = [cut(int(n)) for n in rng.integers(0, 150_000, 2)]
        get(url, tmp_path / f"{trial}")
        assert (tmp_path / f"{trial}").read_bytes() == CONTENT


def test_attempts_that_bring_bytes_do_not_count(server: FileServer, tmp_path: Path) -> None:
    server.answers += [cut(20_000)] * 10
    patience = Patience(attempts=2, first_wait=0.0, timeout=2.0, worth=20_000)
    get(server.add("/a.tgz", CONTENT), tmp_path / "a", patience=patience)
    assert (tmp_path / "a").read_bytes() == CONTENT


def test_a_silent_server_is_left_and_asked_again(server: FileServer, tmp_path: Path) -> None:
    server.answers += [lambda handler: time.sleep(1.0)]
    get(server.add("/a.tgz", CONTENT), tmp_path / "a", patience=Patience(first_wait=0.0, timeout=0.3))
    assert (tmp_path / "a").read_bytes() == CONTENT


def test_an_interrupted_transfer_is_continued_by_the_next_call(server: FileServer, tmp_path: Path) -> None:
    url = server.add("/a.tgz", CONTENT)
    with pytest.raises(StoppedError):
        get(url, tmp_path / "a", stop_at=100_000)
    here = (tmp_path / "a.part").stat().st_size
    assert CONTENT.startswith((tmp_path / "a.part").read_bytes())
    get(url, tmp_path / "a")
    assert (tmp_path / "a").read_bytes() == CONTENT
    assert here >= 100_000
    assert server.ranges[-1] == f"bytes={here}-"
    assert "If-Range" in server.requests[-1][1]


def test_a_transfer_that_ended_before_the_rename_needs_no_request(server: FileServer, tmp_path: Path) -> None:
    url = server.add("/a.tgz", CONTENT)
    with pytest.raises(StoppedError):
        get(url, tmp_path / "a", stop_at=len(CONTENT))
    get(url, tmp_path / "a")
    assert (tmp_path / "a").read_bytes() == CONTENT
    assert len(server.requests) == 1


@pytest.mark.parametrize(
    "then",
    [
        pytest.param([partial(send, ranges=False)], id="ignores Range"),
        pytest.param([], id="obeys If-Range"),
        pytest.param([partial(send, conditions=False)], id="ignores If-Range"),
        pytest.param([refuse(416)], id="knows no such range"),
        pytest.param([refuse(206, Content_Range="bytes 0-9/10")], id="sends another range"),
        pytest.param([refuse(206, Content_Range="bytes a-b/" + "9" * 5000)], id="sends a damaged range"),
    ],
)
@pytest.mark.parametrize("content", [CONTENT, OTHER, CONTENT[:1000]], ids=["same", "changed", "shorter"])
def test_no_file_is_made_of_two(server: FileServer, tmp_path: Path, then: Sequence[Answer], content: bytes) -> None:
    url = server.add("/a.tgz", CONTENT)
    with pytest.raises(StoppedError):
        get(url, tmp_path / "a", stop_at=100_000)
    server.add("/a.tgz", content)
    server.answers += then
    get(url, tmp_path / "a")
    assert (tmp_path / "a").read_bytes() == content


def test_a_file_without_validator_starts_again(server: FileServer, tmp_path: Path) -> None:
    server.answers += [partial(send, validator=False, cut=100_000)]
    get(server.add("/a.tgz", CONTENT), tmp_path / "a")
    assert (tmp_path / "a").read_bytes() == CONTENT
    assert server.ranges == [None, None]


@pytest.mark.parametrize(
    "state",
    [
        b"",
        b"[]",
        b"{}",
        b"\xff" * 100,
        b"[" * 100_000,
        json.dumps({"url": "URL", "validator": 5, "size": 300_000}).encode(),
        json.dumps({"url": "URL", "validator": '"a"', "size": "many"}).encode(),
        json.dumps({"url": "https://elsewhere.org/a.tgz", "validator": '"a"', "size": 300_000}).encode(),
        json.dumps({"url": "URL", "validator": '"a"', "size": 10}).encode(),
    ],
)
def test_a_damaged_state_starts_again(server: FileServer, tmp_path: Path, state: bytes) -> None:
    url = server.add("/a.tgz", CONTENT)
    (tmp_path / "a.part").write_bytes(OTHER[:50_000])
    (tmp_path / "a.json").write_bytes(state.replace(b"URL", url.encode()))
    get(url, tmp_path / "a")
    assert (tmp_path / "a").read_bytes() == CONTENT
    assert files(tmp_path) == ["a"]


@pytest.mark.parametrize("status", [408, 429, 500, 502, 503, 504])
def test_passing_errors_are_tried_again(server: FileServer, tmp_path: Path, status: int) -> None:
    server.answers += [refuse(status, Retry_After=0), refuse(status, Retry_After="soon")]
    notices = get(server.add("/a.tgz", CONTENT), tmp_path / "a")
    assert (tmp_path / "a").read_bytes() == CONTENT
    assert all(f"answers {status}" in notice for notice in notices)


def test_the_wait_follows_retry_after_up_to_its_limit(
    server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits: list[float] = []
    monkeypatch.setattr("splatbot.downloads.transfer.time", SimpleNamespace(sleep=waits.append))
    server.answers += [refuse(503, Retry_After=7), refuse(503, Retry_After=999_999)]
    get(server.add("/a.tgz", CONTENT), tmp_path / "a")
    assert waits == [7.0, PATIENCE.longest_wait]


def test_the_text_of_a_status_cannot_reach_the_terminal(server: FileServer, tmp_path: Path) -> None:
    def answer(handler: Handler) -> None:
        handler.send_response(404, "\x1b[2Jall is well")
        handler.end_headers()

    server.answers += [answer]
    with pytest.raises(DownloadError, match="answers 404 Not Found") as raised:
        get(server.add("/a.tgz", CONTENT), tmp_path / "a")
    assert "\x1b" not in str(raised.value)


def test_attempts_without_progress_come_to_an_end(server: FileServer, tmp_path: Path) -> None:
    server.answers += [refuse(503)] * 10
    with pytest.raises(DownloadError, match=r"answers 503 .*3 attempts.*it continues"):
        get(server.add("/a.tgz", CONTENT), tmp_path / "a")
    assert len(server.requests) == 3


@pytest.mark.parametrize("status", [401, 403, 404, 410, 204, 304])
def test_lasting_errors_are_reported_at_once(server: FileServer, tmp_path: Path, status: int) -> None:
    server.answers += [refuse(status)]
    with pytest.raises(DownloadError, match=f"answers {status}.*--url-base"):
        get(server.add("/a.tgz", CONTENT), tmp_path / "a")
    assert len(server.requests) == 1
    assert files(tmp_path) == []


def test_a_length_beyond_the_body_is_a_cut(server: FileServer, tmp_path: Path) -> None:
    server.answers += [partial(send, announced=400_000)] * 9
    with pytest.raises(DownloadError):
        get(server.add("/a.tgz", CONTENT), tmp_path / "a")
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize("announced", [10, 400_000])
def test_another_size_than_the_expected_one_is_refused_before_the_body(
    server: FileServer, tmp_path: Path, announced: int
) -> None:
    server.answers += [partial(send, announced=announced)]
    with pytest.raises(DownloadError, match=f"{announced} bytes instead of {len(CONTENT)}"):
        get(server.add("/a.tgz", CONTENT), tmp_path / "a", size=len(CONTENT))
    assert files(tmp_path) == []


def test_an_endless_body_ends_at_the_room(server: FileServer, tmp_path: Path) -> None:
    server.answers += [endless]
    with pytest.raises(DownloadError, match="more than 1048576 bytes"):
        get(server.add("/a.tgz", CONTENT), tmp_path / "a")
    assert (tmp_path / "a.part").stat().st_size <= 1 << 20


def test_a_refused_size_leaves_the_disk_empty(server: FileServer, tmp_path: Path) -> None:
    def room(total: int | None, here: int) -> int:
        raise DownloadError("too large")

    with pytest.raises(DownloadError, match="too large"):
        fetch(
            server.add("/a.tgz", CONTENT),
            tmp_path / "a",
            size=None,
            room=room,
            progress=lambda done, total: None,
            notice=lambda sentence: None,
            patience=PATIENCE,
        )
    assert files(tmp_path) == []
