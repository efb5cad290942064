"""Poses of photographs: COLMAP (pycolmap) on simulated photographs, and a stand-in for the program `colmap`."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.cli import main
from splatbot.cli.prepare import _replace
from splatbot.errors import InputError, LogError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import look_at
from splatbot.logs.images import read_color
from splatbot.rasterize.views import render_view
from splatbot.training.datasets import open_dataset
from splatbot.training.datasets.photographs import collect_photographs, sharpness
from splatbot.training.datasets.posing import find_colmap
from tests.waiting import until

CAMERA = Camera(400.0, 400.0, 191.5, 143.5, 384, 288)

# Simulates the program: it records the options of each step, and writes a model in the published binary layout
# (colmap.github.io/format.html). The model has one camera, and an image for each file but the last.
PROGRAM = """#!{python}
import json, os, struct, sys, time
from pathlib import Path
step, words = sys.argv[1], sys.argv[2:]
options = dict(zip(words[::2], words[1::2]))
with open({record!r}, "a") as record:
    record.write(json.dumps([os.getpid(), step, sorted(options)]) + chr(10))
print("stand-in", step)
if step in {failing!r}:
    print("no GPU")
    sys.exit(3)
if step == "mapper":
    time.sleep({pause})
    images = sorted(os.listdir(options["--image_path"]))[:-1]
    for number, names in enumerate([images[:1], images][:{models}]):
        model = Path(options["--output_path"]) / str(number)
        model.mkdir()
        width, height = {size}
        camera = struct.pack("<QIiQQ3d", 1, 1, 0, width, height, 40.0, width / 2, height / 2)
        (model / "cameras.bin").write_bytes(camera)
        rows = [struct.pack("<I7dI", i + 1, 1, 0, 0, 0, float(i), 0, 0, 1) + name.encode() + bytes(9)
                for i, name in enumerate(names)]
        (model / "images.bin").write_bytes(struct.pack("<Q", len(rows)) + b"".join(rows))
        (model / "points3D.bin").write_bytes(struct.pack("<QQ3d3BdQ", 1, 1, 0, 0, 1, 9, 9, 9, 0.5, 0))
else:
    Path(options["--database_path"]).touch()
"""


@pytest.fixture
def images(tmp_path: Path) -> Path:
    """Five small images."""
    folder = tmp_path / "photographs"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for index in range(5):
        cv2.imwrite(str(folder / f"{index}.png"), rng.integers(0, 255, (48, 64, 3), np.uint8))
    return folder


def install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, failing: tuple[str, ...] = (), models: int = 2, pause: float = 0
) -> Path:
    """Put the stand-in first on the PATH, and return the file that records its steps."""
    program, record = tmp_path / "bin" / "colmap", tmp_path / "steps.jsonl"
    program.parent.mkdir()
    program.write_text(
        PROGRAM.format(
            python=sys.executable, record=str(record), failing=failing, models=models, size=(64, 48), pause=pause
        )
    )
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")
    return record


def ignore(step: str, share: float) -> None:
    assert 0.0 <= share <= 1.0


def write_video(path: Path, blurred: set[int], count: int = 30) -> None:
    """Write frames of noise that brightens with the index, of which some are blurred."""
    rng = np.random.default_rng(0)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for index in range(count):
        frame = rng.integers(0, 100, (48, 64, 3), np.uint8) + np.uint8(4 * index)
        writer.write(cv2.GaussianBlur(frame, (9, 9), 3) if index in blurred else frame)
    writer.release()


def rendered_photographs(folder: Path, count: int = 8) -> NDArray[np.float64]:
    """Render photographs on an arc of 60 degrees around many coloured Gaussians, and return the camera centres."""
    rng = np.random.default_rng(3)
    n = 3000
    model = GaussianModel.from_activated(
        means=rng.uniform([-1.0, -0.8, -0.5], [1.0, 0.8, 0.5], (n, 3)),
        quats=rng.normal(size=(n, 4)),
        scales=rng.uniform(0.01, 0.05, (n, 3)),
        opacities=np.full(n, 0.95),
        colors=rng.uniform(0.0, 1.0, (n, 3)),
    )
    angles = np.linspace(-np.pi / 6, np.pi / 6, count)
    eyes = np.stack([3 * np.sin(angles), 0.3 * np.cos(5 * angles), -3 * np.cos(angles)], axis=1)
    for index, eye in enumerate(eyes):
        image = render_view(model, CAMERA, look_at(eye, np.zeros(3)))
        bgr = np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)[..., ::-1]
        cv2.imwrite(str(folder / f"{index}.png"), bgr)
    return eyes


def aligned_errors(found: NDArray[np.float64], true: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances (N,) after the best similarity (Umeyama 1991)."""
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    D = np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))])
    scale = np.trace(np.diag(S) @ D) / (a**2).sum()
    return np.linalg.norm(scale * a @ (U @ D @ Vt).T - b, axis=1)


