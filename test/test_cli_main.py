"""The entry point: every command is there, and none costs what another imports."""

import logging
import re
import subprocess
import sys

import pytest

from gp_ground_seg.cli import main as cli
from gp_ground_seg.cli.options import library_notes

HEAVY = {'numba', 'scipy', 'matplotlib', 'rosbags', 'rclpy'}


@pytest.mark.parametrize('name', cli.COMMANDS)
def test_every_command_has_a_parser_and_explains_itself(name, capsys):
    with pytest.raises(SystemExit, match='0'):
        cli.main([name, '--help'])
    text = capsys.readouterr().out
    assert text.startswith(f'usage: gp-ground-seg {name}')
    assert f'gp-ground-seg {name}' in text.partition('options:')[2]


def test_help_names_every_command_and_an_unknown_one_is_refused(capsys):
    with pytest.raises(SystemExit, match='0'):
        cli.main(['--help'])
    text = capsys.readouterr().out
    for name, (_, purpose) in cli.COMMANDS.items():
        assert re.search(rf'^    {name}\s+{re.escape(purpose)}$', text, re.MULTILINE)
    with pytest.raises(SystemExit, match='2'):
        cli.main(['segmnet', 'scan.bin'])
    assert "invalid choice: 'segmnet'" in capsys.readouterr().err


@pytest.mark.parametrize('words', [['--help'], ['--version'], ['config', 'dump'], ['node', '-h']])
def test_what_computes_nothing_imports_nothing_heavy(words):
    script = (
        'import atexit, sys\n'
        'from gp_ground_seg.cli.main import main\n'
        'atexit.register(lambda: print(*sys.modules, file=sys.stderr))\n'
        f'sys.exit(main({words!r}))'
    )
    done = subprocess.run(
        [sys.executable, '-c', script], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout
    loaded = {name.split('.')[0] for name in done.stderr.split()}
    assert 'gp_ground_seg' in loaded
    assert not loaded & HEAVY


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
