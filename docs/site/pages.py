"""Hook of MkDocs: pages of the site that are no files of docs/, and the links that lead to them.

README.md is the first page. A source that a page links is shown under ``source/``. ``reference/index.md`` lists the
public names of the package. Each entry ``reference/MODULE.md`` of the navigation holds the docstrings of that module.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

import splatbot

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
_LINK = re.compile(r"(?<=\]\()(?!https?:)([^)#\s]+)")
_CELL = re.compile(r"<td.*?</td>", re.DOTALL)
_ROLE = re.compile(r":\w+:(?=<code>)")
_LANGUAGES = {".py": "python", ".yaml": "yaml"}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add README, the sources that pages link, and the pages of the reference."""
    waiting = [ROOT / "README.md"]
    waiting += [Path(file.abs_src_path) for file in files.documentation_pages() if file.abs_src_path]
    while waiting:
        path = waiting.pop()
        if not path.is_relative_to(DOCS):
            files.append(_page(path, config))
        if path.suffix == ".md":
            targets = {target for _, target in _targets(path.read_text("utf-8"), path)}
            waiting += [x for x in targets if not x.is_relative_to(DOCS) and x not in waiting and not _has(files, x)]
    names = "\n".join(f"- [`{name}`][{_identifier(module, name)}]" for name, module in splatbot._HOME.items())
    files.append(File.generated(config, "reference/index.md", content=f"# Public names of splatbot\n\n{names}\n"))
    for uri in filter(re.compile(r"reference/splatbot\.").match, _entries(config.nav)):
        module = uri.removeprefix("reference/").removesuffix(".md")
        files.append(File.generated(config, uri, content=_reference(module)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Point each link of a page at the page of its target."""
    source = page.file.abs_src_path
    if source is None:
        return markdown
    start = posixpath.dirname(page.file.src_uri)
    for link, target in sorted(set(_targets(markdown, Path(source)))):
        new = posixpath.relpath(_uri(target), start)
        markdown = re.sub(rf"(?<=\]\(){re.escape(link)}(?=[)#])", new, markdown)
    return markdown


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Remove roles of reStructuredText, second colons before literal blocks, and escapes of bars in tables."""
    html = _ROLE.sub("", html).replace("::</p>", ":</p>")
    return _CELL.sub(lambda cell: cell[0].replace(r"\|", "|"), html)


def _targets(markdown: str, source: Path) -> Iterator[tuple[str, Path]]:
    """Yield each link of a document to a file or folder of the repository, with its path."""
    for link in _LINK.findall(markdown):
        target = (source.parent / link).resolve()
        if target.exists() and target.is_relative_to(ROOT):
            yield link, target


def _uri(path: Path) -> str:
    """Return the page, relative to docs/, that shows a file or folder of the repository."""
    if path == ROOT / "README.md":
        return "index.md"
    if path.is_relative_to(DOCS):
        return (path / "README.md" if path.is_dir() else path).relative_to(DOCS).as_posix()
    uri = f"source/{path.relative_to(ROOT).as_posix()}"
    return uri if path.suffix == ".md" else f"{uri}/index.md" if path.is_dir() else f"{uri}.md"


def _has(files: Files, path: Path) -> bool:
    return files.get_file_from_path(_uri(path)) is not None


def _page(path: Path, config: MkDocsConfig) -> File:
    """Return the page of a file or folder outside of docs/: Markdown as it is, other text and Python files as code."""
    if path.suffix == ".md":
        return File.generated(config, _uri(path), abs_src_path=str(path))
    if path.is_dir():
        shown = "\n\n".join(f"## {child.name}\n\n{_code(child)}" for child in sorted(path.glob("*.py")))
    else:
        shown = _code(path)
    return File.generated(config, _uri(path), content=f"# {path.relative_to(ROOT)}\n\n{shown}\n")


def _code(path: Path) -> str:
    return f"````{_LANGUAGES.get(path.suffix, 'text')}\n{path.read_text('utf-8')}````"


def _reference(module: str) -> str:
    """Return the page of a module; a function that shares its name with a submodule needs an entry of its own."""
    folder = ROOT / module.replace(".", "/")
    exported = set(re.findall(r'"(\w+)"', (folder / "__init__.py").read_text("utf-8"))) if folder.is_dir() else set()
    names = [x.stem for x in sorted(folder.glob("*.py")) if x.stem in exported and f"\ndef {x.stem}(" in x.read_text()]
    options = "    options: {show_root_heading: true, show_root_toc_entry: true}\n"
    entries = [f"::: {module}\n", *(f"::: {_identifier(module, name)}\n{options}" for name in names)]
    return f"# {module}\n\n" + "\n".join(entries)


def _identifier(module: str, name: str) -> str:
    """Return the full name under which the reference shows a public name of a module."""
    is_submodule = (ROOT / module.replace(".", "/") / f"{name}.py").exists()
    return f"{module}.{name}.{name}" if is_submodule else f"{module}.{name}"


def _entries(nav: Any) -> Iterator[str]:
    """Yield the pages of a navigation in order."""
    for item in nav.values() if isinstance(nav, dict) else nav:
        if isinstance(item, str):
            yield item
        else:
            yield from _entries(item)
