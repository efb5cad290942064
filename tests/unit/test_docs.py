"""Documents: their links lead to files, they name tests and targets that exist, and they stay short."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from splatbot.bench.benchmark import BENCHMARKS
from splatbot.cli import COMMANDS

ROOT = Path(__file__).parents[2]
DOCUMENTS = ["README.md", "ARCHITECTURE.md", "CHANGELOG.md", "experiments/README.md"]
DOCUMENTS += [str(path.relative_to(ROOT)) for path in sorted((ROOT / "docs").rglob("*.md"))]
GUIDES = [name for name in DOCUMENTS if name.startswith("docs/guide/")]
LINK = re.compile(r"\]\((?!https?:)([^)#\s]*)(?:#([^)\s]+))?\)")


def anchors(document: Path) -> set[str]:
    """Return the anchors of the headings of a document, as GitHub builds them."""
    text = re.sub(r"^```.*?^```", "", document.read_text(encoding="utf-8"), flags=re.S | re.M)
    headings = re.findall(r"^#+ (.*)$", text, flags=re.M)
    return {re.sub(r"[^\w\- ]", "", heading).strip().lower().replace(" ", "-") for heading in headings}


def broken(document: Path) -> list[str]:
    """Return the relative links of a document whose file or heading does not exist."""
    found = []
    for link, anchor in LINK.findall(document.read_text(encoding="utf-8")):
        target = document.parent / link if link else document
        if not target.exists() or (anchor and target.suffix == ".md" and anchor not in anchors(target)):
            found.append(f"{link}#{anchor}" if anchor else link)
    return found


@pytest.mark.parametrize("name", DOCUMENTS)
def test_every_relative_link_leads_somewhere(name: str) -> None:
    assert broken(ROOT / name) == []


def test_a_link_to_a_missing_file_or_heading_is_found(tmp_path: Path) -> None:
    (tmp_path / "other.md").write_text("# A heading: with `code`\n", encoding="utf-8")
    document = tmp_path / "a.md"
    document.write_text(
        "[ok](other.md#a-heading-with-code) [no](other.md#another) [gone](gone.md) [web](https://example.org)",
        encoding="utf-8",
    )
    assert broken(document) == ["other.md#another", "gone.md"]


def test_every_test_that_the_stability_catalogue_names_exists() -> None:
    named = set(re.findall(r"`(test_\w+)`", (ROOT / "docs" / "stability.md").read_text(encoding="utf-8")))
    written = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    assert len(named) >= 5
    assert {name for name in named if f"def {name}(" not in written} == set()


def test_every_make_target_of_the_readme_exists() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE))
    named = set(re.findall(r"`make ([a-z-]+)`", (ROOT / "README.md").read_text(encoding="utf-8")))
    assert {"demo", "check"} <= named | targets
    assert named <= targets


def test_every_file_of_the_repository_that_a_document_names_exists() -> None:
    folders = "splatbot|services|sim|robots|configs|tests|docs|docker|examples|experiments"
    named = re.compile(rf"`((?:{folders})/[\w./-]+)`")
    missing = {
        f"{name}: {path}"
        for name in DOCUMENTS
        if name != "CHANGELOG.md"
        for path in named.findall((ROOT / name).read_text(encoding="utf-8"))
        if "my_" not in path and not (ROOT / path).exists()
    }
    assert missing == set()


def test_every_command_that_a_document_shows_exists() -> None:
    commands = set(COMMANDS) | {f"bench {name}" for name in BENCHMARKS} | {"bench", "calibrate"}
    shown = re.compile(r"^(?:\w+=\S+ )*splatbot ((?:bench )?[a-z]\w*)", flags=re.M)
    missing = set()
    for name in DOCUMENTS:
        text = (ROOT / name).read_text(encoding="utf-8")
        spans = [*re.findall(r"`([^`\n]+)`", text), *re.findall(r"^```\w*\n(.*?)^```", text, flags=re.S | re.M)]
        found = {command for span in spans for command in shown.findall(span)}
        missing |= {f"{name}: splatbot {command}" for command in found - commands if command != "bench my"}
    assert missing == set()


def test_the_architecture_fits_into_8_kb() -> None:
    assert (ROOT / "ARCHITECTURE.md").stat().st_size <= 8192


@pytest.mark.parametrize("name", GUIDES)
def test_a_guide_fits_into_6_kb(name: str) -> None:
    assert (ROOT / name).stat().st_size <= 6144


def test_there_are_guides_experiments_and_decisions() -> None:
    assert len(GUIDES) >= 10
    assert (ROOT / "docs" / "decisions.md").exists()
    assert len(list((ROOT / "docs" / "experiments").glob("*.md"))) >= 8


def test_the_licence_is_whole() -> None:
    text = (ROOT / "LICENSE").read_text(encoding="utf-8")
    assert "Apache License" in text
    assert "END OF TERMS AND CONDITIONS" in text
