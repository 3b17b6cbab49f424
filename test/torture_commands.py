"""Wrong commands, drawn at random over verbs, options and files: one line, nothing lost.

Each has a part that is surely wrong, and others that may be. Every fiftieth is a process of its
own. `python test/torture_commands.py FIRST STOP` runs the cases of a range.
"""

import argparse
import contextlib
import functools
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from bag_samples import scan, write_ros1_bag, write_ros2_bag
from torture_cases import answer, run_cases

from gp_ground_seg.cli import main as cli

SECONDS = 60
"""Most that a command may take [s]."""
GOOD = ['scan.bin', 'root', 'root/sequences/00', 'drive.mcap', 'drive.db3', 'drive.bag', 'drive',
        'robot.yaml', 'scan.label', 'record.json']  # fmt: skip
SUFFIXES = ['', '.bin', '.pcd', '.ply', '.npy', '.npz', '.mcap', '.db3', '.bag', '.yaml', '.json',
            '.label', '.png', '.html']  # fmt: skip
STRANGE = ['a\x1b[31m\nb', os.fsdecode(b'a\xff'), '$x_{', '{}%s#?', ' ', 'ä' * 100, '-x', '[a*']
WRONG_FILES = [
    '', '.', '/', '/dev/null', '/dev/zero', '/proc/self/mem', '~', '*', 'loop', 'loop.bin',
    'good/scan.bin/x', 's3://none/x.bin', 'http://127.0.0.1:1/x.bin', 'memory://x', 'file:///x',
    'foo://x', '://', 'http://[', *(f'missing{suffix}' for suffix in SUFFIXES),
    *(f'folder{suffix}' for suffix in SUFFIXES), *(f'empty{suffix}' for suffix in SUFFIXES),
    *(f'noise{suffix}' for suffix in SUFFIXES), *(f'{name}.bin' for name in STRANGE),
]  # fmt: skip
OUTPUTS = ['good', 'good/scan.bin', 'good/root', 'loop', '',
           '/dev/full', '/none/out', *(f'{name}.png' for name in STRANGE),
           *(f'out{suffix}' for suffix in SUFFIXES)]  # fmt: skip
NUMBERS = ['-1', 'x', '', 'nan', 'inf', '1e999', '9' * 5000, '0x10', '٣', '1_0', '-0', '1.5.1']
LIKELY = ['3', '4', '20']
TEXTS = ['00', '99', 'a,b', ',', '/points', '//', 'tcp://127.0.0.1:1', '\x1b', '\n', '%s',
         '{}', '\udcff', 'x' * 3000]  # fmt: skip
SETTINGS = ['', '=', 'a=b', 'grid.n_bins', 'grid.n_bins=[', 'grid.n_bins=!!int x', 'grid=1',
            'grid.n_bins=0x' + 'f' * 20_000, 'sensor.height=2011-99-99', 'label.rule=*a',
            'grid.n_bins=' + '[' * 3000, 'grid.r_max=1e999', 'label.rule=\x1b[31m\n',
            'grid.n_bins=' + '9' * 5000, 'frame.x=\udcff', 'grid.n_bins=&a 9']  # fmt: skip
ROS = ['-p', '-r', ':=', 'a:=', '-p x', '--params-file missing.yaml', '--params-file noise.yaml',
       '--params-file good/scan.bin', '-p grid.n_bins:=x', '-p grid.n_bins:=-1']  # fmt: skip
WRITTEN = ('output', 'json', 'save', 'html')
RIGHT = {
    'sequence': '00', 'sequences': '00', 'preset': 'paper', 'topic': '/points',
    'scheduler': 'tcp://127.0.0.1:1', 'sensors': 'vlp-16', 'scenes': 'flat', 'seeds': '1',
    'parameters': 'label.ground_tolerance', 'camera': '0,20,30', 'workers': '1', 'node': '/x',
}  # fmt: skip
SERVERS = ('node', 'warm-up', 'demo', 'tune', 'play')
"""What is right only runs until it is ended, or for long."""


@functools.cache
def leaves():
    """Parsers of commands that have none below them, with their words."""

    def below(parser, words):
        found = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
        return [
            leaf for a in found for w, p in a.choices.items() for leaf in below(p, [*words, w])
        ] or [(words, parser)]

    return [
        leaf for name in cli.COMMANDS
        for leaf in below(cli.build_parser(name), [])
    ]  # fmt: skip


