"""Finds prose that breaks the writing rules, in docs, docstrings, comments and messages.

The rules: 25 words a sentence, no banned word or construction, the terms of docs/glossary.md, and a verb as the first
word of a function's docstring. ``python -m tests.prose PATH...`` prints each finding as ``file:line: rule: text``.
"""

from __future__ import annotations

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
VERBS = frozenset((ROOT / "tests" / "prose_verbs.txt").read_text(encoding="utf-8").split())
"""Verbs that a function's docstring may begin with, in the imperative; a new one is added to the file."""

MAX_WORDS = 25  # of a sentence

# Each construction with its replacement.
BANNED = {
    r"what|whatever": "name the object: 'the error that', 'the frame which'",
    r"who|whom|whoever": "name the component",
    r"told|tells?|telling": "reports, indicates, states, shows",
    r"asked|asks|asking": "requested, queried, checked",
    r"beside|besides": "next to, in addition to",
    r"held to|holds? to": "compared with, constrained to",
    r"of before|of now|of old": "previous, current",
    r"is off|are off|was off|were off": "differs, deviates, is wrong by",
    r"sp(?:ea|o)ks? (?:for|against)|speaks? (?:for|against)": "supports, contradicts",
    r"things?": "object, or name it",
    r"nobody|somebody|nobody's|somebody's": "no client, no thread, a caller",
    r"anew": "again",
    r"mends?|mended|mending": "fix, repair",
    r"so many|so much": "state the quantity",
    r"(?-i:is none|are none|be none)|is no more": "negate the verb",
    r"near to": "near",
    r"goes by|go by|went by": "depends on, uses",
    r"shall|upon|whence|thereof|whereof|hither|thither": "plain English",
    r"its like|their like": "similar ones",
    r"to be had": "available",
    r"stands? (?:for|back|still|in)|stood still": "represents, yields, does not move",
    r"gives? way|says? so|said so|say of|says of|is said|are said|was said": "reports, defines",
    r"taken for|takes? for|to be taken": "treated as",
    r"leaves? (?:it|them) to": "delegates",
    r"in so far|insofar|as well as may be": "plain English",
    r"all there is|all that there is": "everything, or name it",
    r"comes? about|came about|come upon|comes upon": "happens, reaches",
    r"None:": "'If None, ...' as a full sentence",
    r"likes? of|for ever": "always",
    r"lest|albeit|wherein|therein|therewith": "plain English",
    r"word on|a word of|in a word": "message",
    r"puts? (?:it|them) (?:down|right)": "plain English",
}


def _whole_words(pattern: str) -> re.Pattern[str]:
    """Compile a pattern that matches only whole words."""
    return re.compile(rf"(?<![\w-])(?:{pattern})(?!\w)", re.I)


_STARTS = re.compile(r"^(Of|Nor|Whether|As for|Or|Lest|For (?:it|they|there|no|what|a|the))\b")

_CODE = re.compile(r"``[^`]*``|:\w+:`[^`]*`|`[^`]*`")
_LINK = re.compile(r"\[([^\]]*)\]\([^)]*\)")
_ABBREVIATIONS = re.compile(r"\b(e\.g|i\.e|et al|vs|approx|cf|etc|Eq|Eqs|Sec|Fig|Alg|No|resp|incl)\.")
_ENDS = re.compile(r"(?<=[.!?])[\"')\]]*\s+(?=[A-Z\"'(\[«`0-9_Σα-ω])")


@dataclass(frozen=True)
class Finding:
    """A sentence that breaks a rule."""

    path: Path
    line: int
    rule: str
    text: str

    def __str__(self) -> str:
        return f"{self.path.relative_to(ROOT)}:{self.line}: {self.rule}: {self.text[:160]}"


@cache
def _replacements() -> tuple[tuple[str, str], ...]:
    """Return each construction of ``BANNED`` and each word that docs/glossary.md replaces, with its replacement.

    The glossary is a table ``| term | meaning | instead of |``; the third column holds comma-separated words.
    """
    path, rows = ROOT / "docs" / "glossary.md", list(BANNED.items())
    for line in path.read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if line.startswith("|") and len(cells) == 3 and not set(cells[2]) <= set("- :") and cells[2] != "instead of":
            for word in filter(None, (w.strip().strip("`") for w in cells[2].split(","))):
                rows.append((re.escape(word), cells[0].strip("`*")))
    return tuple(rows)