@pytest.mark.long
def test_pycolmap_finds_the_poses_of_simulated_photographs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    (tmp_path / "photographs").mkdir()
    eyes = rendered_photographs(tmp_path / "photographs")
    assert main(["prepare", str(tmp_path / "photographs"), "--out", str(tmp_path / "scene"), "--quiet"]) == 0
    data = open_dataset(tmp_path / "scene")
    assert [view.name for view in data.views] == [f"{index}.png" for index in range(8)]
    found = np.stack([view.T_world_camera[:3, 3] for view in data.views])
    assert aligned_errors(found, eyes).max() < 0.05  # of 3 from the middle of the scene
    assert abs(data.views[0].camera.fx / CAMERA.fx - 1) < 0.1
    assert len(data.points) > 100


def test_a_folder_becomes_a_scene_that_training_opens(
    tmp_path: Path, images: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    record, out = install(tmp_path, monkeypatch), tmp_path / "scenes" / "shelf"
    assert main(["prepare", str(images), "--out", str(out)]) == 0
    assert sorted(place.name for place in out.iterdir()) == ["colmap.log", "images", "sparse"]
    assert [model.name for model in (out / "sparse").iterdir()] == ["0"]
    assert [view.name for view in open_dataset(out).views] == ["0.png", "1.png", "2.png", "3.png"]
    assert (out / "images" / "4.png").read_bytes() == (images / "4.png").read_bytes()
    assert (out / "colmap.log").read_text().splitlines()[-1] == "stand-in mapper"
    assert [json.loads(line)[1:] for line in record.read_text().splitlines()] == [
        ["feature_extractor", ["--ImageReader.single_camera", "--database_path", "--image_path"]],
        ["exhaustive_matcher", ["--database_path"]],
        ["mapper", ["--database_path", "--image_path", "--output_path"]],
    ]
    printed = capsys.readouterr()
    assert "poses of 4 of 5 photographs" in printed.out
    assert "1 more models" in printed.err
    assert not list(out.parent.glob(".*"))


def test_an_existing_scene_needs_overwrite_and_other_files_stay(
    tmp_path: Path, images: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    install(tmp_path, monkeypatch, models=1)
    out = tmp_path / "scene"
    words = ["prepare", str(images), "--out", str(out), "--quiet"]
    assert main([*words, "--frames", "3"]) == 0
    (out / "notes.txt").write_text("mine")
    assert main(words) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert main([*words, "--overwrite"]) == 0
    assert (out / "notes.txt").read_text() == "mine"
    assert len(list((out / "images").iterdir())) == 5
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").touch()
    assert main([*words[:3], str(tmp_path / "other"), "--overwrite"]) == 2
    assert "no COLMAP scene" in capsys.readouterr().err
    assert main([*words[:3], str(tmp_path), "--overwrite"]) == 2
    assert "holds the input" in capsys.readouterr().err


def test_a_failed_step_is_named_with_the_last_line_and_leaves_nothing(
    tmp_path: Path, images: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    install(tmp_path, monkeypatch, failing=("exhaustive_matcher",))
    assert main(["prepare", str(images), "--out", str(tmp_path / "scene"), "--quiet"]) == 2
    error = capsys.readouterr().err
    assert "ends with 3 in the step exhaustive_matcher: no GPU" in " ".join(error.split())
    assert not (tmp_path / "scene").exists()
    assert not list(tmp_path.glob(".*"))


def test_no_model_is_an_error_with_a_fix(
    tmp_path: Path, images: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    install(tmp_path, monkeypatch, models=0)
    assert main(["prepare", str(images), "--out", str(tmp_path / "scene"), "--quiet"]) == 2
    assert "finds no poses. Fix: take more photographs" in " ".join(capsys.readouterr().err.split())


def test_without_colmap_one_sentence_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    assert find_colmap()[0] == sys.executable  # pycolmap
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"colmap: is not installed\. Fix: pip install 'splatbot\[colmap\]'"):
        find_colmap()


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGHUP])
def test_a_signal_ends_colmap_with_its_children_and_leaves_nothing(
    tmp_path: Path, images: Path, monkeypatch: pytest.MonkeyPatch, end: signal.Signals
) -> None:
    record = install(tmp_path, monkeypatch, pause=60)
    program = tmp_path / "bin" / "colmap"
    program.rename(program.with_name("child"))
    program.write_text('#!/bin/sh\n"$0/../child" "$@"\nexit $?\n'.replace("$0/..", str(program.parent)))
    program.chmod(0o755)
    words = ["env", "--default-signal=HUP", sys.executable, "-m", "splatbot", "prepare", str(images)]
    words += ["--out", str(tmp_path / "scene")]
    with subprocess.Popen(words, stderr=subprocess.PIPE, start_new_session=True) as process:
        while not (record.is_file() and "mapper" in record.read_text()):
            assert process.poll() is None
            time.sleep(0.05)
        process.send_signal(end)
        _, error = process.communicate(timeout=120)
    assert (process.returncode, error.splitlines()[-1]) == (130, b"interrupted")
    assert sorted(place.name for place in tmp_path.iterdir()) == ["bin", "photographs", "steps.jsonl"]
    child = Path("/proc") / str(json.loads(record.read_text().splitlines()[-1])[0]) / "cmdline"

    def has_ended() -> bool:
        try:
            return not child.read_bytes()  # a zombie has no command line
        except (FileNotFoundError, ProcessLookupError):
            return True

    until(has_ended)


def test_a_replaced_scene_may_be_a_link_to_another_disk_with_linked_photographs(
    tmp_path: Path, images: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = Path("/dev/shm")
    if not memory.is_dir() or memory.stat().st_dev == tmp_path.stat().st_dev:
        pytest.skip("needs a second disk, as /dev/shm")
    install(tmp_path, monkeypatch, models=1)
    with tempfile.TemporaryDirectory(dir=memory) as disk:
        home, out, originals = Path(disk) / "scene", tmp_path / "scene", tmp_path / "originals"
        home.mkdir()
        out.symlink_to(home)
        words = ["prepare", str(images), "--out", str(out), "--quiet", "--overwrite"]
        assert main([*words, "--frames", "3"]) == 0
        shutil.move(home / "images", originals)
        (home / "images").symlink_to(originals)
        (home / "colmap.log").unlink()
        (home / "colmap.log").mkdir()  # in place of a file
        assert main(words) == 0
        assert out.is_symlink()
        assert sorted(place.name for place in home.iterdir()) == ["colmap.log", "images", "sparse"]
        assert not (home / "images").is_symlink()
        assert (len(list((home / "images").iterdir())), len(list(originals.iterdir()))) == (5, 3)
        assert (home / "colmap.log").is_file()


def test_an_error_while_a_scene_is_replaced_restores_the_earlier_one(tmp_path: Path) -> None:
    scene, out = tmp_path / "draft", tmp_path / "scene"
    for place in (scene, out):
        for name in ("images", "sparse"):
            (place / name).mkdir(parents=True)
            (place / name / place.name).touch()
    with pytest.raises(FileNotFoundError):  # the draft has no colmap.log
        _replace(scene, out)
    assert sorted(str(place.relative_to(out)) for place in out.rglob("*")) == [
        "images",
        "images/scene",
        "sparse",
        "sparse/scene",
    ]


def test_smaller_copies_of_earlier_photographs_go_with_them(
    tmp_path: Path, images: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path, monkeypatch, models=1)
    words = ["prepare", str(images), "--out", str(tmp_path / "scene"), "--quiet", "--overwrite"]
    assert main(words) == 0
    for name in ("images_2", "images_4", "images_of_mine"):
        (tmp_path / "scene" / name).mkdir()
    assert main(words) == 0
    assert sorted(place.name for place in (tmp_path / "scene").iterdir()) == [
        "colmap.log",
        "images",
        "images_of_mine",
        "sparse",
    ]


@pytest.mark.parametrize("name", ["depth", "depths"])
def test_a_scene_with_depth_images_is_not_replaced(
    tmp_path: Path, images: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    record = install(tmp_path, monkeypatch, models=1)
    words = ["prepare", str(images), "--out", str(tmp_path / "scene"), "--quiet", "--overwrite"]
    assert main(words) == 0
    (tmp_path / "scene" / name).mkdir()
    record.unlink()
    assert main(words) == 2
    assert f"scene/{name}" in "".join(capsys.readouterr().err.split())
    assert not record.exists()  # refused before COLMAP runs


def test_a_mounted_folder_of_photographs_is_refused_before_colmap_runs(
    tmp_path: Path, images: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = install(tmp_path, monkeypatch, models=1)
    out = tmp_path / "scene"
    words = ["prepare", str(images), "--out", str(out), "--quiet", "--overwrite"]
    assert main(words) == 0
    record.unlink()
    namespace = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c"]
    if subprocess.run([*namespace, "mount -t tmpfs none /mnt"], capture_output=True).returncode:
        pytest.skip("this system lets no process mount a folder of its own")
    script = f'mount -t tmpfs none {out}/images && exec {sys.executable} -m splatbot "$@"'
    done = subprocess.run([*namespace, script, "sh", *words], capture_output=True, text=True)
    assert done.returncode == 2
    assert "is on another disk" in done.stderr
    assert not record.exists()


def test_a_model_without_images_is_skipped(tmp_path: Path, images: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path, monkeypatch, models=2)
    program = tmp_path / "bin" / "colmap"
    cut = '        if number == 0:\n            (model / "images.bin").unlink()\n'
    program.write_text(program.read_text().replace("else:\n    Path", f"{cut}else:\n    Path"))
    assert main(["prepare", str(images), "--out", str(tmp_path / "scene"), "--quiet"]) == 0
    assert [place.name for place in (tmp_path / "scene" / "sparse").iterdir()] == ["0"]
    assert len(open_dataset(tmp_path / "scene").views) == 4


def test_the_sharpest_frame_of_each_interval_is_taken(tmp_path: Path) -> None:
    write_video(tmp_path / "a.avi", blurred=set(range(30)) - {4, 17, 29})
    (tmp_path / "images").mkdir()
    names = collect_photographs(tmp_path / "a.avi", tmp_path / "images", 3, ignore)
    assert names == ["frame_000004.jpg", "frame_000017.jpg", "frame_000029.jpg"]
    assert sorted(file.name for file in (tmp_path / "images").iterdir()) == names
    image = read_color(tmp_path / "images" / names[1])
    assert image.shape == (48, 64, 3)
    assert image.mean() == pytest.approx(50 + 4 * 17, abs=5)


def test_all_frames_of_a_short_video_and_all_images_of_a_folder_are_taken(tmp_path: Path, images: Path) -> None:
    write_video(tmp_path / "a.avi", blurred=set(), count=4)
    (tmp_path / "out").mkdir()
    assert len(collect_photographs(tmp_path / "a.avi", tmp_path / "out", None, ignore)) == 4
    assert collect_photographs(images, tmp_path / "out", 100, ignore) == [f"{index}.png" for index in range(5)]


def test_sharp_images_of_a_folder_are_taken(tmp_path: Path, images: Path) -> None:
    for name in ("0.png", "2.png"):
        image = read_color(images / name)
        cv2.imwrite(str(images / name), cv2.GaussianBlur(image, (9, 9), 3))
    (tmp_path / "out").mkdir()
    assert collect_photographs(images, tmp_path / "out", 3, ignore) == ["1.png", "3.png", "4.png"]


@pytest.mark.parametrize("width", [64, 1280])
def test_blur_lowers_the_sharpness(width: int, rng: np.random.Generator) -> None:
    small = rng.integers(0, 255, (30, 40, 3), np.uint8)
    sharp = np.asarray(cv2.resize(small, (width, width * 3 // 4)), np.uint8)
    blurred = np.asarray(cv2.GaussianBlur(sharp, (0, 0), width / 64), np.uint8)
    assert sharpness(blurred) < 0.8 * sharpness(sharp)


@pytest.mark.parametrize(
    ("frames", "content", "problem"),
    [
        (None, {}, "makes 0 photographs"),
        (2, {f"{index}.png": b"" for index in range(5)}, "makes 2 photographs"),
        (None, {f"{index}.png": b"" for index in range(2001)}, "makes 2,001 photographs"),
        (None, {f"{index}.jpg": b"no image" for index in range(5)}, "0.jpg"),
    ],
)
def test_unusable_folders_are_refused(
    tmp_path: Path, frames: int | None, content: dict[str, bytes], problem: str
) -> None:
    for name, data in content.items():
        (tmp_path / name).write_bytes(data)
    (tmp_path / "out").mkdir()
    with pytest.raises(InputError, match=problem) as caught:
        collect_photographs(tmp_path, tmp_path / "out", frames, ignore)
    assert caught.value.hint


def test_a_file_that_is_no_video_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"no video")
    with pytest.raises(LogError, match="is no video") as caught:
        collect_photographs(tmp_path / "a.mp4", tmp_path, None, ignore)
    assert caught.value.file == str(tmp_path / "a.mp4")


def test_a_video_that_ends_before_its_stated_length_is_named_in_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_video(tmp_path / "a.avi", blurred=set())
    (tmp_path / "out").mkdir()
    assert len(collect_photographs(tmp_path / "a.avi", tmp_path / "out", 10, ignore)) == 10
    assert not caplog.text
    whole = (tmp_path / "a.avi").read_bytes()
    (tmp_path / "a.avi").write_bytes(whole[: len(whole) // 2])
    assert len(collect_photographs(tmp_path / "a.avi", tmp_path / "out", 10, ignore)) in (5, 6)
    assert re.search(r"a\.avi: only 1\d of the stated 30 frames can be decoded", caplog.text)


def test_frames_beyond_the_stated_length_do_not_add_photographs(tmp_path: Path) -> None:
    write_video(tmp_path / "a.avi", blurred=set(range(30)) - {1, 3, 6})
    content = bytearray((tmp_path / "a.avi").read_bytes())
    length = content.index(b"strh") + 8 + 32  # dwLength of AVISTREAMHEADER
    assert content[length : length + 4] == (30).to_bytes(4, "little")
    content[length : length + 4] = (6).to_bytes(4, "little")
    (tmp_path / "a.avi").write_bytes(content)
    (tmp_path / "out").mkdir()
    names = collect_photographs(tmp_path / "a.avi", tmp_path / "out", 3, ignore)
    assert names == ["frame_000001.jpg", "frame_000003.jpg", "frame_000006.jpg"]  # OpenCV decodes 7 of them


def test_a_damaged_photograph_is_refused_before_colmap_runs(tmp_path: Path, images: Path) -> None:
    content = (images / "3.png").read_bytes()
    (images / "3.png").write_bytes(content[: len(content) // 2])  # its header is whole
    (tmp_path / "out").mkdir()
    with pytest.raises(LogError, match=r"3\.png"):
        collect_photographs(images, tmp_path / "out", None, ignore)


def test_hidden_files_are_skipped_and_images_of_other_formats_are_counted(
    tmp_path: Path, images: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("._0.png", "IMG_1.HEIC", "b.webp", "notes.txt"):
        (images / name).write_bytes(b"no image")
    (tmp_path / "out").mkdir()
    assert len(collect_photographs(images, tmp_path / "out", None, ignore)) == 5
    assert "2 images of other formats are left out" in caplog.text


def test_a_name_that_is_not_utf_8_is_refused(tmp_path: Path, images: Path) -> None:
    (images / "0.png").rename(images / os.fsdecode(b"caf\xe9.png"))
    (tmp_path / "out").mkdir()
    with pytest.raises(InputError, match="not UTF-8") as caught:
        collect_photographs(images, tmp_path / "out", None, ignore)
    assert str(caught.value).encode()


def test_a_video_with_the_name_of_an_address_is_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = cv2.VideoWriter(str(tmp_path / "a.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10, (64, 48))
    for index in range(6):
        writer.write(np.full((48, 64, 3), 20 * index, np.uint8))
    writer.release()
    (tmp_path / "a.mp4").rename(tmp_path / "data:a.mp4")
    (tmp_path / "out").mkdir()
    monkeypatch.chdir(tmp_path)
    assert not cv2.VideoCapture("data:a.mp4").isOpened()
    assert len(collect_photographs(Path("data:a.mp4"), tmp_path / "out", 3, ignore)) == 3
