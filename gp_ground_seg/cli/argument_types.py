"""Kinds of values on the command line."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable


def positive(word: str) -> int:
    """Whole number, at least 1."""
    number = int(word) if word.isdecimal() else 0
    if number < 1:
        raise argparse.ArgumentTypeError(f'{word!r}: must be a whole number, at least 1')
    return number


def some_of(known: Iterable[str]) -> Callable[[str], list[str]]:
    """Return the kind of a list with commas, of names that are known, each once."""
    names = list(known)

    def parse(text: str) -> list[str]:
        words = [word for word in text.split(',') if word]
        unknown = [word for word in words if word not in names]
        if unknown or not words or len(set(words)) < len(words):
            raise argparse.ArgumentTypeError(
                f'{text!r}: must be some of {",".join(names)}, each once'
            )
        return words

    return parse
