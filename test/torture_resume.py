"""Data sets whose inputs, outputs or record change between two runs; two runs at once.

After a second run the labels are those of a new run, or it is refused with one line and nothing
has changed: `python test/torture_resume.py FIRST STOP`.
"""

import contextlib
import io
import os
import shutil
import signal
import tempfile
from pathlib import Path

import numpy as np
from bag_samples import scan
from cli_runner import run, start
from evaluation_samples import label_files
from torture_cases import run_cases

N_SCANS = {'00': 5, '08': 4}


def make_root(root):
    for sequence, n_scans in N_SCANS.items():
        folder = root / 'sequences' / sequence / 'velodyne'
        folder.mkdir(parents=True)
        for k in range(n_scans):
            scan(k).tofile(folder / f'{k:06d}.bin')


def one_of(rng, folder, pattern):
    return rng.choice(sorted(folder.rglob(pattern)))


def change_input(rng, source, _out):
    """Of the same size."""
    file = one_of(rng, source, '*.bin')
    (np.fromfile(file, '<f4').reshape(-1, 4) * (1, -1, 1, 1)).astype('<f4').tofile(file)


def replace_input(rng, source, _out):
    """By a file that was written before, as `cp -p` does."""
    file = one_of(rng, source, '*.bin')
    scan(9, n_ground=900).tofile(file)
    os.utime(file, (1e9, 1e9))


def add_input(rng, source, _out):
    scan(7).tofile(one_of(rng, source, 'velodyne') / '000009.bin')


def delete_input(rng, source, out):
    file = one_of(rng, source, '00*/velodyne/*.bin')
    file.unlink()
    sequence, stem = file.parts[-3], file.stem
    (out / f'sequences/{sequence}/predictions/{stem}.label').unlink(missing_ok=True)


def move_root(_rng, source, _out):
    """Other scans of the same names at the place of the input."""
    folder = source / 'sequences'
    for file in folder.rglob('*.bin'):
        scan(20 + int(file.stem)).tofile(file)


def delete_output(rng, _source, out):
    one_of(rng, out, '*.label').unlink()


def resize_output(rng, _source, out):
    file = one_of(rng, out, '*.label')
    os.truncate(file, rng.choice([0, 4, file.stat().st_size - 1, file.stat().st_size + 4]))


def link_output(rng, _source, out):
    file = one_of(rng, out, '*.label')
    file.unlink()
    file.symlink_to('nowhere')


def cut_record(rng, _source, out):
    file = out / 'outputs.jsonl'
    os.truncate(file, rng.integers(file.stat().st_size + 1))


def flip_record(rng, _source, out):
    file = out / 'outputs.jsonl'
    data = bytearray(file.read_bytes())
    if data:
        data[rng.integers(len(data))] ^= 1 << rng.integers(8)
    file.write_bytes(data)


def delete_record(_rng, _source, out):
    (out / 'outputs.jsonl').unlink()


def leave_partial(_rng, _source, out):
    (out / 'sequences/00/predictions/.000001.label.partial-7').write_bytes(b'four')


HARMS = [
    change_input, replace_input, add_input, delete_input, move_root, delete_output,
    resize_output, link_output, cut_record, flip_record, delete_record, leave_partial,
]  # fmt: skip


def said_by(*words):
    """Exit code of a command, and what it printed."""
    with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.redirect_stderr(text):
        code = run(*words)
    return code, text.getvalue()


def harm(rng, command, source, out, anew):
    """Return what is wrong after some harm and a second run, or None."""
    code, said = said_by(*command, '-o', out)
    assert code == 0, said
    chosen = [HARMS[k] for k in rng.choice(len(HARMS), rng.integers(1, 4), replace=False)]
    for each in chosen:
        with contextlib.suppress(FileNotFoundError):  # of a record that was deleted
            each(rng, source, out)
    what, before = ', '.join(each.__name__ for each in chosen), label_files(out)
    code, said = said_by(*command, '-o', out)
    if code == 2:
        is_damaged = {cut_record, flip_record, delete_record} & set(chosen)
        if not (is_damaged and said.count('\n') == 1 and label_files(out) == before):
            return f'{what}: {said[-300:]!r}'
        code, said = said_by(*command, '-o', out, '--force')
    if code != 0:
        return f'{what}: exit code {code}: {said[-300:]!r}'
    assert said_by(*command, '-o', anew)[0] == 0
    if label_files(out) != label_files(anew):
        return f'{what}: the labels are not those of a new run'
    return None


def compete(rng, command, _source, out, anew):
    """Return what is wrong after two runs at once, one of them killed in some cases, or None."""
    words = rng.choice(['--quiet', '--force'], 2)
    two = [start(*command, '-o', out, each) for each in words]
    if is_killed := rng.random() < 0.5:
        with contextlib.suppress(Exception):
            two[0].wait(rng.uniform(1.5, 4.0))
        two[0].send_signal(signal.SIGKILL)
    for each in two:
        said = each.communicate(timeout=120)[1]
        refused = each.returncode == 2 and 'another run writes to it' in said
        if not (refused or each.returncode in (0, -signal.SIGKILL)) or 'Traceback' in said:
            return f'{words}: exit code {each.returncode}: {said[-300:]!r}'
    if not is_killed and not any(each.returncode == 0 for each in two):
        return f'{words}: both were refused'
    code, said = said_by(*command, '-o', out)
    if code == 2 and is_killed and '--force replaces them' in said:  # killed before the record
        code, said = said_by(*command, '-o', out, '--force')
    assert said_by(*command, '-o', anew)[0] == 0
    if code != 0 or label_files(out) != label_files(anew):
        return f'{words}: not continued: exit code {code}: {said[-300:]!r}'
    return None


def run_case(number, folder):
    """Return what is wrong in one case, or None."""
    rng = np.random.default_rng([11, number])
    source, out, anew = folder / 'source', folder / 'out', folder / 'anew'
    shutil.copytree(folder / 'root', source)
    command = ['segment', source, '--quiet']
    try:
        return (compete if number % 6 == 5 else harm)(rng, command, source, out, anew)
    finally:
        for path in (source, out, anew):
            shutil.rmtree(path, ignore_errors=True)


if __name__ == '__main__':
    with tempfile.TemporaryDirectory() as folder_name:
        make_root(Path(folder_name, 'root'))
        run_cases(lambda number: run_case(number, Path(folder_name)))
