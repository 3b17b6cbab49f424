"""README from top to bottom in one clone: its commands, the demo, and some tests."""

import os
import re
from pathlib import Path

import pytest
from conftest import REPOSITORY, hilly_scan, run_shell

pytestmark = pytest.mark.slow

# Of the make that runs this test, and of its virtual environment.
NOT_OF_A_NEWCOMER = ('MAKE', 'MFLAGS', 'VENV', 'VIRTUAL_ENV', 'PYTHON', 'PYTEST', 'GP_GROUND_SEG')


def try_it(language: str) -> list[str]:
    """The blocks of a language of README's section "Try it"."""
    section = (REPOSITORY / 'README.md').read_text().split('\n## Try it\n')[1].split('\n## ')[0]
    return re.findall(rf'```{language}\n(.*?)```', section, flags=re.DOTALL)


def run(script: str, folder: Path) -> str:
    own = {k: v for k, v in os.environ.items() if not k.startswith(NOT_OF_A_NEWCOMER)}
    # All tests would take minutes, and run in the checkout.
    return run_shell(script, folder, {**own, 'PYTEST_ADDOPTS': 'test/data test/repo'})


def test_the_commands_of_readme_work_one_after_the_other(tmp_path):
    clone = tmp_path / 'gp_ground_seg'
    run(f'git clone --quiet {REPOSITORY} {clone}', tmp_path)
    (_, *draw), (demo, test) = (block.splitlines() for block in try_it('sh'))
    said = run('\n'.join(draw).replace('YOUR_SCAN', 'docs/scans/vls128_street.npz'), clone)
    assert said.count('m over the ground (estimated), level') == 2
    for name in ('street.png', 'mine.png'):
        assert (clone / name).stat().st_size > 10_000
    hilly_scan().astype('<f4')[:, [0, 1, 2, 2]].tofile(tmp_path / 'scan.bin')
    (tmp_path / 'five_lines.py').write_text(*try_it('python'))
    run(f'{clone}/.venv/bin/python five_lines.py', tmp_path)  # a clone in sight
    said = run(demo, clone)
    assert 'IoU' in said and 'from PyPI into .venv-dev' in said
    assert re.search(r'\d+ MB downloaded, \d+ MB in \.venv-dev', said)
    assert (clone / 'demo_output' / 'scan.png').stat().st_size > 10_000
    assert re.search(r'\d+ passed', run(test, clone))
    # What was tried leaves nothing that git would see.
    assert run('git status --porcelain', clone) == ''
