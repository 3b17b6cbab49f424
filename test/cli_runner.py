"""Runs the commands under test, in this process or in one of their own."""

import contextlib
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

from gp_ground_seg.cli import main as cli

INTERRUPTED = (130, -signal.SIGINT)
"""Exit codes, 130 to a shell both: `python -m` ends by the signal itself where that came while
code made from a string ran, as of `namedtuple` and `dataclass`, although it was caught."""


PATIENCE = 120.0  # for what has to happen [s]; only a failure takes that long
LOOK_PERIOD = 0.005  # time between two looks whether it has [s]


def wait_for(condition, what):
    """Return as soon as `condition` holds."""
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() <= end, f'after {PATIENCE:g} s still no {what}'
        time.sleep(LOOK_PERIOD)


def run(*words):
    """Exit code of a command run in this process."""
    return cli.main([str(word) for word in words])


def start(*words, **options):
    """Command as a process of its own."""
    return subprocess.Popen(
        [sys.executable, '-m', 'gp_ground_seg', *(str(word) for word in words)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options,
    )  # fmt: skip


@contextlib.contextmanager
def until_ctrl_c(*words, **options):
    """Command as a process of its own, which Ctrl-C ends, with one line, behind the block."""
    with start(*words, **options) as process:
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            said = process.communicate()[1]
    assert process.returncode in INTERRUPTED
    *notes, last = said.splitlines()
    assert last == 'gp-ground-seg: interrupted', said
    assert all(line.startswith('gp-ground-seg: note: ') for line in notes), said


def stat_words(pid):
    """Words about a process, from its state on; see proc(5)."""
    return Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()


def cpu_seconds(pid):
    """CPU time of a process."""
    return sum(map(int, stat_words(pid)[11:13])) / os.sysconf('SC_CLK_TCK')


def is_running(pid, *parents):
    """Whether a process has not ended, waited for or not, and has one of the parents, if given."""
    try:
        state, parent = stat_words(pid)[:2]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != 'Z' and (not parents or int(parent) in parents)


def children(pid):
    """Processes that a process has started and that have not ended."""
    return [n for n in map(int, filter(str.isdigit, os.listdir('/proc'))) if is_running(n, pid)]


@contextlib.contextmanager
def limited(kind, size):
    """What this process may take of a kind of resource, within the block."""
    before = resource.getrlimit(kind)
    resource.setrlimit(kind, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(kind, before)


def error_line(capsys):
    """Return the one line that a failed command said."""
    said = capsys.readouterr()
    assert said.out == ''
    (line,) = said.err.splitlines()
    assert line.startswith('gp-ground-seg: error: ')
    return line.removeprefix('gp-ground-seg: error: ')
