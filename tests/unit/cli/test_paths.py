"""Wrong paths: refused in words before the libraries load and before anything is written."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from splatbot.cli import main
from splatbot.cli.paths import result_folder, system_error, written_to
from splatbot.errors import FormatError, InputError, LogError
from splatbot.layouts import is_map, log_kind, map_file
from tests.unit.cli.conftest import RunCommand, assert_refused

HEAVY = ("torch", "open3d", "cv2", "matplotlib", "mujoco", "fastapi", "numpy", "rosbags")


WRONG = [
    ["map", "{no}", "--out", "{out}"],
    ["map", "{no}.mcap", "--out", "{out}"],
    ["map", "{zip}", "--out", "{out}"],
    ["map", "{log}", "--out", "{file}"],
    ["map", "{log}", "--camera", "{no}.json", "--out", "{out}"],
    ["map", "--resume", "{no}", "--out", "{out}"],
    ["map", "{log}", "--localise", "{no}", "--out", "{out}"],
    ["map", "{log}", "--config", "{no}", "--out", "{out}"],
    ["eval", "{no}"],
    ["render", "{no}", "--out", "{out}"],
    ["render", "{log}", "--out", "{out}"],
    ["info", "{no}"],
    ["simulate", "tabletop", "--out", "{file}/in/it"],
    ["record", "{no}", "--out", "{out}"],
    ["record", "{log}", "--out", "{file}"],
    ["serve", "--map", "{no}"],
    ["serve", "--log", "{no}"],
    ["view", "{no}"],
    ["plan", "--map", "{no}", "--start", "home", "--goal", "home", "--out", "{out}"],
    ["grasp", "--map", "{no}", "--target", "box", "--out", "{out}"],
    ["twin", "--map", "{no}", "--json", "{out}"],
    ["sim2real", "{no}", "--map", "{no}", "--out", "{out}"],
    ["audit", "{no}"],
    ["audit", "{run}/map.ply"],
    ["audit", "{training}"],
    ["audit", "{run}", "--log", "{no}"],
    ["eval", "{file}"],
    ["merge", "{run}", "{training}", "--out", "{out}"],
    ["merge", "{no}", "{run}", "--out", "{out}"],
    ["diff", "{training}", "{run}"],
    ["map", "--resume", "{training}"],
    ["map", "{log}", "--localise", "{training}", "--out", "{out}"],
    ["sim2real", "{log}", "--map", "{training}", "--out", "{out}"],
    ["train", "{no}"],
    ["train", "{training}"],
    ["train", "{run}", "--log", "{no}"],
    ["train", "--resume", "{run}"],
    ["objects", "{no}"],
    ["objects", "{picture}"],
    ["objects", "{training}/training.json"],
    ["info", "{picture}"],
    ["compare", "{no}", "{no}"],
    ["export", "{no}"],
    ["convert", "{no}", "{out}.ply"],
    ["compact", "{no}"],
    ["tile", "{no}", "--out", "{out}"],
    ["plan-pick", "--map", "{no}", "--grasp", "{no}"],
    ["convert-log", "{no}", "{out}"],
    ["prepare", "{no}", "--out", "{out}"],
    ["calibrate", "sensor", "{no}"],
    ["calibrate", "intrinsics", "{no}", "--board", "charuco:10x14:0.07:0.04"],
    ["calibrate", "hand-eye", "{no}", "--robot", "panda"],
    ["calibrate", "joint-delay", "{no}", "--robot", "panda"],
    ["bench", "sizing", "--costs", "{no}", "--out", "{out}"],
    ["bench", "sizing", "--costs", "{training}/training.json", "--out", "{out}"],
]
"""Commands with a wrong path."""

PROGRAM = """
import contextlib, io, json, sys
from splatbot.cli import main

for words in json.loads(sys.argv[1]):
    with contextlib.redirect_stderr(io.StringIO()) as errors:
        code = main(words)
    heavy = [name for name in sys.argv[2:] if name in sys.modules]
    print(json.dumps({"words": words, "code": code, "heavy": heavy, "errors": errors.getvalue()}))
