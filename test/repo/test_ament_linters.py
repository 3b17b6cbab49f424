"""The linters of ROS, with our settings where theirs and our formatter's differ.

The ament linters come with ROS only. What they run, flake8 and pydocstyle, is in the
``dev`` extra, and run here with the same settings everywhere.
"""

import importlib
import importlib.util
import re
import subprocess
import sys

import pytest
from conftest import REPOSITORY

# `make lint` finds nearly the same, with ruff.
pytestmark = pytest.mark.slow

PLUGINS = ('builtins', 'comprehensions', 'docstrings', 'quotes')
FLAKE8 = ('flake8', *(f'flake8_{name}' for name in PLUGINS))
CONFIG = 'test/ament_flake8.ini'
SOURCES = ('gp_ground_seg', 'test', 'setup.py')
# The numpy convention leaves out what it contradicts; ament asks for no docstrings either.
CONVENTION = 'numpy'
NOT_ASKED_FOR = ('D100', 'D101', 'D102', 'D103', 'D104', 'D105', 'D106', 'D107', 'D404')


def run(*words):
    return subprocess.run(
        [sys.executable, *words], cwd=REPOSITORY, capture_output=True, text=True, timeout=300
    )


def need(*modules):
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    if missing:
        pytest.skip(f'not installed: {", ".join(missing)}')


def test_flake8_with_the_settings_of_ament():
    need(*FLAKE8)
    done = run('-m', 'flake8', f'--config={CONFIG}', *SOURCES)
    assert (done.returncode, done.stdout, done.stderr) == (0, '', '')


def test_flake8_would_find_something(tmp_path):
    need(*FLAKE8)
    bad = tmp_path / 'bad.py'
    bad.write_text(
        'import os\nx = "a" ; y = list([i for i in x])\ndef list(): """no"""\n' + 'z' * 120
    )
    done = run('-m', 'flake8', f'--config={CONFIG}', str(bad))
    codes = set(re.findall(r'[A-Z]\d{3}', done.stdout))
    assert {'F401', 'Q000', 'E501', 'C411', 'A001', 'D400'} <= codes


def test_pydocstyle_with_the_settings_of_ament():
    need('pydocstyle')
    words = (f'--convention={CONVENTION}', f'--add-ignore={",".join(NOT_ASKED_FOR)}')
    done = run('-m', 'pydocstyle', *words, '--match=.*\\.py', 'gp_ground_seg', 'setup.py')
    assert (done.returncode, done.stdout, done.stderr) == (0, '', '')


PYDOCSTYLE = ('--convention', CONVENTION, '--add-ignore', *NOT_ASKED_FOR)


@pytest.mark.parametrize(
    ('linter', 'words'),
    [
        ('ament_flake8', ['--config', CONFIG, *SOURCES]),
        ('ament_pep257', ['gp_ground_seg', 'setup.py', *PYDOCSTYLE]),
        ('ament_xmllint', ['package.xml']),
    ],
)
def test_ament(monkeypatch, linter, words):
    need(linter)
    monkeypatch.chdir(REPOSITORY)
    assert importlib.import_module(f'{linter}.main').main(argv=words) == 0
