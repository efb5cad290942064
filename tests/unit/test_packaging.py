"""One namespace: everything is imported as splatbot.*, from a checkout, a wheel and an sdist alike."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

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
    """A folder with an sdist of this checkout and the wheel built from that sdist, without optimization."""
    out = tmp_path_factory.mktemp("dist")
    options = ("--no-isolation", "--config-setting=cmake.build-type=Debug", "--outdir", str(out))
    _run(sys.executable, "-m", "build", *options, str(ROOT))
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
