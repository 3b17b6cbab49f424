"""What the experiments' tables share: Markdown, and what they ran on."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Sequence

from gp_ground_seg.cli.options import DEFAULT_PRESET
from gp_ground_seg.evaluation.environment import Environment

WIDTH = 100


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]], n_left: int = 1) -> str:
    """Lay out rows as a Markdown table, the first `n_left` columns aligned left."""
    rule = ['---' if k < n_left else '--:' for k in range(len(header))]
    lines = [header, rule, *rows]
    return '\n'.join(f'| {" | ".join(cells)} |' for cells in lines)


def machine_text(environment: Environment, n_threads: int, backend: str) -> str:
    """One line on where a measurement ran."""
    threads = '1 thread' if n_threads == 1 else f'{n_threads} threads'
    cores = '1 core' if environment.n_cores == 1 else f'{environment.n_cores} cores'
    versions = ', '.join(
        f'{name} {version or "absent"}' for name, version in environment.versions.items()
    )
    commit = '' if environment.commit is None else f', commit {environment.commit[:12]}'
    if environment.commit is not None and environment.commit.endswith('-dirty'):
        commit += ' (changed since)'
    return (
        f'{environment.cpu}, {threads} on {cores}, {backend}; '
        f'Python {environment.python}, {versions}{commit}'
    )


def wrapped(line: str) -> str:
    """Fold a line for the terminal."""
    return textwrap.fill(line, WIDTH, subsequent_indent='  ', break_on_hyphens=False)


def config_words(arguments: argparse.Namespace) -> list[str]:
    """Words of the command line that changed the parameters."""
    words = ['--preset', arguments.preset] if arguments.preset != DEFAULT_PRESET else []
    words += ['--config', arguments.config] if arguments.config else []
    for setting in arguments.settings:
        words += ['--set', setting]
    return words
