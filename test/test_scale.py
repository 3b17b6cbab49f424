"""Whole data sets: one process, workers and a scheduler alike; what dies, and how it goes on."""

import csv
import json
import logging
import os
import re
import resource
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from bag_samples import write_ros2_bag
from cli_runner import INTERRUPTED, children, error_line, is_running, run, start
from evaluation_samples import street, write_frame, write_streets
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg.core.errors import DataError
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.lab.scale import cluster

dask, distributed = pytest.importorskip('dask'), pytest.importorskip('distributed')
# Dask leaves sockets and event loops to the garbage collector when its processes end.
pytestmark = pytest.mark.filterwarnings('ignore::pytest.PytestUnraisableExceptionWarning')

PAST = ['--set', 'learning.mode=first_frame']
N_FRAMES = 600  # of the long sequence
ATTACK = """
import asyncio, os, sys, dask, distributed
from distributed.protocol.pickle import dumps

async def attack(address, security):
    given = security.get_connection_args('worker') if security else {}
    async with distributed.rpc(address, connection_args=given) as remote:
        run = remote.run_function if address.endswith(sys.argv[1]) else remote.run
        print((await run(function=dumps(os.getpid)))['result'])

dask.config.set({'distributed.comm.timeouts.connect': '3s'})
for scheme, security in ('tcp', None), ('tls', distributed.Security.temporary()):
    for place in sys.argv[1:]:
        try:
            asyncio.run(attack(f'{scheme}://{place}', security))
        except (OSError, ValueError) as error:
            print(type(error).__name__, file=sys.stderr)
"""
"""Prints the process id of a scheduler, and of workers after it: runs code in them without their
key."""


@pytest.fixture(scope='module')
def root(tmp_path_factory):
    """Two sequences whose scans differ, so that what is learned from the first matters."""
    folder = tmp_path_factory.mktemp('root')
    for sequence, n_frames in (('00', 7), ('08', 5)):
        for k in range(n_frames):
            points, semantic = street(seed=k)
            points[:, 2] += np.float32(0.01 * k) * np.sin(points[:, 0])
            write_frame(folder, sequence, k, points, semantic)
    return folder


