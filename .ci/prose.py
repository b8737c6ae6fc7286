"""Checks the English of the repository: plain words, short sentences, short first lines of docstrings.

    python .ci/prose.py [PATH ...]        # every finding as path:line: reason; exit code 1 if there is one
    python .ci/prose.py --count           # findings per rule and folder

Python files are checked in their docstrings, comments, messages and test names, Markdown and notebooks in
their prose, TOML files in their comments.
"""

from __future__ import annotations

import ast
import io
import json
import re
import subprocess
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

REPO = Path(__file__).resolve().parents[1]
FIRST_LINE = 12
"""Words, at most, in the first line of a docstring."""
SENTENCE = 30
"""Words, at most, in a sentence of README and docs."""

RULES = {
    "who without a noun": re.compile(
        r"(?<!says )(?<!saying )(?<!say )(?<!decides )\bwho\b|\bwhoever\b",
        re.I,
    ),
    "a person where a vehicle is meant": re.compile(r"\b(?:some|no|every|any)body\b", re.I),
    "else for otherwise": re.compile(
        r"\bor else\b|[;,] else\b|\belse (?:the|it|they|a|an|as|by|this|that|whichever)\b|\bif not, else\b",
        re.I,
    ),
    "gives back": re.compile(r"\bg(?:ive|ives|ave|iving) back\b", re.I),
    "what became of": re.compile(r"\bwhat (?:became|comes|came|becomes) of\b", re.I),
    "would be right": re.compile(r"\bwould be right\b", re.I),
    "so many": re.compile(r"\b(?:of|for|after|by|with|in|to|on|run|takes) so many\b(?! that)", re.I),
}
QUESTION = re.compile(r"\bwho\b[^.?!]*\?", re.I)
"""A question may ask who."""
SKIPPED = ("experiments/results/", "docs/results/", "LICENSE", ".ci/prose.py")


class Finding(NamedTuple):
    """A place, and what is wrong there."""

    path: str
    line: int
    rule: str
    text: str


def check(path: Path) -> Iterator[Finding]:
    """All findings in a file."""
    name = path.relative_to(REPO).as_posix()
    source = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        yield from _python(name, source)
    elif path.suffix == ".md":
        yield from _markdown(name, source)
    elif path.suffix == ".ipynb":
        for number, cell in enumerate(json.loads(source)["cells"]):
            text = "".join(cell["source"])
            prose = _prose_of_markdown(text) if cell["cell_type"] == "markdown" else _comments(text)
            for _, line in prose:
                yield from _words(name, number, line)
    elif path.suffix == ".toml":
        for number, line in enumerate(source.splitlines(), 1):
            if "#" in line:
                yield from _words(name, number, line.partition("#")[2])


def _python(name: str, source: str) -> Iterator[Finding]:
    for number, text in _comments(source):
        yield from _words(name, number, text)
    tree = ast.parse(source)
    docstrings = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text is None:
                continue
            docstrings.add(id(node.body[0].value))  # pyright: ignore[reportAttributeAccessIssue]
            line = node.body[0].lineno
            yield from _words(name, line, text)
            first = " ".join(re.split(r"\n\s*\n", text)[0].split())
            first = re.split(r"(?<=[.:;!?])\s", first)[0]
            words = len(first.split())
            if words > FIRST_LINE and not _is_test(name):
                yield Finding(name, line, "first line of a docstring", f"{words} words: {first}")
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name.startswith(("test_", "Test")):
            yield from _words(name, node.lineno, node.name.replace("_", " "))
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            if " " in node.value:
                yield from _words(name, node.lineno, node.value)


def _is_test(name: str) -> bool:
    return name.startswith("tests/")


def _comments(source: str) -> Iterator[tuple[int, str]]:
    """Comments, those on neighbouring lines joined."""
    block: list[str] = []
    first = last = 0
    try:
        tokens = list(tokenize.generate_tokens(io.StringIO(source).readline))
    except (tokenize.TokenError, IndentationError, SyntaxError):
        return  # a cell with magics
    for token in tokens:
        if token.type != tokenize.COMMENT:
            continue
        if block and token.start[0] == last + 1:
            block.append(token.string.lstrip("# "))
        else:
            if block:
                yield first, " ".join(block)
            block, first = [token.string.lstrip("# ")], token.start[0]
        last = token.start[0]
    if block:
        yield first, " ".join(block)


def _prose_of_markdown(text: str) -> Iterator[tuple[int, str]]:
    """Paragraphs without code, tables, links' addresses and formulas."""
    text = re.sub(r"<!--.*?-->", lambda m: "\n" * m.group().count("\n"), text, flags=re.S)
    fence = re.compile(r"^ *(```|~~~).*?^ *\1 *$", re.M | re.S)
    text = fence.sub(lambda m: "\n" * m.group().count("\n"), text)
    number = 1
    for block in re.split(r"(\n\s*\n)", text):
        lines = block.split("\n")
        kept = [line for line in lines if not line.lstrip().startswith(("|", ":::", "    "))]
        for item in re.split(r"\n(?=\s*(?:[-*#]|\d+\.)\s)", "\n".join(kept)):
            plain = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", item)
            plain = re.sub(r"`[^`]*`", "x", plain)
            plain = re.sub(r"\$[^$]*\$", "x", plain)
            if plain.strip():
                yield number, " ".join(plain.split())
        number += block.count("\n")


def _markdown(name: str, source: str) -> Iterator[Finding]:
    for number, text in _prose_of_markdown(source):
        yield from _words(name, number, text)
        for sentence in re.split(r"(?<=[.!?:;])\s+", text):
            words = len(sentence.split())
            if words > SENTENCE:
                yield Finding(name, number, "sentence", f"{words} words: {sentence[:90]}")


def _words(name: str, number: int, text: str) -> Iterator[Finding]:
    text = " ".join(text.split())
    asked = QUESTION.sub(lambda m: "?" * len(m.group()), text)
    for rule, pattern in RULES.items():
        for found in pattern.finditer(asked):
            around = text[max(0, found.start() - 40) : found.end() + 40]
            yield Finding(name, number, rule, f"...{around}...")


def files(arguments: list[str]) -> list[Path]:
    """The files to check: those named, or all that git knows."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", *arguments],
        cwd=REPO, capture_output=True, text=True, check=True,
    ).stdout.split("\n")  # fmt: skip
    kept = [name for name in listed if name.endswith((".py", ".md", ".ipynb", ".toml"))]
    return [REPO / name for name in kept if not name.startswith(SKIPPED) and (REPO / name).exists()]


def main(arguments: list[str]) -> int:
    """Print findings; 1 if there are any."""
    counting = "--count" in arguments
    found = [x for path in files([a for a in arguments if a != "--count"]) for x in check(path)]
    if counting:
        for (rule, folder), count in sorted(
            Counter((x.rule, x.path.rpartition("/")[0] or x.path) for x in found).items()
        ):
            print(f"{count:5} {rule:36} {folder}")
    else:
        for x in found:
            print(f"{x.path}:{x.line}: {x.rule}: {x.text}")
    print(f"{len(found) or 'no'} findings")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
