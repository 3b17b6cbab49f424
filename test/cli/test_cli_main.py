"""The entry point: every command is there, and none costs what another imports."""

import argparse
import io
import logging
import re
import shlex
import subprocess
import sys
import time

import pytest
from cli_runner import error_line

from gp_ground_seg.cli import main as cli
from gp_ground_seg.cli import options

HEAVY = {'numba', 'scipy', 'matplotlib', 'pandas', 'rosbags', 'rclpy'}


def test_the_help_has_the_purpose_of_each_command(capsys):
    with pytest.raises(SystemExit, match='0'):
        cli.main(['--help'])
    said = ' '.join(capsys.readouterr().out.split())
    assert all(f'{name} {purpose}' in said for name, (_, purpose) in cli.COMMANDS.items())


@pytest.mark.parametrize(
    ('line', 'said'),
    [
        ('segmnt A', "COMMAND: invalid choice: 'segmnt' .choose from .*; see gp-"),
        ('node -r a:=/x', 'unrecognized arguments: -r a:=/x; see gp-ground-seg --help'),
        ('demo --ros-args -r a:=b', 'demo: --ros-args: this command takes none'),
        ('plot segment A -o B --segment 1,', "--segment: invalid numbers value: '1,'"),
        ('experiment scenes --scenes flt',
         "--scenes: 'flt': must be some of .*, each once"),
        ('segment A --workers x', "--workers: 'x': must be a whole number, at least 1; see "),
        ('demo --frames 0', "--frames: '0': must be a whole number, at least 1"),
        ('segment A --columns 2', "--columns: '2': must be a whole number, at least 3"),
        ('play A --rate 0', "--rate: '0': must be a number, above 0"),
        ('play A --rate nan', "--rate: 'nan': must be a number, above 0"),
        ('segment A --preset papr',
         r"unknown preset 'papr'; did you mean paper. \(there are default, paper\)"),
        ('segment A --set a', '--set a: must be NAME=VALUE'),
        ('segment s3://bucket/kitti -o out', 's3:/bucket/kitti: no such file or folder'),
    ],
)  # fmt: skip
def test_wrong_words_are_one_line_with_the_next_step(line, said, capsys):
    assert cli.main(line.split()) == 2
    line = error_line(capsys)
    assert re.match(said, line), line


def parsers_below(parser):
    """Parsers of a command that have none below them, as words of the command line."""
    found = [one for one in parser._actions if isinstance(one, argparse._SubParsersAction)]
    below = [child for one in found for child in one.choices.values()]
    return [leaf for child in below for leaf in parsers_below(child)] or [parser]


@pytest.mark.parametrize('name', cli.COMMANDS)
def test_every_help_has_examples_that_can_be_run(name, capsys):
    """Also of what is below a command; an example is taken by the parser as it stands."""
    with pytest.raises(SystemExit, match='0'):
        cli.main([name, '--help'])
    assert capsys.readouterr().out.startswith(f'usage: gp-ground-seg {name}')
    parser = cli.build_parser(name)
    for leaf in parsers_below(parser):
        _, mark, text = leaf.epilog.partition('examples:\n')
        examples = re.findall(r'^  (gp-ground-seg .*)$', re.sub(r'\\\n *', '', text), re.MULTILINE)
        assert mark and any(one.startswith(leaf.prog) for one in examples), leaf.prog
        for example in examples:
            # Behind two spaces is what it does, behind > and --ros-args what others read.
            words = shlex.split(re.split(r'  +| > | &$| --ros-args', example)[0])[1:]
            cli.build_parser(words[0]).parse_args(words)
    assert capsys.readouterr().err == ''


ENTRY = 'from gp_ground_seg.cli.main import main; main({})'


@pytest.mark.parametrize(
    ('code', 'heavy'),
    [
        *((ENTRY.format([*words.split()]), HEAVY)
          for words in ('--help', '--version', 'config dump', 'node -h')),
        ('from gp_ground_seg import *', {'rclpy', 'sensor_msgs', 'matplotlib', 'rosbags', 'tqdm'}),
        ('import gp_ground_seg', HEAVY | {'numpy'}),
    ],
)  # fmt: skip
def test_what_computes_nothing_imports_nothing_heavy(code, heavy):
    names = 'print(*sys.modules, file=sys.stderr)'
    script = f'import atexit, sys; atexit.register(lambda: {names}); {code}'
    done = subprocess.run(
        [sys.executable, '-c', script], capture_output=True, text=True, check=True
    )
    loaded = {name.split('.')[0] for name in done.stderr.split()}
    assert 'gp_ground_seg' in loaded
    assert not loaded & heavy


def test_what_the_library_logs_is_said_within_a_command_only(monkeypatch, capsys):
    logger = logging.getLogger('gp_ground_seg')
    before = logger.level, list(logger.handlers)

    def log(_arguments):
        logger.debug('not worth saying')
        logger.info('compiling %s', 'this')
        logger.warning('cannot be kept')

    monkeypatch.setattr('gp_ground_seg.cli.segment.run', log)
    for words in ['segment', 'A'], ['segment', 'A', '--quiet']:
        cli.main(words)
    logger.info('not in a command')
    assert (logger.level, list(logger.handlers)) == before
    notes = ['compiling this', 'cannot be kept', 'cannot be kept']
    assert capsys.readouterr().err == ''.join(f'gp-ground-seg: note: {n}\n' for n in notes)


@pytest.mark.parametrize(
    ('is_terminal', 'quiet', 'least', 'most'),
    [(True, False, 4, 9), (True, True, 0, 0), (False, False, 1, 2)],
)
def test_progress_is_on_standard_error_and_rare_without_a_terminal(
    is_terminal, quiet, least, most, monkeypatch
):
    stderr = io.StringIO()
    stderr.isatty = lambda: is_terminal
    monkeypatch.setattr('sys.stderr', stderr)
    monkeypatch.setattr(options, 'LINE_PERIOD', 0.2)
    with options.progress('segment', quiet=quiet)(total=4) as bar:
        for _ in range(4):
            time.sleep(0.11)
            bar.update()
    said = stderr.getvalue()
    assert least <= said.count('segment:') <= most and least <= said.count('/4 [') <= most