@pytest.fixture(scope='module')
def scheduler():
    """Address of a cluster of two workers that was not started by a command."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address='127.0.0.1:0',
        silence_logs=logging.CRITICAL,
    ) as started:  # fmt: skip
        yield started.scheduler_address


def everything(path):
    """Numbers of a report but for times, and what it ran on."""
    document = json.loads(path.read_text())
    for name in ('environment', 'n_threads', 'times', 'stages'):
        document.pop(name, None)
    if 'measures' in document:
        assert document['measures'].pop()['measure'].startswith('time')
    for row in document['rows']:
        row.pop('seconds', None)
    measures = document.get('measures', [])
    document['measures'] = [each for each in measures if '[ms]' not in each['measure']]
    return document


def labels(folder):
    """Label files below a folder, by path."""
    files = sorted(Path(folder).rglob('*.label'))
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def finished(folder):
    """Names in the manifest, in its order."""
    lines = (folder / 'manifest.jsonl').read_text().splitlines()
    return [name for line in lines for name in json.loads(line)['items']]


@pytest.fixture
def assert_same(scheduler, tmp_path, capsys):
    """Run a command here and on the cluster: the reports are equal to the last digit."""

    def compare(said, *words):
        assert run(*words, '--json', tmp_path / 'here.json') == 0
        assert said not in capsys.readouterr().out
        assert run(*words, '--json', tmp_path / 'there.json', '--scheduler', scheduler) == 0
        assert everything(tmp_path / 'there.json') == everything(tmp_path / 'here.json')
        assert said in capsys.readouterr().out

    return compare


@pytest.mark.parametrize('more', [[], PAST, ['--peer', 'patchworkpp']])
def test_an_evaluation_is_the_same_to_the_last_digit(root, assert_same, more):
    assert_same(', 2 workers beside one another  [ms]', 'evaluate', root, *more)


@pytest.mark.parametrize(
    'words',
    [
        ['ablation'],
        ['coverage'],
        ['objects', '--sensors', 'vlp-16', '--scenes', 'urban,car_park', '--seeds', '1'],
    ],
    ids=lambda words: words[0],
)
def test_an_experiment_is_the_same_to_the_last_digit(words, root, assert_same):
    given = [root] if len(words) == 1 else []
    assert_same('workers with 2 threads in all', 'experiment', *words, *given)


def test_labels_are_the_same_with_any_number_of_workers(root, scheduler, tmp_path, capsys):
    assert run('segment', root, '-o', tmp_path / '0', *PAST) == 0
    for n, words in (('1', ['--workers', '1']), ('2', ['--scheduler', scheduler])):
        assert run('segment', root, '-o', tmp_path / n, *words, *PAST) == 0
        said = capsys.readouterr()
        assert f'in each of {n} worker' in said.out
        assert said.err == '' or '--scheduler' in words
        assert labels(tmp_path / n) == labels(tmp_path / '0')
    for name in ('00', '08'):
        assert run('segment', root / 'sequences' / name, '-o', tmp_path / 'alone', *PAST) == 0
        assert labels(tmp_path / 'alone') == labels(tmp_path / f'0/sequences/{name}/predictions')
        shutil.rmtree(tmp_path / 'alone')
    assert len(labels(tmp_path / '0')) == 12


@given(
    st.lists(st.tuples(st.integers(0, 3), st.integers(1, 200)), max_size=5),
    st.booleans(),
    st.integers(1, 9),
)
def test_blocks_hold_every_item_once_and_groups_stay_whole(groups, grouped, n_workers):
    items = [(k, name, i) for k, (name, n) in enumerate(groups) for i in range(n)]
    blocks = cluster.cut(items, (lambda item: item[:2]) if grouped else None, n_workers)
    assert [item for block in blocks for item in block] == items
    if grouped:
        assert len(blocks) == len(groups)
    else:
        assert all(len(block) <= cluster.BLOCK_SIZE for block in blocks)
        assert len(blocks) >= min(len(items), n_workers)


def test_only_past_that_counts_keeps_sequences_whole():
    def depends(**changes):
        named = {f'learning.{name}': value for name, value in changes.items()}
        return cluster.depends_on_past(Config().replace(**named))

    assert not depends() and not depends(mode='fixed', warm_start=True)
    assert depends(mode='every_k') and depends(mode='first_frame') and depends(warm_start=True)


def _module_path():
    return sys.path


def _die_once(marker, block, progress):
    if 5 in block and not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return sum(progress(block))


def _fail(block, progress):
    raise DataError('00/000003: truncated?')


def _log(block, progress):
    logging.getLogger('gp_ground_seg').warning('the surface is odd')
    return len(block)


def test_a_block_whose_worker_dies_is_computed_again(scheduler, tmp_path, caplog):
    with cluster.open_runner(None, scheduler, cluster._NO_BAR) as runner:
        found = runner.run(partial(_die_once, tmp_path / 'died'), range(40))
        assert sum(found) == sum(range(40)) and (tmp_path / 'died').exists()
        assert [line for line in caplog.messages if 'died; computed again: block' in line]
        caplog.clear()
        with pytest.raises(DataError, match=r'^00/000003: truncated\?'):
            runner.run(_fail, range(40))
        assert sum(runner.run(_log, range(40))) == 40
    assert caplog.messages == ['the surface is odd']


def attack(client):
    """Process ids of the scheduler and workers that run another's code, and what failed."""
    addresses = [client.scheduler.address, *client.nthreads()]
    places = [address.split('//')[1] for address in addresses]
    done = subprocess.run(
        [sys.executable, '-c', ATTACK, *places], capture_output=True, text=True, check=True
    )
    return [int(line) for line in done.stdout.splitlines()], done.stderr.splitlines()