@cache
def _anything_to_replace() -> re.Pattern[str]:
    """Return one pattern that matches where a banned construction or a word of the glossary does."""
    return _whole_words("|".join(f"(?:{words})" for words, _ in _replacements()))


@cache
def _constructions() -> tuple[tuple[re.Pattern[str], str], ...]:
    return tuple((_whole_words(words), replacement) for words, replacement in _replacements())


def sentences(text: str) -> list[str]:
    """Split prose into sentences; code spans count as one word, list items and table cells as sentences."""
    found = []
    for block in re.split(r"\n\s*\n|\n\s*(?=[-*|] |\d+\. )", text):
        plain = _CODE.sub("CODE", _LINK.sub(r"\1", " ".join(block.split())))
        plain = _ABBREVIATIONS.sub(r"\1", plain)
        found += [s.strip(" -*") for s in _ENDS.split(plain) if s.strip(" -*")]
    return found


def words(sentence: str) -> int:
    """Count the words of a sentence; numbers and symbols alone do not count."""
    return len([w for w in sentence.split() if re.search(r"[A-Za-z]", w)])


def check(path: Path, line: int, text: str, *, lengths: bool = True) -> Iterator[Finding]:
    """Yield the findings in one piece of prose that begins at ``line``."""
    for sentence in sentences(text):
        if lengths and words(sentence) > MAX_WORDS:
            yield Finding(path, line, f"{words(sentence)} words, at most {MAX_WORDS}", sentence)
        if _STARTS.search(sentence):
            yield Finding(path, line, "verbless or inverted", sentence)
        if not _anything_to_replace().search(sentence):
            continue
        for pattern, fix in _constructions():
            hit = pattern.search(sentence)
            if hit:
                yield Finding(path, line, f"'{hit.group()}' (use: {fix})", sentence)


def markdown(path: Path) -> Iterator[Finding]:
    """Check a document; code blocks are left out, and so are link targets."""
    text = re.sub(r"^```.*?^```", lambda m: "\n" * m.group().count("\n"), path.read_text("utf-8"), flags=re.S | re.M)
    text = re.sub(r"<[^>]+>", "", text)
    line = 1
    for block in re.split(r"(\n\s*\n)", text):
        table = block.lstrip().startswith("|")
        if table:
            if path.name != "glossary.md":
                for offset, row in enumerate(block.strip("\n").split("\n")):
                    for cell in row.strip("|").split("|"):
                        yield from check(path, line + offset, cell)
        elif block.strip():
            yield from check(path, line, re.sub(r"^#+ .*$", "", block, flags=re.M))
        line += block.count("\n")


def _docstring_parts(doc: str) -> Iterator[tuple[int, str]]:
    """Split a docstring into prose paragraphs and argument entries; code and literal blocks are left out."""
    lines, part, start, literal = doc.expandtabs().splitlines(), list[str](), 0, None
    for number, raw in enumerate(lines):
        indent = len(raw) - len(raw.lstrip())
        if literal is not None and raw.strip() and indent > literal:
            continue
        literal = None
        entry = re.match(r"\s*(Args|Raises|Returns|Yields|Examples?|Note|Attributes):\s*$", raw)
        named = re.match(r"\s{4,}[\w*, .]+: ", raw)
        if entry or named or not raw.strip():
            if part:
                yield start, "\n".join(part)
            part, start = [], number
        if raw.strip() == "Examples:" or raw.rstrip().endswith("::"):
            literal = indent
        if not entry:
            part = part or []
            start = start if part else number
            part.append(re.sub(r"^\s{4,}[\w*, .]+: ", "", raw) if named else raw)
    if part:
        yield start, "\n".join(part)


def python(path: Path) -> Iterator[Finding]:
    """Check docstrings, comments and messages of a Python file."""
    source = path.read_text(encoding="utf-8")
    nodes = list(ast.walk(ast.parse(source)))
    documented: set[int] = set()
    for node in nodes:
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0] if node.body else None
            if (
                isinstance(first, ast.Expr)
                and isinstance(first.value, ast.Constant)
                and isinstance(first.value.value, str)
            ):
                documented.add(id(first.value))
                doc = ast.get_docstring(node, clean=True) or ""
                for offset, text in _docstring_parts(doc):
                    yield from check(path, first.lineno + offset, text)
                yield from _first_word(path, node, first.lineno, doc)
    for node in nodes:
        literal = node.value if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) else None
        if literal is not None and isinstance(literal.value, str) and id(literal) not in documented:
            yield from check(path, literal.lineno, literal.value)
            documented.add(id(literal))
    if "tests" not in path.relative_to(ROOT).parts:
        yield from _messages(path, nodes, documented)
    yield from _comments(path, source)