"""


def test_each_wrong_path_is_refused_before_libraries_load_and_folders_appear(
    tmp_path: Path, make_names: dict[str, str]
) -> None:
    given = [[word.format(**make_names) for word in words] for words in WRONG]
    before = sorted(tmp_path.rglob("*"))
    words = [sys.executable, "-c", PROGRAM, json.dumps(given), *HEAVY]
    answer = subprocess.run(words, capture_output=True, text=True, check=True, timeout=300)
    refusals = [json.loads(line) for line in answer.stdout.splitlines()]
    assert [refusal["words"] for refusal in refusals] == given
    for refusal in refusals:
        assert (refusal["code"], refusal["heavy"]) == (2, []), refusal
        assert refusal["errors"].startswith("error: "), refusal
        assert " Fix: " in refusal["errors"], refusal
    assert sorted(tmp_path.rglob("*")) == before


@pytest.fixture
def make_names(tmp_path: Path) -> dict[str, str]:
    """Paths that are wrong in one way each, next to the names of a log."""
    log = tmp_path / "log"
    log.mkdir()
    (log / "rgb.txt").touch()
    for name in ("recording.zip", "file", "first.png"):
        (tmp_path / name).touch()
    for name in ("map.ply", "trajectory.tum", "config.yaml", "metrics.json", "state/run.state"):
        (tmp_path / "run" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "run" / name).touch()
    training = tmp_path / "training"
    training.mkdir()
    for name in ("map.ply", "trajectory.tum"):
        (training / name).touch()
    (training / "training.json").write_text(json.dumps({"dataset": str(tmp_path / "run")}))
    names = {"no": "missing", "log": "log", "zip": "recording.zip", "file": "file", "out": "out"}
    names |= {"run": "run", "training": "training", "picture": "first.png"}
    return {key: str(tmp_path / name) for key, name in names.items()}


@pytest.mark.parametrize(
    "words",
    [
        ["merge", "{run}", "{training}", "--out", "{out}"],
        ["diff", "{training}", "{run}"],
        ["audit", "{training}"],
        ["map", "--resume", "{training}"],
        ["train", "{training}"],
    ],
)
def test_a_training_in_place_of_a_run_is_named_with_its_run_and_no_advice_replaces_it(
    run: RunCommand, make_names: dict[str, str], words: list[str]
) -> None:
    answer = run(*(word.format(**make_names) for word in words))
    assert_refused(answer, "is a training")
    assert f"give the run of its log: {make_names['run']};" in answer.err
    assert "--overwrite" not in answer.err


@pytest.mark.parametrize(
    ("name", "words"), [("a.png", "a picture, no map"), ("a.mcap", "a recording, no map"), ("a.yaml", "no map")]
)
def test_a_file_that_is_no_map_is_named(run: RunCommand, tmp_path: Path, name: str, words: str) -> None:
    (tmp_path / name).touch()
    assert_refused(run("objects", tmp_path / name), f"is {words}. Fix: ")


@pytest.mark.parametrize(
    ("name", "what", "fix"),
    [
        ("a.zip", "ZIP archive", "unzip"),
        ("a.tar.gz", "gzip file", "tar xf"),
        ("a.tgz", "tar archive", "tar xf"),
        ("a.7z", "7-Zip", "7z x"),
        ("a.mkv", "Azure Kinect", "AzureKinectMKVReader"),
        ("a.svo", "ZED", "ZED_SVO_Export"),
        ("a.klg", "ElasticFusion", "16-bit PNG"),
        ("a.oni", "OpenNI", "OpenNI2"),
        ("a.db3", "rosbag2", "metadata.yaml"),
        ("a.mp4", "without depth", "RGB-D"),
        ("a.ply", "map or a point cloud", "splatbot info"),
        ("a.xyz", "no known kind", "known folders"),
    ],
)
def test_a_file_that_is_no_log_is_named_with_the_way_to_convert_it(
    tmp_path: Path, name: str, what: str, fix: str
) -> None:
    (tmp_path / name).touch()
    with pytest.raises(LogError, match=what) as refused:
        log_kind(tmp_path / name)
    assert fix in str(refused.value)


@pytest.mark.parametrize(
    ("inside", "what"),
    [
        ("transforms.json", "Nerfstudio"),
        ("sparse/0/", "COLMAP"),
        ("a_0.mcap", "rosbag2 without metadata"),
        ("map.ply", "folder of a run"),
        ("desk/rgb.txt", "desk"),
    ],
)
def test_a_folder_that_is_no_log_is_named(tmp_path: Path, inside: str, what: str) -> None:
    path = tmp_path / inside
    if inside.endswith("/"):
        path.mkdir(parents=True)
    else:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    with pytest.raises(LogError) as refused:
        log_kind(tmp_path)
    assert what in str(refused.value)


@pytest.mark.parametrize(
    ("inside", "kind"),
    [
        ("rgb.txt", "tum"),
        ("frame-000000.color.png", "7scenes"),
        ("color/0.jpg depth/0.png", "images"),
        ('transforms.json:{"frames": [{"depth_file_path": "d"}]}', "transforms"),
        ("results/frame000000.jpg traj.txt", "replica"),
        ("metadata.yaml", "bag"),
    ],
)
def test_a_folder_is_recognized_by_its_names(tmp_path: Path, inside: str, kind: str) -> None:
    name, _, content = inside.partition(":")
    for place in map(tmp_path.joinpath, name.split()):
        place.parent.mkdir(exist_ok=True)
        place.write_text(content)
    assert log_kind(tmp_path) == kind


@pytest.mark.parametrize(
    ("name", "kind"), [("a.sens", "scannet"), ("A.R3D", "record3d"), ("a.mcap", "bag"), ("a.bag?color=/c", "bag")]
)
def test_a_file_is_recognized_by_its_suffix(tmp_path: Path, name: str, kind: str) -> None:
    (tmp_path / name.partition("?")[0]).touch()
    assert log_kind(tmp_path / name) == kind


@pytest.mark.parametrize(
    ("name", "fix"),
    [
        ("a.stl", r"\.spz, \.sbz, \.sog, \.glb, \.usd"),
        ("a.gltf", r"one \.glb"),
        ("a.obj", r"\.glb"),
    ],
)
def test_a_map_of_another_format_is_named_with_the_way_to_convert_it(tmp_path: Path, name: str, fix: str) -> None:
    (tmp_path / name).touch()
    assert is_map(tmp_path / name)
    with pytest.raises(FormatError, match=rf"Fix: .*{fix}"):
        map_file(tmp_path / name)


def test_the_folder_of_a_sog_is_a_map_and_no_recording(tmp_path: Path) -> None:
    (tmp_path / "meta.json").touch()
    assert not is_map(tmp_path)
    (tmp_path / "sh0.webp").touch()
    assert is_map(tmp_path)
    assert map_file(tmp_path) == tmp_path / "meta.json"
    with pytest.raises(LogError, match="is a SOG map"):
        log_kind(tmp_path)


@pytest.mark.parametrize("name", ["a.ply", "a.spz", "a.splat", "a.ksplat", "a.sog", "a.glb"])
def test_a_map_given_as_a_recording_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    with pytest.raises(LogError, match="splatbot info"):
        log_kind(tmp_path / name)


def test_a_recording_given_as_a_map_says_how_to_map_it(tmp_path: Path) -> None:
    (tmp_path / "rgb.txt").touch()
    with pytest.raises(FormatError, match="splatbot map"):
        map_file(tmp_path)


def test_map_refuses_a_finished_run_without_overwrite(run: RunCommand, run_folder: Path, log_folder: Path) -> None:
    before = {path: path.read_bytes() for path in run_folder.rglob("*") if path.is_file()}
    answer = run("map", log_folder, "--out", run_folder, "--quiet")
    assert_refused(answer, "holds a run already")
    assert "--overwrite" in answer.err
    assert {path: path.read_bytes() for path in run_folder.rglob("*") if path.is_file()} == before
    assert run("map", log_folder, "--out", run_folder, "--quiet", "--overwrite").code == 0


def test_resume_before_the_first_save_says_what_happened(run: RunCommand, tmp_path: Path) -> None:
    (tmp_path / "killed").mkdir()
    answer = run("map", "--resume", tmp_path / "killed")
    assert_refused(answer, "ended before its first save")
    assert "splatbot map LOG" in answer.err


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc, which takes no files, not even of root")
@pytest.mark.parametrize("words", [["map", "{log}", "--out", "/proc/x"], ["record", "{log}", "--out", "/proc/x.mcap"]])
def test_a_place_that_takes_no_files_cannot_be_created(
    run: RunCommand, make_names: dict[str, str], words: list[str]
) -> None:
    answer = run(*(word.format(**make_names) for word in words))
    assert_refused(answer, f"{words[-1]}: --out: cannot be created. Fix: name a place outside /proc")
    assert "removed" not in answer.err


def test_info_opens_a_recording_in_one_file(run: RunCommand, log_folder: Path, tmp_path: Path) -> None:
    assert run("record", log_folder, "--out", tmp_path / "a.mcap").code == 0
    answer = run("info", tmp_path / "a.mcap")
    assert answer.code == 0, answer.err
    assert "frames" in answer.out


@pytest.mark.parametrize(
    ("code", "words"), [(28, "no space left"), (30, "read-only"), (13, "permission denied"), (116, "stale")]
)
def test_an_error_of_the_disk_is_a_sentence_and_exit_1(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, code: int, words: str
) -> None:
    import os

    def broken() -> None:
        raise OSError(code, os.strerror(code), "/data/map.ply")

    monkeypatch.setattr("splatbot.cli.checks.all_checks", broken)
    assert main(["doctor"]) == 1
    told = capsys.readouterr().err
    assert told.startswith("error: /data/map.ply: ")
    assert words in told
    assert "Fix: " in told


def test_an_error_that_is_none_of_the_disk_is_a_bug() -> None:
    assert system_error(OSError(11, "busy")) is None
    assert system_error(ConnectionResetError(104, "reset")) is None


def test_results_in_the_default_folder_are_replaced_and_named_ones_are_kept(work_folder: Path) -> None:
    folder = Path("runs/grasp")
    assert result_folder(None, "grasp", "grasp.json", overwrite=False) == (folder, False)
    assert not folder.exists()
    for named in (folder, Path("mine")):
        named.mkdir(parents=True)
        (named / "grasp.png").touch()
    assert result_folder(None, "grasp", "grasp.json", "grasp.png", overwrite=False) == (folder, True)
    assert written_to(*result_folder(None, "grasp", "grasp.png", overwrite=False)) == (
        "runs/grasp, in place of earlier results"
    )
    for named in (folder, Path("mine")):  # the default folder is named, too, if --out gives it
        with pytest.raises(InputError, match=r"holds earlier results \(grasp.png\).*--overwrite"):
            result_folder(named, "grasp", "grasp.json", "grasp.png", overwrite=False)
        assert result_folder(named, "grasp", "grasp.json", "grasp.png", overwrite=True) == (named, True)
        assert result_folder(named, "grasp", "grasp.json", overwrite=False) == (named, False)  # of another command


@pytest.mark.parametrize(
    ("words", "file"),
    [
        (("grasp", "--map", "map.ply", "--target", "box"), "grasp.json"),
        (("plan-pick", "--map", "map.ply", "--grasp", "grasp.json"), "pick.json"),
        (("plan-pick", "--map", "map.ply", "--grasp", "grasp.json"), "pick.html"),
        (("pick", "tabletop_clutter", "--target", "can"), "pick.json"),
    ],
)
def test_results_in_a_named_folder_are_kept_before_the_libraries_load(
    words: tuple[str, ...], file: str, work_folder: Path
) -> None:
    (work_folder / "map.ply").write_bytes(b"ply\n")
    (work_folder / "grasp.json").write_text('{"robot": "panda"}')
    (work_folder / "kept").mkdir()
    (work_folder / "kept" / file).write_text("of an earlier call")
    program = (
        "import sys; from splatbot.cli import main; code = main(sys.argv[1:]); "
        "sys.exit(code if 'torch' not in sys.modules and 'mujoco' not in sys.modules else 99)"
    )
    command = [sys.executable, "-c", program, *words, "--out", "kept"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=work_folder)
    assert done.returncode == 2, done.stderr
    assert f"kept: --out: holds earlier results ({file})" in done.stderr
    assert "--overwrite" in done.stderr
    assert (work_folder / "kept" / file).read_text() == "of an earlier call"
