"""The line that shows at a terminal while libraries are imported."""

from __future__ import annotations

import importlib
import io
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from splatbot.cli.loading import ERASE, imports_shown, without_line
from tests.terminal import at_a_terminal
from tests.unit.grasping.objects import model

_LINE = "loading ..."


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def slow_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A package ``slow_library`` that imports its module ``part``, one more, and one that fails."""
    package = tmp_path / "slow_library"
    package.mkdir()
    (package / "__init__.py").write_text("import json\nfrom slow_library import part\n")
    (package / "part.py").write_text("value = 3\n")
    (tmp_path / "other_library.py").touch()
    (tmp_path / "broken_library.py").write_text("raise ImportError('no such instruction')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    for name in [name for name in sys.modules if name.startswith(("slow_library", "other_library", "broken_"))]:
        del sys.modules[name]


@pytest.mark.usefixtures("slow_library")
def test_an_import_shows_one_line_and_removes_it() -> None:
    stream, before = _Terminal(), list(sys.meta_path)
    with imports_shown(stream):
        library = importlib.import_module("slow_library")
        assert importlib.import_module("slow_library") is library  # from the cache, which takes no time
    assert stream.getvalue() == (_LINE + ERASE) * 2  # finding and creating it, and its code with the part
    assert library.part.value == 3
    assert sys.meta_path == before


@pytest.mark.usefixtures("slow_library")
def test_a_command_in_a_command_imports_too() -> None:
    with imports_shown(_Terminal()), imports_shown(_Terminal()):
        assert importlib.import_module("slow_library").part.value == 3


@pytest.mark.usefixtures("slow_library")
def test_a_module_has_its_own_loader_afterwards() -> None:
    with imports_shown(_Terminal()):
        library = importlib.import_module("slow_library")
    importlib.reload(library)
    for module in (library, library.part):
        assert module.__spec__ is not None
        assert module.__spec__.loader is module.__loader__
        assert type(module.__loader__).__name__ == "SourceFileLoader"


@pytest.mark.usefixtures("slow_library")
def test_an_import_that_fails_leaves_no_line() -> None:
    stream = _Terminal()
    with pytest.raises(ImportError, match="no such instruction"), imports_shown(stream):
        importlib.import_module("broken_library")
    assert stream.getvalue().endswith(ERASE)
    with pytest.raises(ModuleNotFoundError), imports_shown(stream):
        importlib.import_module("no_library_of_this_name")


@pytest.mark.usefixtures("slow_library")
def test_a_file_and_other_threads_get_no_line() -> None:
    file, terminal = io.StringIO(), _Terminal()
    with imports_shown(file):
        importlib.import_module("slow_library.part")
    with imports_shown(terminal):
        worker = threading.Thread(target=importlib.import_module, args=("other_library",))
        worker.start()
        worker.join()
    assert (file.getvalue(), terminal.getvalue()) == ("", "")


@pytest.mark.usefixtures("slow_library")
def test_a_live_display_keeps_its_line() -> None:
    stream = _Terminal()
    with imports_shown(stream):
        with without_line():
            importlib.import_module("slow_library")
        assert stream.getvalue() == ""
        importlib.import_module("other_library")
    assert stream.getvalue().startswith(_LINE)


def test_a_command_at_a_terminal_says_that_it_loads_before_its_first_step(tmp_path: Path) -> None:
    model().save(tmp_path / "map.ply")
    shown = at_a_terminal("render", str(tmp_path / "map.ply"), "--size", "16x16", columns=80, cwd=tmp_path)
    assert shown.code == 0, shown.text
    assert shown.text.index(_LINE) < shown.text.index("map-rgb.png")
    assert shown.text.rstrip().splitlines()[-1].split("\r")[-1] == "map-rgb.png"  # the line is gone


def test_ctrl_c_while_a_library_loads_ends_with_one_line(tmp_path: Path) -> None:
    model().save(tmp_path / "map.ply")
    shown = at_a_terminal("render", str(tmp_path / "map.ply"), columns=80, cwd=tmp_path, interrupt_at=_LINE)
    assert shown.code == 130, shown.text
    assert "Traceback" not in shown.text
    assert shown.text.rstrip().splitlines()[-1].split("\r")[-1].strip() == "interrupted"
