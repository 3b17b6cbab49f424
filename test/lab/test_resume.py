"""Data sets that are segmented into a folder: what is kept, and what is done again."""

import os
import shutil

import pytest
from cli_runner import error_line, run
from evaluation_samples import label_files, write_streets

from gp_ground_seg import __version__
from gp_ground_seg.cli import segment as command
from gp_ground_seg.cli.segment import PARAMETERS

pytestmark = pytest.mark.usefixtures('compiled_code')


@pytest.fixture(scope='module')
def segmented(tmp_path_factory):
    """A data set, and the folder into which it has been segmented."""
    root = write_streets(tmp_path_factory.mktemp('root'), s00=7, s08=5)
    assert run('segment', root, '-o', root.parent / 'out', '--quiet') == 0
    return root, root.parent / 'out'


def times(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob('*')}


def test_other_parameters_are_refused(segmented, tmp_path, monkeypatch, capsys):
    """The line says what differs, and what to do; the same words again change nothing."""
    (root, out), other = segmented, tmp_path / 'other'
    shutil.copytree(root, other)
    known, own = times(out), f'segment {__version__}, from {root}'
    assert run('segment', root, '-o', out) == 0
    assert capsys.readouterr().out == '12 of 12 were finished before\n'
    tolerance = 'ground_tolerance: 0.1', 'ground_tolerance: 0.2'
    for version, source, words, before, now in (
        (__version__, root, ['--set', 'label.ground_tolerance=0.2'], *tolerance),
        (__version__, root, ['--columns', '4'], own, f'{own}, columns 4'),
        ('9.9', root, [], own, f'segment 9.9, from {root}'),
        (__version__, other, [], own, f'segment {__version__}, from {other}'),
    ):
        monkeypatch.setattr(command, '__version__', version)
        assert run('segment', source, '-o', out, *words) == 2
        said = error_line(capsys)
        assert times(out) == known
        assert said.startswith(f'{out / PARAMETERS}: says "') and before in said and now in said
        assert said.endswith('; give another output folder, or --force to start anew')


def test_what_is_missing_or_older_than_its_input_is_done_again(segmented, tmp_path, capsys):
    (root, _), source, out = segmented, tmp_path / 'root', tmp_path / 'out'

    def said(*words):
        capsys.readouterr()
        assert run('segment', source, *words) == 0
        return capsys.readouterr().out

    shutil.copytree(root, source)
    inputs = sorted(source.rglob('*.bin'))
    for k, words in ((0, ['--preset', 'paper']), (9, [])):
        # The first writes nothing: other parameters are no matter then.
        os.truncate(inputs[k], 10)
        assert run('segment', source, '-o', out, *words) == 2
        assert f'{inputs[k]}: 10 bytes is not a whole number' in error_line(capsys)
        shutil.copyfile(inputs[1], inputs[k])
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
    known = label_files(out)
    (out / 'readme').write_text('mine')
    said('-o', out, '--set', 'label.ground_tolerance=0.2', '--force')
    assert label_files(out) != known and label_files(out).keys() == known.keys()
    assert (out / 'readme').read_text() == 'mine'
    assert run('config', 'check', out / PARAMETERS) == 0
    assert '1 unlike the default' in capsys.readouterr().out