def _first_word(path: Path, node: ast.AST, line: int, doc: str) -> Iterator[Finding]:
    if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) or node.name.startswith("test_"):
        return
    decorators = {ast.unparse(d).split("(")[0].rsplit(".", 1)[-1] for d in node.decorator_list}
    if decorators & {"property", "cached_property", "fixture", "setter"}:
        return
    word = re.sub(r"[^A-Za-z].*", "", doc.split()[0]) if doc.split() else ""
    if word.lower() not in VERBS:
        yield Finding(
            path,
            line,
            f"docstring of {node.name} begins with '{doc.split()[0]}', no verb of tests/prose_verbs.txt",
            doc.splitlines()[0],
        )


def _messages(path: Path, nodes: Sequence[ast.AST], documented: set[int]) -> Iterator[Finding]:
    """Check string literals that read as prose: four words or more."""
    inside = {id(part) for node in nodes if isinstance(node, ast.JoinedStr) for part in ast.walk(node)}
    for node in nodes:
        text = None
        if isinstance(node, ast.JoinedStr):
            text = "".join(str(v.value) if isinstance(v, ast.Constant) else "X" for v in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documented | inside:
            text = node.value
        if (
            text
            and len(re.findall(r"[A-Za-z]{2,} +(?=[a-z])", text)) >= 3
            and "\n" not in text.strip()
            and "<" not in text
        ):
            yield from check(path, node.lineno, text)  # type: ignore[attr-defined]


def _comments(path: Path, source: str) -> Iterator[Finding]:
    block: list[tuple[int, str]] = []
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and not re.match(r"#\s*(type:|noqa|ruff|!|pragma)", token.string):
            own_line = not token.line[: token.start[1]].strip()
            if block and (not own_line or block[-1][0] + 1 != token.start[0]):
                yield from _flush(path, block)
                block = []
            block.append((token.start[0], re.sub(r"^#:?\s?|\s*# (type|noqa).*$", "", token.string)))
            if not own_line:
                yield from _flush(path, block)
                block = []
    yield from _flush(path, block)


def _flush(path: Path, block: Sequence[tuple[int, str]]) -> Iterator[Finding]:
    if block:
        yield from check(path, block[0][0], "\n".join(text for _, text in block))


def cpp(path: Path) -> Iterator[Finding]:
    """Check the comments of a C++ file."""
    block: list[tuple[int, str]] = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        found = None if "SPDX" in line else re.search(r"(?<![:\"])//+ ?(.*)$", line)
        own_line = found is not None and not line[: found.start()].strip()
        if block and (found is None or not own_line or block[-1][0] + 1 != number):
            yield from _flush(path, block)
            block = []
        if found is not None:
            block.append((number, found.group(1)))
            if not own_line:
                yield from _flush(path, block)
                block = []
    yield from _flush(path, block)


def findings(path: Path) -> list[Finding]:
    """Return all findings in a file; files of other kinds have none."""
    readers = {".md": markdown, ".py": python, ".cpp": cpp, ".hpp": cpp, ".h": cpp}
    reader = readers.get(path.suffix)
    return list(reader(path)) if reader is not None else []


def tracked(*under: str) -> list[Path]:
    """Return the files that git tracks or would track, without CHANGELOG.md and this checker."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", *under],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split("\n")
    exempt = {"CHANGELOG.md", "tests/prose.py", "tests/unit/test_prose.py"}
    return [ROOT / f for f in sorted(set(listed)) if f and f not in exempt and (ROOT / f).is_file()]


def main(arguments: Sequence[str]) -> int:
    """Print the findings under the paths given, or of the whole tree; return 1 if there are any."""
    found = [finding for path in tracked(*arguments) for finding in findings(path)]
    for finding in found:
        print(finding)
    print(f"{len(found)} findings", file=sys.stderr)
    return int(bool(found))


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
