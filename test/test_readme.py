"""README from top to bottom in one clone: its commands, the demo, and the tests."""

import os
import re
import subprocess
from pathlib import Path

import pytest
from conftest import REPOSITORY

pytestmark = pytest.mark.slow

# Of the make that runs this test, and of its virtual environment.
NOT_OF_A_NEWCOMER = ('MAKE', 'MFLAGS', 'VENV', 'VIRTUAL_ENV', 'PYTHON', 'PYTEST', 'GP_GROUND_SEG')


def newcomer() -> dict[str, str]:
    return {k: v for k, v in os.environ.items() if not k.startswith(NOT_OF_A_NEWCOMER)}


def try_it() -> str:
    """The commands of README's section "Try it"."""
    section = (REPOSITORY / 'README.md').read_text().split('\n## Try it\n')[1].split('\n## ')[0]
    (commands,) = re.findall(r'```sh\n(.*?)```', section, flags=re.DOTALL)
    return commands


def run(script: str, folder: Path) -> str:
    try:
        done = subprocess.run(
            ['bash', '-e', '-c', script], cwd=folder, env=newcomer(), stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=1200,
        )  # fmt: skip
    except subprocess.TimeoutExpired as late:
        pytest.fail(
            f'{script}\nhas not ended in {late.timeout:.0f} s, and printed:\n{late.output}'
        )
    assert done.returncode == 0, done.stdout
    assert 'Traceback' not in done.stdout, done.stdout
    return done.stdout


def test_the_commands_of_readme_work_one_after_the_other(tmp_path):
    clone = tmp_path / 'gp_ground_seg'
    run(f'git clone --quiet {REPOSITORY} {clone}', tmp_path)
    picture = clone / 'street.png'
    assert 'ground' in run(try_it(), clone)
    assert picture.stat().st_size > 10_000
    said = run('make demo', clone)
    assert 'IoU' in said and 'from PyPI into .venv-dev (about 600 MB)' in said
    assert re.search(r'\d+ of 600 MB, \d+ s left', said) or 'unpacking ...' in said
    said = run('make test', clone)
    assert re.search(r'\d+ passed', said)
    # What worked at first still does.
    picture.unlink()
    plot = next(line for line in try_it().splitlines() if line.startswith('gp-ground-seg'))
    run(f'source .venv/bin/activate && {plot}', clone)
    assert picture.exists()
