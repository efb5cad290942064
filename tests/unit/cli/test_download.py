"""`splatbot download`: the official server is replaced by one of this process."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

from splatbot.cli.download import PlainSteps, describe
from splatbot.downloads import catalogue
from splatbot.logs import open_log
from tests.terminal import at_a_terminal
from tests.unit.cli.conftest import RunCommand, assert_fix_named
from tests.unit.downloads.server import FileServer, refuse, send, serving, tgz, zipped

NAME = "tum/fr1_rpy"  # an entry without digest, which takes any archive
PATH = "/rgbd/dataset/freiburg1/rgbd_dataset_freiburg1_rpy.tgz"


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch, make_log: Callable[..., Path]) -> Iterator[FileServer]:
    """A mirror that has one recording, and that the environment names."""
    with serving() as running:
        running.add(PATH, tgz(make_log(12), "rgbd_dataset_freiburg1_rpy"))
        monkeypatch.setenv("NO_PROXY", "127.0.0.1")
        monkeypatch.setenv("SPLATBOT_DOWNLOAD_URL_BASE", running.base)
        yield running


def test_the_list_has_every_recording_with_its_terms(run: RunCommand) -> None:
    answer = run("download", "--list")
    assert answer.code == 0
    for recording in catalogue().values():
        assert recording.name in answer.out
        assert recording.terms in answer.out


def test_a_download_prints_its_digest_and_the_next_command(
    run: RunCommand, server: FileServer, work_folder: Path
) -> None:
    answer = run("download", NAME)
    assert answer.code == 0, answer.err
    folder = Path("recordings") / NAME
    digest = (work_folder / "recordings/tum/fr1_rpy.sha256").read_text().split()[0]
    assert f"sha256 {digest}" in answer.out
    assert "the catalogue has no sha256" in answer.out
    assert f"{folder}.sha256: the sha256 that later downloads must equal" in answer.out
    assert answer.out.splitlines()[-1] == f"next: splatbot map {folder} --camera tum_fr1"
    assert {line.split()[0] for line in answer.err.splitlines()} == {"fetching", "checking", "unpacking"}
    assert len(open_log(work_folder / folder, camera="tum_fr1")) == 12


def test_a_complete_folder_is_reported(run: RunCommand, server: FileServer, tmp_path: Path) -> None:
    folder = tmp_path / "a folder"
    assert run("download", NAME, "--out", folder).code == 0
    answer = run("download", NAME, "--out", folder)
    assert answer.code == 0
    assert "complete since an earlier download" in answer.out
    assert f"next: splatbot map '{folder}' --camera tum_fr1" in answer.out
    assert len(server.requests) == 1


def test_an_archive_of_several_recordings_names_them(run: RunCommand, server: FileServer, tmp_path: Path) -> None:
    server.add(
        "/nice-slam/data/Replica.zip", zipped({f"Replica/{name}/traj.txt": b"" for name in ("room0", "office0")})
    )
    answer = run("download", "replica/nice-slam", "--out", tmp_path / "a")
    assert answer.code == 0, answer.err
    assert "recordings in it: office0, room0" in answer.out
    assert answer.out.splitlines()[-1] == f"next: splatbot map {tmp_path / 'a' / 'office0'}"


def test_a_quiet_download_prints_nothing(run: RunCommand, server: FileServer, tmp_path: Path) -> None:
    answer = run("download", NAME, "--out", tmp_path / "a", "--quiet")
    assert (answer.code, answer.out, answer.err) == (0, "", "")


@pytest.mark.parametrize(
    ("words", "mistake"),
    [
        ([], "NAME: is missing"),
        (["tum/fr1_dsk"], "did you mean tum/fr1_desk"),
        ([NAME, "--url-base", "mirror"], "--url-base: 'mirror' is no address"),
        ([NAME, "--out", __file__], "--out: is a file"),
    ],
)
def test_wrong_words_name_their_fix(run: RunCommand, work_folder: Path, words: list[str], mistake: str) -> None:
    assert_fix_named(run("download", *words), mistake)


def test_the_option_precedes_the_environment(run: RunCommand, server: FileServer, tmp_path: Path) -> None:
    answer = run("download", NAME, "--out", tmp_path / "a", "--url-base", f"{server.base}/elsewhere")
    assert answer.code == 1
    assert "404" in answer.err
    assert server.requests[0][0] == f"/elsewhere{PATH}"


def test_another_archive_than_that_of_the_catalogue_is_refused(
    run: RunCommand, server: FileServer, tmp_path: Path
) -> None:
    server.files[PATH.replace("rpy", "desk")] = server.files[PATH]
    answer = run("download", "tum/fr1_desk", "--out", tmp_path / "a")
    assert answer.code == 1
    assert "instead of 344011403" in answer.err
    assert not (tmp_path / "a").exists()


def test_a_wait_is_a_warning(run: RunCommand, server: FileServer, tmp_path: Path) -> None:
    server.answers += [refuse(503)]
    answer = run("download", NAME, "--out", tmp_path / "a")
    assert answer.code == 0
    assert "warning: the server answers 503 Service Unavailable; the next attempt follows in 1 s" in answer.err


def test_a_full_disk_is_a_sentence_and_keeps_the_received_part(server: FileServer, tmp_path: Path) -> None:
    words = [sys.executable, "-m", "splatbot", "download", NAME, "--out", str(tmp_path / "a")]
    limit = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (50_000, 50_000))
    answer = subprocess.run(words, capture_output=True, text=True, preexec_fn=limit, timeout=60, env=os.environ)
    assert answer.returncode == 1
    assert answer.stderr.splitlines()[-1].startswith("error: ")
    assert "Traceback" not in answer.stderr
    assert not (tmp_path / "a").exists()
    assert (tmp_path / ".a.download" / "rgbd_dataset_freiburg1_rpy.tgz.part").stat().st_size == 50_000


def test_ctrl_c_keeps_the_received_part_for_the_next_call(server: FileServer, tmp_path: Path) -> None:
    server.answers += [partial(send, pause_s=10.0)]
    words = ("download", NAME, "--out", str(tmp_path / "a"))
    part = tmp_path / ".a.download" / "rgbd_dataset_freiburg1_rpy.tgz.part"
    shown = at_a_terminal(*words, columns=80, interrupt_when=lambda: part.is_file() and part.stat().st_size > 0)
    assert shown.code == 130
    assert "fetching 0/0 MB" in shown.text
    assert "the received part is kept; the same command continues" in shown.text
    assert "Traceback" not in shown.text
    shown = at_a_terminal(*words, columns=80)
    assert shown.code == 0
    assert server.requests[1][1]["Range"].startswith("bytes=")
    assert len(open_log(tmp_path / "a", camera="tum_fr1")) == 12


@pytest.mark.parametrize("columns", [80, 200])
def test_a_terminal_shows_a_bar_that_fits(server: FileServer, tmp_path: Path, columns: int) -> None:
    server.answers += [partial(send, pause_s=0.05)]
    shown = at_a_terminal("download", NAME, "--out", str(tmp_path / "a"), columns=columns)
    assert shown.code == 0
    assert shown.live
    assert "fetching" in shown.text
    assert shown.longest_line() <= columns


@pytest.mark.parametrize("columns", [60, 80])
def test_the_list_fits_the_terminal(columns: int) -> None:
    shown = at_a_terminal("download", "--list", columns=columns)
    assert shown.code == 0
    assert shown.longest_line() <= columns


def test_plain_progress_is_a_line_for_each_step_and_each_period(capsys: pytest.CaptureFixture[str]) -> None:
    now = [0.0]
    show = PlainSteps(lambda: now[0])
    for moment in (0.0, 0.5, 1.9, 2.1, 2.2, 4.2):
        now[0] = moment
        show("fetching", int(moment * 1e7), 100_000_000)
    show("checking", 0, 100_000_000)
    assert capsys.readouterr().err.splitlines() == [
        "fetching 0/100 MB",
        "fetching 21/100 MB",
        "fetching 42/100 MB",
        "checking 0/100 MB",
    ]


def test_an_unknown_size_is_left_out() -> None:
    assert describe("fetching", 5_000_000, None) == "fetching 5 MB"
