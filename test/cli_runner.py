"""Runs the commands under test, in this process or in one of their own."""

import subprocess
import sys

from gp_ground_seg.cli import main as cli


def run(*words):
    """Exit code of a command run in this process."""
    return cli.main([str(word) for word in words])


def start(*words, **options):
    """Command as a process of its own."""
    return subprocess.Popen(
        [sys.executable, '-m', 'gp_ground_seg', *(str(word) for word in words)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options,
    )  # fmt: skip


def error_line(capsys):
    """Return the one line that a failed command said."""
    said = capsys.readouterr()
    assert said.out == ''
    (line,) = said.err.splitlines()
    assert line.startswith('gp-ground-seg: error: ')
    return line.removeprefix('gp-ground-seg: error: ')
