"""The entry point: every command is there, and none costs what another imports."""

import argparse
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
from gp_ground_seg.cli.experiment import EXPERIMENTS
from gp_ground_seg.cli.options import library_notes

HEAVY = {'numba', 'scipy', 'matplotlib', 'pandas', 'rosbags', 'rclpy'}


def test_the_help_groups_the_commands(capsys):
    with pytest.raises(SystemExit, match='0'):
        cli.main(['--help'])
    lines = capsys.readouterr().out.partition('commands:\n')[2].partition('examples:')[0]
    words = [line.split()[0] for line in lines.splitlines() if line.strip()]
    titles = [f'{title}:' for title in cli.GROUPS]
    assert [word for word in words if word in titles] == titles
    assert [word for word in words if word in cli.COMMANDS] == list(cli.COMMANDS)
    assert words.index('files:') < words.index('segment') < words.index('laboratory:')
    assert all(purpose in lines for _, purpose in cli.COMMANDS.values())


@pytest.mark.parametrize(
    ('word', 'hint'), [('segmnt', 'did you mean segment?'), ('xyz', '--help lists them')]
)
def test_a_misspelt_command_is_one_line(word, hint, capsys):
    assert cli.main([word, 'scan.bin']) == 2
    assert error_line(capsys) == f'{word}: no such command; {hint}'


@pytest.mark.parametrize(
    ('line', 'said'),
    [
        ('play BAG --xyz', 'play: unrecognized arguments: --xyz; {}{help play}'),
        ('evaluate R --sequences 0 8', 'evaluate: unrecognized arguments: 8; try {help evaluate}'),
        ('node -r a:=/x', 'node: unrecognized arguments: -r a:=/x; try --ros-args before {}'),
        ('demo --ros-args -r a:=b', 'demo: --ros-args: this command takes none'),
        ('config dmp', "config: WHAT: invalid choice: 'dmp' (choose from {}"),
        ('plot a.pcd -o b', "plot: PICTURE: invalid choice: 'a.pcd' (choose from {}"),
        ('plot segment A -o B --segment 1,',
         "plot segment: --segment: invalid numbers value: '1,'; {}"),
        ('experiment scenes --scenes flt', "experiment scenes: --scenes: 'flt': must be some of {}"
         ', each once; did you mean flat?; {}'),
        ('segment', 'segment: the following arguments are required: INPUT; {}'),
        ('segment A --workers', 'segment: --workers: expected one argument; {}'),
        ('segment A --workers x',
         "segment: --workers: 'x': must be a whole number, at least 1; {}"),
        ('demo --frames 0', "demo: --frames: '0': must be a whole number, at least 1; {}"),
        ('segment A --format csv', "segment: --format: invalid choice: 'csv' (choose from {}"),
        ('segment A --preset papr',
         "unknown preset 'papr'; did you mean paper? (there are default, paper)"),
        ('segment A --preset a.yaml', '--preset a.yaml: is a file, which --config reads'),
        ('segment A --config paper', '--config paper: is a preset, which --preset takes'),
        ('', 'the following arguments are required: COMMAND; {}'),
        ('segment s3://bucket/kitti -o out', 's3:/bucket/kitti: no such file or folder'),
    ],
)  # fmt: skip
def test_wrong_words_are_one_line_with_the_next_step(line, said, capsys):
    """`{}` is any text, `{help x}` names the help of a command."""
    assert cli.main(line.split()) == 2
    said = re.sub(r'{help ([^}]*)}', r'gp-ground-seg \1 --help', said)
    wanted = '.*'.join(re.escape(part) for part in said.split('{}'))
    line = error_line(capsys)
    assert re.fullmatch(wanted, line), line


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


def test_whatever_prints_a_table_has_json():
    leaves = [leaf for name in cli.COMMANDS for leaf in parsers_below(cli.build_parser(name))]
    found = {leaf.prog.split(' ', 1)[1] for leaf in leaves if '--json' in leaf.format_usage()}
    experiments = {f'experiment {name}' for name in EXPERIMENTS}
    assert found == {'evaluate'} | experiments


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


def test_what_the_library_logs_is_said_within_a_command_only(capsys):
    logger = logging.getLogger('gp_ground_seg')
    before = logger.level, list(logger.handlers)
    with library_notes():
        logger.info('compiling %s', 'this')
        logger.debug('not worth saying')
    with library_notes(logging.WARNING):
        logger.info('not worth saying')
        logger.warning('cannot be kept')
    assert (logger.level, list(logger.handlers)) == before
    assert capsys.readouterr().err == (
        'gp-ground-seg: note: compiling this\ngp-ground-seg: note: cannot be kept\n'
    )


def test_progress_without_a_terminal_is_rare_and_on_standard_error(capsys, monkeypatch):
    for _ in options.progress('segment')(range(3)):
        pass
    assert capsys.readouterr() == ('', '')
    monkeypatch.setattr(options, 'LINE_PERIOD', 0.05)
    with options.progress('evaluate')(total=10) as bar:
        for _ in range(10):
            time.sleep(0.02)
            bar.update()
    said = capsys.readouterr().err
    assert 1 <= said.count('/10 [') <= 5 and 'evaluate' in said
    for _ in options.progress('segment', quiet=True)(range(5)):
        time.sleep(0.06)
    assert capsys.readouterr().err == ''
