"""Data sets that are segmented block by block: what is kept, and what is done again."""

import fcntl
import json
import os
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
from bag_samples import scan, write_ros2_bag
from cli_runner import INTERRUPTED, children, error_line, is_running, run, start, wait_for
from evaluation_samples import label_files, write_streets, write_two_drives

from gp_ground_seg.cli import options
from gp_ground_seg.core.errors import DataError
from gp_ground_seg.data import files

pytestmark = pytest.mark.usefixtures('compiled_code')


@pytest.fixture(scope='module')
def root(tmp_path_factory):
    return write_two_drives(tmp_path_factory.mktemp('root'))


def finished(folder):
    """Names in the record of what is written, in its order."""
    lines = (folder / 'outputs.jsonl').read_text().splitlines()
    return [name for line in lines for name in json.loads(line).get('written', {})]


def test_several_bags_become_one_each(tmp_path, capsys):
    names = ['a', 'b']
    for k, name in enumerate(names):
        write_ros2_bag(tmp_path / f'{name}.mcap', n_clouds=2 + k)
        assert run('segment', tmp_path / f'{name}.mcap', '--quiet') == 0
    bags = [tmp_path / f'{name}.mcap' for name in names]
    command = ['segment', *bags, '-o', tmp_path / 'out']
    assert run(*command) == 0
    for name in names:
        file = f'{name}_ground.mcap'
        assert (tmp_path / 'out' / file).read_bytes() == (tmp_path / file).read_bytes()
    assert '5 frames' in capsys.readouterr().out
    # A block for each, which is kept if the next one is interrupted.
    assert (tmp_path / 'out/outputs.jsonl').read_text().count('written') == len(names)
    assert run(*command) == 0
    assert capsys.readouterr().out == '2 of 2 were finished before\n'
    bags[1].unlink()
    write_ros2_bag(bags[1], n_clouds=4)
    assert run(*command) == 0
    assert capsys.readouterr().out.startswith('1 of 2 were finished before\n4 frames, ')


def test_what_is_there_is_kept_and_other_parameters_are_refused(root, tmp_path, capsys):
    out = tmp_path / 'out'
    command = ['segment', root, '-o', out]
    assert run(*command) == 0
    before, times = label_files(out), {path: path.stat().st_mtime_ns for path in out.rglob('*')}
    assert run(*command) == 0
    assert capsys.readouterr().out.endswith('12 of 12 were finished before\n')
    assert {path: path.stat().st_mtime_ns for path in out.rglob('*')} == times
    other = ['--set', 'label.ground_tolerance=0.2']
    for words in (other, ['--columns', '4']):
        assert run(*command, *words) == 2
        assert f'{out}/parameters.yaml: says other parameters' in error_line(capsys)
    assert label_files(out) == before
    assert run(*command, '--force', *other) == 0
    assert label_files(out) != before
    assert sorted(finished(out)) == sorted(before)
    assert run('config', 'check', out / 'parameters.yaml') == 0
    assert '1 differs from the defaults' in capsys.readouterr().out


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
    assert 'backend: numpy' in (out / 'parameters.yaml').read_text()


def test_what_does_not_fit_is_done_again(root, tmp_path, capsys):
    source, out, other = tmp_path / 'root', tmp_path / 'out', tmp_path / 'other'

    def said(*words):
        capsys.readouterr()
        assert run('segment', *words) == 0
        return capsys.readouterr().out

    shutil.copytree(root, source)
    said(source, '-o', out)
    inputs, outputs = sorted(source.rglob('*.bin')), sorted(out.rglob('*.label'))
    # Another content of the same size; a file that was written before, as of `cp -p`.
    (np.fromfile(inputs[0], '<f4').reshape(-1, 4) * (1, -1, 1, 1)).astype('<f4').tofile(inputs[0])
    scan(9, n_ground=900).tofile(inputs[1])
    os.utime(inputs[1], (1e9, 1e9))
    for output in outputs[2], outputs[4], outputs[5]:
        output.unlink()
    os.truncate(outputs[3], outputs[3].stat().st_size + 4)
    outputs[4].symlink_to('nowhere')
    inputs[5].unlink()
    assert said(source, '-o', out).startswith('6 of 11 were finished before\n5 frames, ')
    said(source, '-o', tmp_path / 'anew')
    assert label_files(out) == label_files(tmp_path / 'anew')
    assert said(source, '-o', out) == '11 of 11 were finished before\n'
    # A copy with its times is the same, but for the scans that have changed.
    shutil.copytree(source, other)
    files = sorted(other.rglob('*.bin'))
    files[0].replace(files[1])
    shutil.copy(files[2], files[0])
    assert said(other, '-o', out).startswith('9 of 11 were finished before\n2 frames, ')
    said(other, '-o', tmp_path / 'anew', '--force')
    assert label_files(out) == label_files(tmp_path / 'anew')


def flip(file):
    """Another content of the same size."""
    data = bytearray(file.read_bytes())
    data[7] ^= 1
    file.write_bytes(data)


def test_a_changed_output_is_written_again_and_what_was_there_is_kept(root, tmp_path, capsys):
    out = tmp_path / 'out'
    command = ['segment', root, '-o', out]
    assert run(*command) == 0
    whole = label_files(out)
    touched, changed = sorted(out.rglob('*.label'))[:2]
    touched.touch()  # another time, as of a copy
    flip(changed)
    edited = changed.read_bytes()
    capsys.readouterr()
    assert run(*command) == 0
    said = capsys.readouterr()
    assert said.out.startswith('11 of 12 were finished before\n1 frame, ')
    note = f'{changed}: was changed since it was written, is {changed.name}.changed now'
    assert f'gp-ground-seg: note: {note}\n' in said.err
    assert label_files(out) == whole
    assert changed.with_name(f'{changed.name}.changed').read_bytes() == edited
    flip(changed)
    assert run(*command) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f'{changed}: was changed since it was written, and {changed}.changed is there' in line
    assert run(*command, '--force') == 0
    assert label_files(out) == whole


