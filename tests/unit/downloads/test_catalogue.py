"""The catalogue: its addresses are safe, and its names are found."""

from __future__ import annotations

import re

import pytest

from splatbot.downloads import PublicRecording, catalogue, find_recording
from splatbot.errors import InputError
from splatbot.logs.presets import PRESETS


@pytest.mark.parametrize("recording", catalogue().values(), ids=list(catalogue()))
def test_every_entry_is_complete_and_uses_https(recording: PublicRecording) -> None:
    assert re.fullmatch(r"https://[\w.-]+/[\w./-]+\.(tgz|zip)", recording.url)
    assert re.fullmatch(r"[a-z0-9]+/[a-z0-9_-]+", recording.name)
    assert re.fullmatch(r"[\w-]+", recording.root)
    assert recording.camera is None or recording.camera in PRESETS
    assert recording.sha256 is None or re.fullmatch(r"[0-9a-f]{64}", recording.sha256)
    assert (recording.size is None) == (recording.sha256 is None)
    assert "Cite" in recording.terms


def test_the_sequences_of_tum_are_named_after_their_archives() -> None:
    for recording in catalogue().values():
        if recording.name.startswith("tum/"):
            kinect, _, sequence = recording.name.removeprefix("tum/fr").partition("_")
            assert recording.archive == f"rgbd_dataset_freiburg{kinect}_{sequence}.tgz"
            assert recording.root == recording.archive.removesuffix(".tgz")
            assert recording.camera == f"tum_fr{kinect}"


@pytest.mark.parametrize(
    ("name", "near"),
    [("tum/fr1_dsk", "tum/fr1_desk"), ("fr1_desk", "tum/fr1_desk"), ("redkitchn", "7scenes/redkitchen")],
)
def test_an_unknown_name_lists_near_names(name: str, near: str) -> None:
    with pytest.raises(InputError, match=f"did you mean .*{near}"):
        find_recording(name)


def test_a_name_that_resembles_no_other_leads_to_the_list() -> None:
    with pytest.raises(InputError, match=r"splatbot download --list"):
        find_recording("x" * 10_000)
