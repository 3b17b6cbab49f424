"""Whole data sets: one process, workers and a scheduler alike; what dies, and how it goes on."""

import csv
import json
import logging
import os
import resource
import shutil
import signal
import socket
import stat
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from functools import partial
from pathlib import Path

import pytest
from cli_runner import children, error_line, run, start
from evaluation_samples import label_files, write_two_drives
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg.core.errors import DataError
from gp_ground_seg.lab.scale import cluster

dask, distributed = pytest.importorskip('dask'), pytest.importorskip('distributed')
# Dask leaves sockets and event loops to the garbage collector when its processes end.
pytestmark = pytest.mark.filterwarnings('ignore::pytest.PytestUnraisableExceptionWarning')

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
    return write_two_drives(tmp_path_factory.mktemp('root'))


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
    for name in ('environment', 'times', 'stages'):
        document.pop(name, None)
    if 'measures' in document:
        assert document['measures'].pop()['measure'].startswith('time')
    for row in document['rows']:
        row.pop('seconds', None)
    measures = document.get('measures', [])
    document['measures'] = [each for each in measures if '[ms]' not in each['measure']]
    return document


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


@pytest.mark.parametrize('more', [[], ['--peer', 'patchworkpp']])
def test_an_evaluation_is_the_same_to_the_last_digit(root, assert_same, more):
    assert_same(', 2 workers beside one another  [ms]', 'evaluate', root, *more)


@pytest.mark.parametrize(
    'words',
    [
        ['ablation'],
        ['objects', '--sensors', 'vlp-16', '--scenes', 'urban,car_park', '--seeds', '1'],
    ],
    ids=lambda words: words[0],
)
def test_an_experiment_is_the_same_to_the_last_digit(words, root, assert_same):
    given = [root] if len(words) == 1 else []
    assert_same('workers with 2 threads in all', 'experiment', *words, *given)


def test_labels_are_the_same_with_any_number_of_workers(root, scheduler, tmp_path, capsys):
    assert run('segment', root, '-o', tmp_path / '0') == 0
    for n, words in (('1', ['--workers', '1']), ('2', ['--scheduler', scheduler])):
        assert run('segment', root, '-o', tmp_path / n, *words) == 0
        said = capsys.readouterr()
        assert f'in each of {n} worker' in said.out
        assert said.err == '' or '--scheduler' in words
        assert label_files(tmp_path / n) == label_files(tmp_path / '0')
    for name in ('00', '08'):
        assert run('segment', root / 'sequences' / name, '-o', tmp_path / 'alone') == 0
        of_sequence = tmp_path / f'0/sequences/{name}/predictions'
        assert label_files(tmp_path / 'alone') == label_files(of_sequence)
        shutil.rmtree(tmp_path / 'alone')
    assert len(label_files(tmp_path / '0')) == 12


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


def test_a_port_where_no_scheduler_speaks(root, tmp_path, capsys):
    with socket.create_server(('127.0.0.1', 0)) as server:
        banner = threading.Thread(target=lambda: server.accept()[0].sendall(b'SSH-2.0-server\r\n'))
        banner.start()
        address = f'tcp://127.0.0.1:{server.getsockname()[1]}'
        assert run('segment', root, '-o', tmp_path / 'out', '--scheduler', address) == 2
        banner.join()
    assert 'does not answer' in error_line(capsys)


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
    assert len(label_files(tmp_path)) == 12


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
        'assert not {"dask", "distributed", "fsspec"} & set(sys.modules)'
    )
    command = [sys.executable, '-c', code, 'segment', root, '-o', tmp_path / 'out']
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def test_a_row_for_each_frame(root, tmp_path, capsys):
    path = tmp_path / 'frames.csv'
    command = ['evaluate', root, '--per-frame', path, '--json', tmp_path / 'all.json']
    assert run(*command) == 0
    assert f'each frame: {path}' in capsys.readouterr().out
    rows = json.loads((tmp_path / 'all.json').read_text())['rows']
    with path.open(newline='') as file:
        found = list(csv.DictReader(file))
    for name, kind in (('sequence', str), ('index', str), ('groundgrid_iou', float)):
        assert [kind(row[name]) for row in found] == [row[name] for row in rows]
