"""Data sets that are segmented into a folder: what is kept, and what is done again."""

import os
import shutil
from pathlib import Path

import pytest
from bag_samples import write_ros2_bag
from cli_runner import error_line, run
from evaluation_samples import label_files, write_two_drives

from gp_ground_seg import __version__
from gp_ground_seg.cli import options
from gp_ground_seg.cli import segment as command
from gp_ground_seg.lab.dataset import PARAMETERS

pytestmark = pytest.mark.usefixtures('compiled_code')


@pytest.fixture(scope='module')
def root(tmp_path_factory):
    return write_two_drives(tmp_path_factory.mktemp('root'))


def times(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob('*')}


def test_several_bags_become_one_each(tmp_path, capsys):
    names = ['a', 'b']
    for k, name in enumerate(names):
        write_ros2_bag(tmp_path / f'{name}.mcap', n_clouds=2 + k)
        assert run('segment', tmp_path / f'{name}.mcap', '--quiet') == 0
    bags = [tmp_path / f'{name}.mcap' for name in names]
    words = ['segment', *bags, '-o', tmp_path / 'out']
    assert run(*words) == 0
    for name in names:
        file = f'{name}_ground.mcap'
        assert (tmp_path / 'out' / file).read_bytes() == (tmp_path / file).read_bytes()
    assert '5 frames' in capsys.readouterr().out
    assert run(*words) == 0
    assert capsys.readouterr().out == '2 of 2 were finished before\n'
    bags[1].unlink()
    write_ros2_bag(bags[1], n_clouds=4)
    assert run(*words) == 0
    assert capsys.readouterr().out.startswith('1 of 2 were finished before\n4 frames, ')


def test_what_is_there_is_kept_and_replaced_with_force_only(root, tmp_path, capsys):
    out = tmp_path / 'out'
    assert run('segment', root, '-o', out) == 0
    before, known = label_files(out), times(out)
    assert run('segment', root, '-o', out) == 0
    assert capsys.readouterr().out.endswith('12 of 12 were finished before\n')
    assert times(out) == known
    words = ['segment', root, '-o', out, '--set', 'label.ground_tolerance=0.2', '--force']
    assert run(*words) == 0
    assert label_files(out) != before and len(label_files(out)) == 12
    assert run('config', 'check', out / PARAMETERS) == 0
    assert '1 differs from the defaults' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('more', 'version', 'before', 'now'),
    [
        ('--set label.ground_tolerance=0.2', '', 'ground_tolerance: 0.1', 'ground_tolerance: 0.2'),
        ('--columns 4', '', 'segment VERSION, from ROOT', 'segment VERSION, from ROOT, columns 4'),
        ('', '9.9', 'segment VERSION, from ROOT', 'segment 9.9, from ROOT'),
        ('OTHER', '', 'segment VERSION, from ROOT', 'segment VERSION, from OTHER'),
    ],
)
def test_other_parameters_are_refused(
    more, version, before, now, root, tmp_path, monkeypatch, capsys
):
    """The line says what differs, and what to do."""
    out, other = tmp_path / 'out', tmp_path / 'other'
    shutil.copytree(root, other)
    assert run('segment', root, '-o', out) == 0
    known = times(out)
    if version:
        monkeypatch.setattr(command, '__version__', version)
    capsys.readouterr()
    source = other if more == 'OTHER' else root
    assert run('segment', source, '-o', out, *more.replace('OTHER', '').split()) == 2
    said = error_line(capsys)
    for name, value in (('VERSION', __version__), ('ROOT', root), ('OTHER', other)):
        before, now = before.replace(name, str(value)), now.replace(name, str(value))
    assert times(out) == known
    assert said.startswith(f'{out / PARAMETERS}: says "') and before in said and now in said
    assert said.endswith('; give another output folder, or --force to start anew')


def test_a_folder_goes_on_with_the_backend_that_it_was_begun_with(root, tmp_path, monkeypatch):
    """Whatever has been compiled meanwhile; values differ in their last digits."""
    source, out, whole = root / 'sequences/00', tmp_path / 'out', tmp_path / 'whole'
    monkeypatch.setattr(options, 'has_to_compile', lambda: True)
    for folder in (out, whole):
        assert run('segment', source, '-o', folder, '--format', 'ply') == 0
    (out / '000003.ply').unlink()
    monkeypatch.setattr(options, 'has_to_compile', lambda: False)
    assert run('segment', source, '-o', out, '--format', 'ply') == 0
    for file in whole.glob('*.ply'):
        assert (out / file.name).read_bytes() == file.read_bytes()
    assert 'backend: numpy' in (out / PARAMETERS).read_text()


def test_what_is_missing_or_older_than_its_input_is_done_again(root, tmp_path, capsys):
    source, out = tmp_path / 'root', tmp_path / 'out'

    def said(*words):
        capsys.readouterr()
        assert run('segment', source, *words) == 0
        return capsys.readouterr().out

    shutil.copytree(root, source)
    inputs = sorted(source.rglob('*.bin'))
    os.truncate(inputs[9], 10)
    assert run('segment', source, '-o', out) == 2
    assert f'{inputs[9]}: 10 bytes is not a whole number' in error_line(capsys)
    shutil.copyfile(inputs[0], inputs[9])
    assert said('-o', out).startswith('9 of 12 were finished before\n3 frames, ')
    outputs = sorted(out.rglob('*.label'))
    shutil.copyfile(inputs[7], inputs[0])
    for output in outputs[1:5]:
        output.unlink()
    outputs[2].symlink_to('nowhere')
    outputs[3].parent.joinpath(f'.{outputs[3].name}.partial-0').mkdir()  # of a run that was killed
    inputs[4].unlink()
    assert said('-o', out).startswith('7 of 11 were finished before\n4 frames, ')
    said('-o', tmp_path / 'anew')
    assert label_files(out) == label_files(tmp_path / 'anew')
    assert said('-o', out) == '11 of 11 were finished before\n'
    assert not [path for path in out.rglob('*') if '.partial-' in path.name]
    # A run with --force was killed: it had written the parameters and one file.
    (out / PARAMETERS).touch()
    outputs[0].touch()
    assert said('-o', out).startswith('1 of 11 were finished before\n10 frames, ')


def test_a_file_has_its_name_when_it_is_on_disk(root, tmp_path, monkeypatch):
    """A power failure leaves no hole in what is finished."""
    calls, sync, rename = [], os.fsync, os.rename

    def note_sync(number):
        sync(number)
        calls.append(Path(os.readlink(f'/proc/self/fd/{number}')))

    def note_rename(source, target):
        assert source in calls
        rename(source, target)
        calls.append(target)

    monkeypatch.setattr(os, 'fsync', note_sync)
    monkeypatch.setattr(os, 'rename', note_rename)
    out = tmp_path / 'out'
    assert run('segment', root, '-o', out) == 0
    written = [out / PARAMETERS, *(out / name for name in label_files(out))]
    assert len(written) == 13
    for path in written:
        assert path.parent in calls[calls.index(path) :]
