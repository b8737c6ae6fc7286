"""A sentence as an `Intent`, by a fixed list of phrases; nothing is guessed.

The text is read from left to right. The first phrase of `PHRASES` that fits where reading stands changes a
draft. The first word that no phrase takes ends in an error that names it.
"""

from __future__ import annotations

import re

from limsim_jax.scenarios.instructions.draft import Draft
from limsim_jax.scenarios.instructions.intent import InstructionError, Intent
from limsim_jax.scenarios.instructions.phrases import ADJECTIVE, PHRASES

LONGEST = 2000
"""Characters of an instruction."""

_NUMBERS = ("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
_MARKS = re.compile(r"[\s,.;:!()-]+")


def parse(text: str) -> Intent:
    """An instruction as an intent.

    Args:
      text: English; vehicles, what they do, and where.

    Raises:
      InstructionError: a word that is not understood, or something that cannot be built; one line.
    """
    if len(text) > LONGEST:
        raise InstructionError(f"{len(text)} characters; an instruction has at most {LONGEST}")
    plain = " ".join(text.lower().replace("\N{RIGHT SINGLE QUOTATION MARK}", "'").split())
    plain = re.sub(rf"\b({'|'.join(_NUMBERS)})\b(?=[- ](?!of\b))", _digits, plain)
    draft, place = Draft(), 0
    while place < len(plain):
        if mark := _MARKS.match(plain, place):
            place = mark.end()
            continue
        for pattern, effect in PHRASES:
            found = pattern.match(plain, place)
            if found is not None and found.end() > place:
                effect(draft, found)
                place = found.end()
                break
        else:
            rest = re.sub(rf"^(?:{ADJECTIVE} )+(?=\w)", "", plain[place:])  # of a vehicle that is not known
            word = re.split(r"[\s,.;:!]", rest)[0]
            raise InstructionError(f"does not know '{word}' in '{text.strip()}'")
    return draft.intent()


def _digits(word: re.Match[str]) -> str:
    return str(next(n for n, name in enumerate(_NUMBERS) if name == word[0]))
