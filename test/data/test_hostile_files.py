"""Files, folders, names and streams of any kind: one line, exit code 2."""

import os
import subprocess
import sys

import numpy as np
import pytest
from bag_samples import scan, write_ros2_bag
from cli_runner import error_line, run
from evaluation_samples import write_frame

from gp_ground_seg.core.errors import shown

NAMES = ['a\x1b[31m\nb', os.fsdecode(b'a\xff\xfe'), 'a$\\x_{$', '[a*]{0}%s', ' a ']


def test_a_text_is_shown_in_one_line():
    assert shown('a ä 地\\') == 'a ä 地\\'
    assert shown('a\n\r\t\x1b[2J\x7f\x9b\u202e\u2028\udcff') == (
        r'a\n\r\t\x1b[2J\x7f\x9b\u202e\u2028\udcff'
    )


@pytest.mark.parametrize('name', NAMES)
def test_any_name_is_read_written_and_shown_escaped(tmp_path, monkeypatch, capsys, name):
    monkeypatch.chdir(tmp_path)
    points = scan(n_ground=6000)
    points.tofile(f'{name}.bin')
    write_ros2_bag(tmp_path / f'{name}.mcap')
    root = tmp_path / name
    write_frame(root, name, 0, points, np.full(len(points), 40, '<u4'))
    (tmp_path / f'{name}.yaml').write_text('sensor: {height: 1.7}')
    for words in (
        ['segment', f'{name}.bin', '-o', f'{name}.label', '--config', f'{name}.yaml'],
        ['segment', f'{name}.mcap', '-o', f'{name}_ground.mcap'],
        ['segment', root, '-o', f'{name}_out'],
        ['plot', 'scan', f'{name}.bin', '-o', f'{name}.svg'],
        ['evaluate', root, '--json', f'{name}.json'],
        ['evaluate', f'{name}.mcap', '--against', f'{name}.yaml'],
        ['config', 'check', f'{name}.yaml'],
    ):
        assert run(*words) == 0
        said = capsys.readouterr()
        assert all(line.isprintable() for line in (said.out + said.err).splitlines()), words
    assert run('segment', f'{name}.bin', '-o', f'{name}.label') == 2
    assert error_line(capsys) == f'{shown(name)}.label: exists already; --force replaces it'


COMMANDS = """\
segment NAME
segment NAME -o out
plot scan NAME -o a.png
evaluate NAME
experiment speed NAME
play NAME
config dump --config NAME
kitti-to-bag NAME --sequence 00 out
segment a.bin -o NAME
segment a.mcap -o NAME
kitti-to-bag root --sequence 00 NAME
plot scan a.bin -o NAME.png
""".splitlines()


@pytest.mark.parametrize('command', COMMANDS)
def test_loops_of_links_and_names_too_long_are_one_line(tmp_path, monkeypatch, capsys, command):
    monkeypatch.chdir(tmp_path)
    points = scan()
    points.tofile('a.bin')
    write_ros2_bag(tmp_path / 'a.mcap')
    write_frame(tmp_path / 'root', '00', 0, points, np.full(len(points), 40, '<u4'))
    for name in ('loop', 'loop.png'):
        os.symlink(f'{name}2', name)
        os.symlink(name, f'{name}2')
    for name in ('loop', 'long' * 100):
        assert run(*command.replace('NAME', name).split()) == 2
        assert name in error_line(capsys)
    assert os.readlink('loop') == 'loop2'


def in_shell(words, cwd):
    """Exit code, stdout and stderr of a command with the redirections of a shell."""
    # With it Python forgets what a full stream has refused; users mostly go without.
    line = f'env -u PYTHONUNBUFFERED {sys.executable} -m gp_ground_seg {words}'
    done = subprocess.run(line, shell=True, cwd=cwd, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.slow
def test_streams_that_are_closed_or_full(tmp_path):
    full = 'No space left on device\n'
    for words, code, said, errors in (
        ('config dump >/dev/full', 2, '', f'input or output: {full}'),
        ('config dump >&-', 0, '', ''),
        ('config dump <&- >&- 2>&-', 0, '', ''),
        ('config dump --config b.yaml 2>/dev/full', 2, '', ''),
        ('config dump --config b.yaml 2>&-', 2, '', ''),
        ('config check b.yaml 2>&-', 2, '', ''),
        ('confg 2>/dev/full', 2, '', ''),
    ):
        prefix = 'gp-ground-seg: error: ' if errors else ''
        assert in_shell(words, tmp_path) == (code, said, prefix + errors), words
    # A note that cannot be shown stops nothing.
    scan().tofile(tmp_path / 'a.bin')
    code, said, _ = in_shell('segment a.bin -o a.label --force 2>/dev/full', tmp_path)
    assert code == 0
    assert said.endswith('rad\n')
    assert (tmp_path / 'a.label').exists()
