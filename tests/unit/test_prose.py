"""Docs, docstrings, comments and messages follow the writing rules of :mod:`tests.prose`."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from tests.prose import ROOT, check, findings, sentences, tracked, words

_FILES = tracked()
_FOLDERS = sorted({path.relative_to(ROOT).parts[0] for path in _FILES})


@pytest.mark.parametrize("folder", _FOLDERS)
def test_prose_follows_the_rules(folder: str) -> None:
    found = [f for path in _FILES if path.relative_to(ROOT).parts[0] == folder for f in findings(path)]
    assert not found, "\n".join(map(str, found[:20])) + f"\n{len(found)} in all"


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("What is wrong with a log is told with file, field and fix.", "What"),
        ("The pose that is found stands for what was seen.", "what"),
        ("None: whether is not asked.", "None:"),
        ("Of poses that were found before, the last one counts.", "verbless"),
        (" ".join(["word"] * 26) + ".", "26 words, at most 25"),
    ],
)
def test_the_rules_catch_the_phrasing_that_they_are_for(text: str, rule: str) -> None:
    assert any(rule in str(finding.rule) for finding in check(Path("x.py"), 1, text))


def test_plain_technical_english_passes() -> None:
    text = "Errors in a log name the file, the field and the fix. If None, containment is not computed."
    assert not list(check(Path("x.py"), 1, text))


def test_ninety_percent_of_all_sentences_in_the_docs_have_at_most_25_words() -> None:
    lengths = Counter(
        words(s) for path in _FILES if path.suffix == ".md" for s in sentences(path.read_text(encoding="utf-8"))
    )
    total, below = sum(lengths.values()), sum(n for length, n in lengths.items() if length <= 25)
    assert below >= 0.9 * total