class Draw:
    """A command from the numbers of its case."""

    def __init__(self, number):
        self.rng = np.random.default_rng([53, number])
        verb = self.pick(list(cli.COMMANDS))
        words, parser = self.pick([leaf for leaf in leaves() if leaf[0][0] == verb])
        self.actions = [a for a in parser._actions if a.dest != 'help']
        self.is_server = words[0] in SERVERS
        optional = [a for a in self.actions if a.option_strings and not a.required]
        chosen = [a for a in optional if self.rng.random() < 2.5 / len(optional)]
        needed = [a for a in self.actions if not a.option_strings or a.required]
        self.wrong = self.pick(
            [*needed, None]
            if self.is_server
            else [*needed, *(a for a in chosen if a.nargs != 0), None]
        )
        self.words = list(words)
        for action in [*chosen, *needed]:
            self.words += self.spell(action)
        # Any output may be right; the page of `tune` says by itself what is wrong with a scan.
        if self.wrong is None or self.wrong.dest in WRITTEN or words == ['tune']:
            self.spoil()

    def pick(self, options):
        return options[int(self.rng.integers(len(options)))]

    def spell(self, action):
        """Words of an option or positional."""
        n = {None: 1, '?': 1, '*': 1, '+': 1, 0: 0}.get(action.nargs, action.nargs)
        values = [self.value(action, action is self.wrong) for _ in range(n)]
        if action is self.wrong and action.nargs not in ('?', '*') and self.rng.random() < 0.1:
            values = values[1:]
        return [*action.option_strings[-1:], *values]

    def value(self, action, is_wrong):
        if action.dest == 'settings':
            return self.pick(SETTINGS) if is_wrong else 'grid.n_bins=40'
        if action.choices:
            return self.pick(TEXTS) if is_wrong else str(self.pick(list(action.choices)))
        if action.type is not None and action.dest not in RIGHT:
            return self.pick(NUMBERS) if is_wrong else self.pick(LIKELY)
        if action.dest in WRITTEN:
            return self.pick(OUTPUTS)
        if action.dest in RIGHT:
            return self.pick(TEXTS) if is_wrong else RIGHT[action.dest]
        return self.pick(WRONG_FILES) if is_wrong else f'good/{self.pick(GOOD)}'

    def spoil(self):
        """Make the whole of it wrong."""
        kind = self.rng.integers(4)
        if self.words[0] == 'node' and kind < 3:
            self.words += ['--ros-args', *self.pick(ROS).split()]
        elif kind == 0:
            self.words += ['--nonsense']
        elif kind == 1:
            self.words += [f'--{self.pick(STRANGE)}']
        elif kind == 2:
            self.words += ['--ros-args', '-r'] if not self.is_server else ['--no-such']
        else:
            self.words += [self.pick(WRONG_FILES), self.pick(WRONG_FILES), '--nonsense']


def make_good(good):
    """Lay out what commands can read."""
    sequence = good / 'root' / 'sequences' / '00'
    (sequence / 'velodyne').mkdir(parents=True)
    (sequence / 'labels').mkdir()
    points = scan(n_ground=6000)
    labels = np.full(len(points), 40, '<u4')
    for path in (good / 'scan.bin', sequence / 'velodyne' / '000000.bin'):
        points.tofile(path)
    for path in (good / 'scan.label', sequence / 'labels' / '000000.label'):
        labels.tofile(path)
    (good / 'robot.yaml').write_text('sensor: {height: 1.7}\n')
    (good / 'record.json').write_text('{}')
    write_ros2_bag(good / 'drive.mcap')
    write_ros2_bag(good / 'drive.db3')
    write_ros1_bag(good / 'drive.bag')
    write_ros2_bag(good / 'drive')


def make_hostile(folder):
    """Add empty files, noise, folders and loops under every suffix."""
    rng = np.random.default_rng(0)
    for suffix in SUFFIXES:
        (folder / f'empty{suffix}').touch()
        (folder / f'noise{suffix}').write_bytes(rng.bytes(4000))
        (folder / f'folder{suffix}').mkdir()
    for name in ('loop', 'loop.bin'):
        (folder / name).symlink_to(folder / f'{name}2')
        (folder / f'{name}2').symlink_to(folder / name)
    for name in STRANGE:
        (folder / f'{name}.bin').write_bytes(rng.bytes(160))


class TooLong(BaseException):
    """No command turns it into a line."""


def give_up(*_):
    raise TooLong


def contents(folder):
    """Everything in the folder, with what no command may change of it."""
    kept = {}
    for path in folder.rglob('*'):
        facts = path.lstat()
        is_folder = path.is_dir() and not path.is_symlink()
        kept[path] = facts.st_mode, None if is_folder else (facts.st_size, facts.st_mtime_ns)
    return kept


def run_apart(words):
    done = subprocess.run(
        [sys.executable, '-m', 'gp_ground_seg', *words], capture_output=True, text=True,
        errors='surrogateescape', timeout=SECONDS, check=False,
    )  # fmt: skip
    return done.returncode, done.stdout, done.stderr


def run_case(number, folder):
    """Return what is wrong with the answer to one command, or None."""
    words = Draw(number).words
    shown = ' '.join(word if len(word) < 99 else f'{word[:9]}...' for word in words)
    before = contents(folder)
    signal.signal(signal.SIGALRM, give_up)
    signal.alarm(SECONDS)
    try:
        code, said, errors = run_apart(words) if number % 50 == 49 else answer(words)
    except TooLong:
        return f'{shown!r}: no end within {SECONDS} s'
    except BaseException as error:
        return f'{shown!r}: {type(error).__name__}: {str(error)[:200]!r}'
    finally:
        signal.alarm(0)
        now = contents(folder)
        for path in now.keys() - before.keys():
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(True)
    lines = [line for line in errors.splitlines() if ': note: ' not in line]
    problem = ''
    if 'Traceback' in errors or code not in (0, 1, 2):
        problem = f'exit code {code}'
    elif not all(line.isprintable() for line in (said + errors).split('\n')):
        problem = 'characters that are not escaped'
    elif code == 2 and words[:2] != ['config', 'check'] and not lines[-1:]:
        problem = 'no line'
    elif code == 2 and words[:2] != ['config', 'check'] and ': error: ' not in lines[-1]:
        problem = 'the last line is no error'
    elif (
        code == 2 and len(lines) > 1 and not lines[0].startswith('usage: ') and words[1] != 'check'
    ):
        problem = f'{len(lines)} lines'
    elif [path for path in before if now.get(path) != before[path]]:
        problem = f'changed {[path for path in before if now.get(path) != before[path]]}'
    return f'{shown!r}: {problem}: {errors[-400:]!r}' if problem else None


@contextlib.contextmanager
def world():
    """Yield a folder of good and hostile files, as working folder."""
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as name:
        make_good(Path(name, 'good'))
        make_hostile(Path(name))
        os.chdir(name)
        try:
            yield Path(name)
        finally:
            os.chdir(before)


if __name__ == '__main__':
    with world() as place:
        run_cases(lambda number: run_case(number, place))