def test_workers_of_this_machine_run_the_code_of_this_process_only(
    scheduler, monkeypatch, tmp_path
):
    # A cluster with pages, begun after ours were left out, adds to Dask's list of them.
    cluster._distributed()
    with distributed.LocalCluster(n_workers=0, dashboard_address='127.0.0.1:0'):
        pass
    with distributed.Client(scheduler, set_as_default=False) as client:
        ran, _ = attack(client)
        assert ran[0] == os.getpid() and len(ran) > 1
    monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path))
    planted, target = tmp_path / 'dask-scratch-space', tmp_path / 'of_the_user'
    planted.mkdir()
    target.write_text('kept')
    for name in ('global.lock', 'purge.lock'):
        (planted / name).symlink_to(target)
    with cluster.open_runner(1, None, cluster._NO_BAR) as runner:
        info = runner._client.scheduler_info()
        (worker,) = info['workers'].values()
        (folder,) = tmp_path.glob('gp_ground_seg-*')
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        assert worker['local_directory'].startswith(str(folder))
        ran, failed = attack(runner._client)
        assert not ran and len(failed) == 4
        for port in (info['services']['dashboard'], worker['services']['dashboard']):
            for page in ('', 'health', 'info/main/workers.html', 'metrics'):
                with pytest.raises(urllib.error.HTTPError, match='404'):
                    urllib.request.urlopen(f'http://127.0.0.1:{port}/{page}')
        for path in (sys.path, *runner._client.run(_module_path).values()):
            assert not any(name.startswith(str(planted)) for name in path)
        assert sum(runner.run(partial(_die_once, tmp_path), range(3))) == 3
    assert target.read_text() == 'kept'
    assert sorted(path.name for path in tmp_path.iterdir()) == [planted.name, target.name]


@pytest.mark.parametrize(
    ('n_workers', 'problem'),
    [
        ('2', 'needs 96 open files, the limit is 40'),
        ('2', 'Dask cannot start here (Nanny failed to start worker process)'),
        ('99999999999', 'must be 1 to'),
    ],
    ids=['few files', 'killed worker', 'many workers'],
)
def test_dask_that_cannot_start(n_workers, problem, root, tmp_path):
    limit = {'preexec_fn': partial(resource.setrlimit, resource.RLIMIT_NOFILE, (40, 40))}
    command = ('segment', root, '-o', tmp_path / 'out', '--workers', n_workers)
    with start(*command, **limit if 'files' in problem else {}) as process:
        if 'Nanny' in problem:
            deadline, found = time.monotonic() + 60, []
            while not found:
                assert process.poll() is None and time.monotonic() < deadline
                found = [one for one in children(process.pid) if is_worker(one)]
                time.sleep(0.01)
            os.kill(found[0], signal.SIGKILL)
        out, err = process.communicate(timeout=60)
    (line,) = err.splitlines()
    assert (out, process.returncode) == ('', 2) and problem in line
    assert not (tmp_path / 'out').exists()


def is_worker(pid):
    """Whether a process is one that Dask starts."""
    try:
        return b'spawn_main' in Path(f'/proc/{pid}/cmdline').read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.parametrize(
    ('address', 'problem'),
    [
        ('tcp://127.0.0.1:1', 'does not answer'),
        ('tls://127.0.0.1:1', 'does not answer'),
        ('somewhere', 'must be tcp://HOST:PORT'),
    ],
)
def test_a_scheduler_that_is_not_there(address, problem, root, monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(cluster._CONFIG, 'distributed.comm.timeouts.connect', '200ms')
    command = ['segment', root, '-o', tmp_path / 'out']
    assert run(*command, '--scheduler', address) == 2
    assert problem in error_line(capsys)
    assert run(*command) == 0


def test_a_scheduler_that_asks_for_a_key(root, tmp_path, capsys):
    security = distributed.Security.temporary()
    config = {
        'distributed.comm.tls.ca-file': security.tls_ca_file,
        'distributed.comm.tls.client.cert': security.tls_client_cert,
        'distributed.comm.tls.client.key': security.tls_client_key,
    }
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address='127.0.0.1:0', security=security,
        silence_logs=logging.CRITICAL,
    ) as started:  # fmt: skip
        command = ['segment', root, '-o', tmp_path, '--scheduler', started.scheduler_address]
        assert run(*command) == 2
        assert 'does not answer' in error_line(capsys)
        with dask.config.set(config):
            assert run(*command) == 0
    assert len(labels(tmp_path)) == 12


