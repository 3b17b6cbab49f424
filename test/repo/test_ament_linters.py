"""The linters of ROS, where ROS is; `make lint` runs flake8 and pydocstyle with their settings."""

import importlib

import pytest
from conftest import REPOSITORY

pytestmark = pytest.mark.slow

# As in the Makefile.
NOT_ASKED_FOR = ('D100', 'D101', 'D102', 'D103', 'D104', 'D105', 'D106', 'D107', 'D404')
PYDOCSTYLE = ('--convention', 'numpy', '--add-ignore', *NOT_ASKED_FOR)
SOURCES = ('gp_ground_seg', 'test', 'setup.py')


@pytest.mark.parametrize(
    ('linter', 'words'),
    [
        ('ament_flake8', ['--config', 'test/ament_flake8.ini', *SOURCES]),
        ('ament_pep257', ['gp_ground_seg', 'setup.py', *PYDOCSTYLE]),
        ('ament_xmllint', ['package.xml']),
    ],
)
def test_ament(monkeypatch, linter, words):
    pytest.importorskip(linter)
    monkeypatch.chdir(REPOSITORY)
    assert importlib.import_module(f'{linter}.main').main(argv=words) == 0
