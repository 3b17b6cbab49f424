"""Runs the commands under test, in this process or in one of their own."""

import subprocess
import sys

from gp_ground_seg.cli import main as cli

COMMANDS = ('gp_ground_seg.cli.segment', 'gp_ground_seg.cli.kitti_to_bag')

IN_A_PROCESS = (
    'import sys\n'
    'from gp_ground_seg.cli import main as cli\n'
    f'cli.COMMAND_MODULES = {COMMANDS!r}\n'
    'sys.exit(cli.main())\n'
)


def run(monkeypatch, *words):
    """Exit code of a command run in this process."""
    monkeypatch.setattr(cli, 'COMMAND_MODULES', COMMANDS)
    return cli.main([str(word) for word in words])


def start(*words, **options):
    """Command as a process of its own."""
    return subprocess.Popen(
        [sys.executable, '-c', IN_A_PROCESS, *(str(word) for word in words)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options,
    )  # fmt: skip


def error_line(capsys):
    """Return the one line that a failed command said."""
    said = capsys.readouterr()
    assert said.out == ''
    (line,) = said.err.splitlines()
    assert line.startswith('gp-ground-seg: error: ')
    return line.removeprefix('gp-ground-seg: error: ')