def test_workers_of_other_versions(monkeypatch):
    here = cluster._versions()
    found, notes = cluster._compute({**here, 'numpy': '1.0'}, _log, [1])
    assert found == 1 and 'last digits may differ' in notes[0][1]
    with pytest.raises(DataError, match=r'gp_ground_seg .*, not 9\.9'):
        cluster._compute({**here, 'gp_ground_seg': '9.9'}, _log, [1])


@pytest.mark.parametrize(
    ('package', 'words'),
    [('distributed', ['--workers', '2']), ('fsspec', ['-o', 's3://drives/out'])],
)
def test_without_the_extra(package, words, root, tmp_path, monkeypatch, capsys):
    for name in (package, f'{package}.core'):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.chdir(tmp_path)
    assert run('segment', root, *words) == 2
    assert f'pip install {package}' in error_line(capsys)


def test_local_paths_need_neither_dask_nor_fsspec(root, tmp_path):
    code = (
        'import sys; from gp_ground_seg.cli.main import main; main(sys.argv[1:]); '
        'assert not {"dask", "distributed", "fsspec", "pyarrow"} & set(sys.modules)'
    )
    command = [sys.executable, '-c', code, 'segment', root, '-o', tmp_path / 'out']
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def test_several_bags_become_one_each(tmp_path, capsys):
    names = ['a', 'b']
    for k, name in enumerate(names):
        write_ros2_bag(tmp_path / f'{name}.mcap', n_clouds=2 + k)
        assert run('segment', tmp_path / f'{name}.mcap', '--quiet') == 0
    bags = [tmp_path / f'{name}.mcap' for name in names]
    assert run('segment', *bags, '-o', tmp_path / 'out') == 0
    for name in names:
        file = f'{name}_ground.mcap'
        assert (tmp_path / 'out' / file).read_bytes() == (tmp_path / file).read_bytes()
    assert '5 frames' in capsys.readouterr().out
    assert run('segment', *bags, '-o', tmp_path / 'out', '--resume') == 0
    assert capsys.readouterr().out == '2 of 2 were finished before\n'
    bags[1].unlink()
    write_ros2_bag(bags[1], n_clouds=4)
    assert run('segment', *bags, '-o', tmp_path / 'out', '--resume') == 0
    said = '1 of 2 were finished before; done again: 1 with a changed input (b_ground.mcap)'
    assert capsys.readouterr().out.startswith(f'{said}\n4 frames, ')
    scan = write_streets(tmp_path, s00=1) / 'sequences/00/velodyne/000000.bin'
    assert run('segment', bags[0], scan, '-o', tmp_path / 'out2') == 2
    assert 'is no bag' in error_line(capsys)