def test_all_is_on_disk_before_it_counts_as_finished(root, tmp_path, monkeypatch):
    """Each file and the folders above it: a power failure leaves no hole in what is finished."""
    flushed, lines, sync = [], [], os.fsync

    def note(number):
        path = Path(os.readlink(f'/proc/self/fd/{number}'))
        if path.name == 'outputs.jsonl':
            lines.append((path.read_text().splitlines()[-1], set(flushed)))
        flushed.append(path.parent / path.name[1:].partition('.partial-')[0] or path)
        flushed.append(path)
        sync(number)

    monkeypatch.setattr(os, 'fsync', note)
    out = tmp_path / 'out'
    assert run('segment', root, '-o', out) == 0
    begun, *written = lines
    assert 'to_write' in begun[0] and out / 'parameters.yaml' in begun[1]
    names = set()
    for line, before in written:
        for name in json.loads(line)['written']:
            names.add(name)
            assert {out / name, *(out / name).parents} - {*out.parents} <= before
    assert len(names) == 12
    flushed.clear()
    assert run('segment', next(root.rglob('*.bin')), '-o', tmp_path / 'a.label') == 0
    assert flushed[-1] == tmp_path


@pytest.mark.parametrize('line', [b'{', b'[' * 100_000, b'{"written": 3}', b'\xff', b'7', b'null'])
def test_a_record_that_is_none(line, root, tmp_path, capsys):
    (tmp_path / 'outputs.jsonl').write_bytes(line + b'\n')
    assert run('segment', root, '-o', tmp_path) == 2
    said = f'{tmp_path}/outputs.jsonl: line 1 is none of a record; --force starts anew'
    assert error_line(capsys) == said
    assert (tmp_path / 'outputs.jsonl').read_bytes() == line + b'\n'
    assert run('segment', root, '-o', tmp_path, '--force') == 0


def test_a_run_that_was_killed_goes_on_and_nothing_is_done_twice(root, tmp_path, capsys):
    out = tmp_path / 'out'
    command, record = ['segment', root, '-o', out], out / 'outputs.jsonl'
    assert run(*command) == 0
    whole = label_files(out)
    planned, first, *_ = record.read_bytes().splitlines(keepends=True)
    # It was writing a line, and a file.
    record.write_bytes(planned + first + b'{"written": {"na')
    (out / 'sequences/00/predictions/.000999.label.partial-0').touch()
    before = [*json.loads(first)['written']]
    assert 0 < len(before) < 12
    times = {name: (out / name).stat().st_mtime_ns for name in before}
    capsys.readouterr()
    with record.open('rb') as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        for more in ('--force', '--quiet'):
            assert run(*command, more) == 2
            assert error_line(capsys) == f'{out}: another run writes to it'
    assert run(*command) == 0
    assert f'{len(before)} of 12 were finished before' in capsys.readouterr().out
    assert sorted(finished(out)) == sorted(whole)
    assert {name: (out / name).stat().st_mtime_ns for name in before} == times
    assert label_files(out) == whole
    assert not [path for path in out.rglob('*') if 'partial' in path.name]


@pytest.mark.slow
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGKILL])
def test_all_processes_end_with_a_run_that_is_stopped_and_nothing_is_lost(
    tmp_path, capsys, number
):
    root, record = write_streets(tmp_path / 'root', s00=1), tmp_path / 'out/outputs.jsonl'
    scan, *_ = root.rglob('*.bin')
    for k in range(1, 600):
        scan.with_name(f'{k:06d}.bin').hardlink_to(scan)
    words = 'segment', root, '-o', record.parent
    process = start(*words, '--workers', '2', start_new_session=True)
    # The first line is of what is to be written.
    wait_for(lambda: record.exists() and record.read_bytes().count(b'\n') >= 2, 'two lines')
    workers = children(process.pid)
    if number == signal.SIGINT:
        os.killpg(process.pid, number)
        assert process.communicate() == ('', 'gp-ground-seg: interrupted\n')
        assert process.returncode in INTERRUPTED
    else:
        os.kill(workers[-1], signal.SIGKILL)
        wait_for(lambda: record.read_bytes().count(b'\n') >= 5, 'three more lines')
        workers += children(process.pid)
        process.kill()
        said = process.communicate()[1]
        assert 'a worker died; computed again: ' in said and 'Traceback' not in said
    wait_for(lambda: not any(map(is_running, workers)), 'end of all processes')
    out, before = record.parent, finished(record.parent)
    times = {name: (out / name).stat().st_mtime_ns for name in before}
    assert 0 < len(before) < 600
    assert run(*words) == 0
    assert f'{len(before)} of 600 were finished before' in capsys.readouterr().out
    assert {name: (out / name).stat().st_mtime_ns for name in before} == times
    found = label_files(out)
    assert sorted(finished(out)) == sorted(found) and len(found) == 600
    assert len(set(found.values())) == 1
    assert len(list((out / 'sequences/00/predictions').iterdir())) == 600


def test_a_folder_of_that_name_is_kept(tmp_path):
    (tmp_path / 'file').mkdir()
    with pytest.raises(DataError, match='cannot be written'):
        files.write_file(tmp_path / 'file', b'')
    assert [p.name for p in tmp_path.iterdir()] == ['file']
