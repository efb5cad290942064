"""One namespace: everything is imported as splatbot.*, from a checkout, a wheel and an sdist alike."""

from __future__ import annotations

import ast
import email
import os
import re
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from pathlib import Path

import pytest

import splatbot
from tests.container import copy_build_context

ROOT = Path(__file__).parents[2]
LINKED = ("services", "robots", "sim", "configs")
FOLDERS = ("splatbot", *LINKED, "tests", "experiments")


def _imports(path: Path) -> set[str]:
    """Return the top-level names that a file imports."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module.split(".")[0])
    return names


def test_no_file_imports_a_top_level_folder_under_its_generic_name() -> None:
    """`import sim` would load a second copy of splatbot.sim with its own singletons."""
    files = {path.resolve() for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")}
    assert len(files) > 20
    assert {str(path): bad for path in files if (bad := _imports(path) & set(LINKED))} == {}


@pytest.mark.parametrize("name", LINKED)
def test_a_top_level_folder_is_part_of_the_namespace_by_a_relative_link(name: str) -> None:
    link = ROOT / "splatbot" / name
    assert link.is_symlink()
    assert os.readlink(link) == f"../{name}"  # noqa: PTH115 - the text of the link is what is tested
    assert (link / "__init__.py").is_file()


def test_every_module_of_the_core_is_under_the_contract_on_external_packages() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = {c["id"]: c for c in settings["tool"]["importlinter"]["contracts"]}
    outside = {"cli", "services", "robots", "sim", "configs", "native", "__main__", "__init__", "__pycache__"}
    entries = [p for p in (ROOT / "splatbot").iterdir() if p.is_dir() or p.suffix == ".py"]
    core = {f"splatbot.{p.stem}" for p in entries if p.stem not in outside}
    assert set(contracts["core-externals"]["source_modules"]) == core


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an sdist of the files that the image's builder copies, and the wheel built from that sdist.

    The wheel is compiled with little optimization.
    """
    out, context = tmp_path_factory.mktemp("dist"), tmp_path_factory.mktemp("context")
    copy_build_context(context)
    quick = ("cmake.build-type=Debug", "cmake.define.CMAKE_CXX_FLAGS_DEBUG=-O1")
    options = ("--no-isolation", *(f"--config-setting={option}" for option in quick), "--outdir", str(out))
    _run(sys.executable, "-m", "build", *options, str(context))
    return out


def _run(*command: str, cwd: Path | None = None, env: dict[str, str] | None = None) -> str:
    done = subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True)
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    return done.stdout


@pytest.mark.long
@pytest.mark.alone
def test_the_wheel_that_is_built_from_the_sdist_is_whole_when_installed(built: Path, tmp_path: Path) -> None:
    """`pip install` of the sdist builds the same wheel; a second compilation would take minutes."""
    (archive,) = built.glob("*.whl")
    assert len(list(built.glob("*.tar.gz"))) == 1
    target = tmp_path / "site"
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--no-deps", "--no-build-isolation")
    _run(*pip, "--no-index", "--target", str(target), str(archive), cwd=tmp_path)
    code = (
        "import sys; sys.meta_path[:] = [f for f in sys.meta_path if 'Editable' not in type(f).__name__"
        " and 'ScikitBuild' not in type(f).__name__]; sys.path.insert(0, sys.argv[1])\n"
        "import importlib, splatbot\n"
        "for name in ('services', 'sim', 'robots', 'configs', '_native', '_bench_native'):\n"
        "    print(importlib.import_module(f'splatbot.{name}').__file__)\n"
        "from importlib.resources import files\n"
        "print(files('splatbot.configs') / 'default.yaml')"
    )
    environ = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    places = _run(sys.executable, "-c", code, str(target), cwd=tmp_path, env=environ).split()
    assert len(places) == 7
    assert all(place.startswith(str(target)) and Path(place).is_file() for place in places), places
    assert not (target / "splatbot" / "native").exists(), "C++ sources belong into the sdist alone"
    assert not any((target / name).exists() for name in LINKED), "a generic top-level name landed in site-packages"


@pytest.fixture(scope="module")
def bare(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The programs of a new environment with the wheel, which finds its dependencies in the one of this test.

    A line of a .pth file adds a folder to the path without the .pth files in it, so that this checkout is not found.
    """
    folder = tmp_path_factory.mktemp("bare")
    _run(sys.executable, "-m", "venv", "--without-pip", str(folder))
    (site,) = folder.glob("lib/python*/site-packages")
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    (archive,) = built.glob("*.whl")
    pip = (sys.executable, "-m", "pip", f"--python={folder / 'bin' / 'python'}", "--disable-pip-version-check")
    _run(*pip, "install", "--no-deps", "--no-index", "--ignore-installed", str(archive), cwd=folder)
    return folder / "bin"


@pytest.mark.long
@pytest.mark.alone
def test_the_wheel_states_its_version_its_extras_and_its_types(built: Path) -> None:
    (archive,) = built.glob("*.whl")
    with zipfile.ZipFile(archive) as wheel:
        names = wheel.namelist()
        (about,) = [name for name in names if name.endswith(".dist-info/METADATA")]
        metadata = email.message_from_bytes(wheel.read(about))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert metadata["Version"] == project["version"]
    assert set(metadata.get_all("Provides-Extra", [])) == set(project["optional-dependencies"])
    assert "splatbot/py.typed" in names


@pytest.mark.long
@pytest.mark.alone
def test_the_wheel_maps_a_log_and_runs_the_demo_without_the_checkout(bare: Path, tmp_path: Path) -> None:
    environ = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}

    def run(*words: str) -> str:
        return _run(str(bare / "splatbot"), *words, cwd=tmp_path, env=environ)

    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert run("--version").strip() == version
    place = _run(
        str(bare / "python"), "-c", "import splatbot._native as n; print(n.__file__)", cwd=tmp_path, env=environ
    )
    assert place.startswith(str(bare.parent))
    run("map", "synthetic:tabletop?frames=6&width=160&height=120&arc=4", "--out", "run")
    assert (tmp_path / "run" / "map.ply").stat().st_size > 10_000
    run("demo", "--frames", "6", "--out", "demo")
    assert (tmp_path / "demo" / "report.html").is_file()


def test_the_version_is_stated_in_one_place() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert splatbot.__version__ == version
    assert not re.search(rf'"{re.escape(version)}"', (ROOT / "splatbot" / "__init__.py").read_text(encoding="utf-8"))