def test_what_is_there_is_kept_and_other_parameters_are_refused(root, tmp_path, capsys):
    command = ['segment', root, '-o', tmp_path / 'out']
    assert run(*command, '--resume') == 0  # nothing was begun yet
    capsys.readouterr()
    assert run(*command) == 2
    assert 'exists already; --resume continues, --force starts anew' in error_line(capsys)
    other = ['--set', 'label.ground_tolerance=0.2']
    before = labels(tmp_path / 'out')
    assert run(*command, '--resume', *other) == 2
    first = json.loads((tmp_path / 'out/manifest.jsonl').read_text().splitlines()[0])
    was, now = re.findall(r'\b[0-9a-f]{12}\b', error_line(capsys))
    assert was == first['configuration'] != now
    for more in (['--raw'], ['--columns', '5', '--force']):
        assert run(*command, '--resume', *more) == 2
        assert was in error_line(capsys)
    assert run(*command, '--resume', '--force', '--set', 'runtime.n_threads=1') == 0
    assert labels(tmp_path / 'out') == before
    assert run(*command, '--force', *other) == 0
    assert labels(tmp_path / 'out') != before
    assert sorted(finished(tmp_path / 'out')) == sorted(before)


def other_folder(source, _out):
    moved = source.with_name('other')
    for k, file in enumerate(sorted(source.rglob('*.bin'), reverse=True)):
        target = moved / sorted(source.rglob('*.bin'))[k].relative_to(source)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, target)
    return moved


def change(source, _out):
    scan = source / 'sequences/08/velodyne/000001.bin'
    np.fromfile(scan, np.float32)[::-1].tofile(scan)


def delete(_source, out):
    (out / 'sequences/08/predictions/000001.label').unlink()


def truncate(_source, out):
    os.truncate(out / 'sequences/08/predictions/000001.label', 40)


def remove_scan(source, out):
    (source / 'sequences/08/velodyne/000000.bin').unlink()
    (out / 'sequences/08/predictions/000000.label').unlink()


def link(_source, out):
    delete(_source, out)
    (out / 'sequences/08/predictions/000001.label').symlink_to('nowhere')


@pytest.mark.parametrize(
    ('harm', 'said', 'past'),
    [
        (other_folder, '0 of 12 were finished before; done again: 12 from another input', []),
        (change, '11 of 12 were finished before; done again: 1 with a changed input', PAST),
        (remove_scan, '7 of 11 were finished before; done again: 4 with a changed input', PAST),
        (delete, 'done again: 1 with output missing or of another size', []),
        (truncate, 'done again: 1 with output missing or of another size', PAST),
        (link, 'done again: 1 with output missing or of another size', []),
    ],
)
def test_resume_does_again_what_does_not_fit(harm, said, past, root, tmp_path, capsys):
    source, out, anew = tmp_path / 'root', tmp_path / 'out', tmp_path / 'anew'
    shutil.copytree(root, source)
    assert run('segment', source, '-o', out, *past) == 0
    source = harm(source, out) or source
    capsys.readouterr()
    assert run('segment', source, '-o', out, '--resume', *past) == 0
    assert said in capsys.readouterr().out
    assert run('segment', source, '-o', anew, *past) == 0
    assert labels(out) == labels(anew)
    capsys.readouterr()
    assert run('segment', source, '-o', out, '--resume', *past) == 0
    n = len(labels(anew))
    assert capsys.readouterr().out == f'{n} of {n} were finished before\n'


@pytest.mark.parametrize('line', [b'{', b'[' * 100_000, b'{"items": 3}', b'\xff', b'7', b'null'])
def test_a_manifest_that_is_none(line, root, tmp_path, capsys):
    (tmp_path / 'manifest.jsonl').write_bytes(line + b'\n')
    assert run('segment', root, '-o', tmp_path, '--resume') == 2
    assert error_line(capsys) == f'{tmp_path}/manifest.jsonl: line 1 is none of a manifest'
    (tmp_path / 'manifest.jsonl').rename(tmp_path / 'of_the_user')
    (tmp_path / 'manifest.jsonl').symlink_to('of_the_user')
    assert run('segment', root, '-o', tmp_path, '--force') == 2
    assert 'manifest.jsonl: ' in error_line(capsys)
    assert (tmp_path / 'of_the_user').read_bytes() == line + b'\n'


@pytest.fixture(scope='module')
def long_root(tmp_path_factory):
    """A sequence of many frames, of few files."""
    folder = write_streets(tmp_path_factory.mktemp('long'), s00=2)
    scans = folder / 'sequences/00/velodyne'
    for k in range(2, N_FRAMES):
        (scans / f'{k:06d}.bin').hardlink_to(scans / f'{k % 2:06d}.bin')
    return folder


def wait_for_lines(process, manifest, n):
    deadline = time.monotonic() + 120
    while not (manifest.exists() and manifest.read_bytes().count(b'\n') >= n):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)


def assert_gone(pids):
    deadline = time.monotonic() + 30
    while any(map(is_running, pids)):
        assert time.monotonic() < deadline
        time.sleep(0.1)


@pytest.mark.slow
def test_killed_worker_and_client_lose_nothing_and_nothing_is_done_twice(
    long_root, tmp_path, capsys
):
    out, command = tmp_path / 'out', ['segment', long_root, '-o', tmp_path / 'out']
    process = start(*command, '--workers', '2')
    wait_for_lines(process, out / 'manifest.jsonl', 1)
    workers = children(process.pid)
    os.kill(workers[-1], signal.SIGKILL)
    wait_for_lines(process, out / 'manifest.jsonl', 4)
    workers += children(process.pid)
    for more in ('--resume', '--force', '--quiet'):
        assert run(*command, more) == 2
        assert error_line(capsys) == f'{out}: another run writes to it'
    process.kill()
    _, err = process.communicate()
    assert 'died; computed again: block' in err and 'Traceback' not in err
    assert_gone(workers)
    before = finished(out)
    assert 0 < len(before) < N_FRAMES
    times = {name: (out / name).stat().st_mtime_ns for name in before}
    with (out / 'manifest.jsonl').open('a') as file:
        file.write('{"block": 7, "na')  # as a line that was being written
    (out / 'sequences/00/predictions/.000999.label.partial-0').touch()
    assert run(*command, '--resume') == 0
    assert f'{len(before)} of {N_FRAMES} were finished before' in capsys.readouterr().out
    assert sorted(finished(out)) == [
        f'sequences/00/predictions/{k:06d}.label' for k in range(N_FRAMES)
    ]
    assert {name: (out / name).stat().st_mtime_ns for name in before} == times
    found = labels(out)
    assert len(found) == N_FRAMES == len(list((out / 'sequences/00/predictions').iterdir()))
    assert len(set(found.values())) == 2


@pytest.mark.slow
def test_ctrl_c_ends_all_processes_with_one_line(long_root, tmp_path):
    process = start(
        'segment', long_root, '-o', tmp_path / 'out', '--workers', '2', start_new_session=True
    )
    wait_for_lines(process, tmp_path / 'out/manifest.jsonl', 1)
    workers = children(process.pid)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert (out, err) == ('', 'gp-ground-seg: interrupted\n')
    assert process.returncode in INTERRUPTED
    assert_gone(workers)


@pytest.mark.parametrize('suffix', ['.csv', '.parquet'])
def test_a_row_for_each_frame(root, tmp_path, capsys, suffix):
    path = tmp_path / f'frames{suffix}'
    command = ['evaluate', root, '--per-frame', path, '--json', tmp_path / 'all.json']
    assert run(*command) == 0
    assert f'each frame: {path}' in capsys.readouterr().out
    rows = json.loads((tmp_path / 'all.json').read_text())['rows']
    if suffix == '.csv':
        with path.open(newline='') as file:
            found = list(csv.DictReader(file))
    else:
        pyarrow = pytest.importorskip('pyarrow.parquet')
        found = pyarrow.read_table(path).to_pylist()
    for name, kind in (('sequence', str), ('index', str), ('groundgrid_iou', float)):
        assert [kind(row[name]) for row in found] == [row[name] for row in rows]
    assert run('evaluate', root, '--per-frame', tmp_path / 'frames.xlsx') == 2
    assert 'must end in .csv or .parquet' in error_line(capsys)
