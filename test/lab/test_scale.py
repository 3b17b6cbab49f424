"""Whole data sets: one process, workers and a scheduler alike; what dies, and how it goes on."""

import gc
import json
import logging
import os
import re
import signal
import subprocess
import sys
import time
from functools import partial

import pytest
from cli_runner import INTERRUPTED, children, is_running, run, start, wait_for
from evaluation_samples import label_files, write_streets
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg import __version__
from gp_ground_seg.core.errors import DataError
from gp_ground_seg.lab import cluster

dask, distributed = pytest.importorskip('dask'), pytest.importorskip('distributed')
psutil = pytest.importorskip('psutil')  # of distributed
# Dask leaves sockets and event loops to the garbage collector when its processes end.
pytestmark = [
    pytest.mark.usefixtures('compiled_code'),
    pytest.mark.filterwarnings('ignore::pytest.PytestUnraisableExceptionWarning'),
]


@pytest.fixture(scope='module')
def root(tmp_path_factory):
    return write_streets(tmp_path_factory.mktemp('root'), s00=7, s08=5)


@pytest.fixture(scope='module')
def locked_scheduler():
    """Address of a cluster of two workers that was not started by a command, and its keys."""
    security = distributed.Security.temporary()
    config = {
        'distributed.comm.tls.ca-file': security.tls_ca_file,
        'distributed.comm.tls.client.cert': security.tls_client_cert,
        'distributed.comm.tls.client.key': security.tls_client_key,
    }
    with (
        dask.config.set({
            'distributed.nanny.pre-spawn-environ': {},  # of this process, too
            'distributed.worker.multiprocessing-method': 'forkserver',  # which imports Dask once
            'distributed.scheduler.allowed-failures': 1,
        }),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address='127.0.0.1:0',
            security=security, silence_logs=logging.CRITICAL,
        ) as started,
    ):  # fmt: skip
        yield started.scheduler_address, config


@pytest.fixture
def scheduler(locked_scheduler):
    """Address of a scheduler to which Dask's configuration has the keys."""
    address, config = locked_scheduler
    with dask.config.set(config):
        yield address


def everything(path):
    """Numbers of a report but for times, and what it ran on."""
    document = json.loads(path.read_text())
    for name in ('environment', 'times', 'stages'):
        document.pop(name, None)
    document['rows'] = [
        {key: x for key, x in row.items() if key != 'seconds' and not key.startswith('stage_')}
        for row in document['rows']
    ]
    return document


@pytest.mark.parametrize(
    ('line', 'more'),
    [
        pytest.param('evaluate ROOT --peer patchworkpp', '--workers 2', marks=pytest.mark.slow),
        ('experiment ablation ROOT', '--scheduler ADDRESS'),
        ('experiment scenes --sensors vlp-16 --scenes car_park --seeds 1', '--scheduler ADDRESS'),
    ],
)
def test_reports_are_the_same_to_the_last_digit(line, more, root, scheduler, tmp_path, capsys):
    """Here, in processes and on a cluster."""
    words = [str(root) if word == 'ROOT' else word for word in line.split()]
    if 'ablation' in words:
        words += ['--sequences', '00', '--frame-step', '3']
    assert run(*words, '--json', tmp_path / 'here.json') == 0
    assert 'workers with 2 threads in all' not in capsys.readouterr().out
    more = more.replace('ADDRESS', scheduler).split()
    assert run(*words, '--json', tmp_path / 'there.json', *more) == 0
    assert everything(tmp_path / 'there.json') == everything(tmp_path / 'here.json')
    assert 'workers with 2 threads in all' in capsys.readouterr().out


def test_labels_are_the_same_with_any_number_of_workers(root, scheduler, tmp_path, capsys):
    assert run('segment', root, '-o', tmp_path / '0') == 0
    before = dict(os.environ)
    for n, words in (('1', ['--workers', '1']), ('2', ['--scheduler', scheduler])):
        assert run('segment', root, '-o', tmp_path / n, *words) == 0
        out, err = capsys.readouterr()
        assert f'in each of {n} worker' in out and (err == '' or '--scheduler' in words)
        assert label_files(tmp_path / n) == label_files(tmp_path / '0')
    # Dask sets variables of malloc, with which each frame takes its memory from the system.
    assert dict(os.environ) == before
    for name, n_scans in (('00', 7), ('08', 5)):
        assert run('segment', root / 'sequences' / name, '-o', tmp_path / name) == 0
        of_sequence = tmp_path / f'0/sequences/{name}/predictions'
        assert label_files(tmp_path / name) == label_files(of_sequence)
        assert len(label_files(of_sequence)) == n_scans


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


def _die(block, progress):
    os.kill(os.getpid(), signal.SIGKILL)


def _last_first(block, progress):
    time.sleep(0.5 * (block[0] == 0))
    return block[0]


def test_results_are_those_of_one_process_also_if_a_worker_dies(scheduler, tmp_path, caplog):
    with cluster.open_runner(None, scheduler, cluster.HERE.bar) as workers:
        assert workers.n_workers == 2
        found = workers.run(partial(_die_once, tmp_path / 'died'), range(40))
        assert found == [sum(range(k, k + 10)) for k in range(0, 40, 10)]
        assert (tmp_path / 'died').exists()
        assert workers.run(_last_first, range(4)) == [0, 1, 2, 3]
        caplog.clear()
        assert sum(workers.run(_log, range(40))) == 40
        assert caplog.messages == ['the surface is odd']
        with pytest.raises(DataError, match=r'^00/000003: truncated\?'):
            workers.run(_fail, range(40))
        with pytest.raises(DataError, match=r'^7 to 7: each worker that computed this block died'):
            workers.run(_die, [7])


def test_a_scheduler_with_keys_answers_nobody_without(locked_scheduler, monkeypatch):
    monkeypatch.setattr(cluster, 'CONNECT_TIMEOUT', 0.5)
    with pytest.raises(DataError, match='does not answer'):
        cluster.open_runner(None, locked_scheduler[0], cluster.HERE.bar).__enter__()
    gc.collect()  # Dask's client; if its end met the start of the next, that would wait for itself


def test_workers_speak_tls_and_are_seen_on_this_machine_only():
    spawning = dask.config.set({'distributed.worker.multiprocessing-method': 'spawn'})
    with spawning, cluster.open_runner(1, None, cluster.HERE.bar) as runner:
        assert runner.run(_last_first, range(1, 3)) == [1, 2]
        family = [psutil.Process(), *psutil.Process().children()]
        sockets = [socket for process in family for socket in process.net_connections()]
        assert {s.laddr.ip for s in sockets if s.status == psutil.CONN_LISTEN} == {'127.0.0.1'}
        assert runner.client.scheduler.address.startswith('tls://')


def labels_in(folder):
    return [*folder.glob('sequences/*/predictions/*.label')]  # not those half written


@pytest.mark.slow
@pytest.mark.parametrize(
    ('moment', 'victim'),
    [
        ('a worker starts', 'all'),
        ('files are written', 'all'),
        ('files are written', 'the run'),
        ('files are written', 'a worker'),
    ],
)
def test_processes_that_are_stopped_leave_nothing_half_done(moment, victim, tmp_path, capsys):
    """Ctrl-C, which all processes of a terminal get, or `kill -9` of one."""
    root, out, n_scans = write_streets(tmp_path / 'root', s00=1), tmp_path / 'out', 150
    scan, *_ = root.rglob('*.bin')
    os.utime(scan, (1e9, 1e9))
    for k in range(1, n_scans):
        scan.with_name(f'{k:06d}.bin').hardlink_to(scan)
    words = 'segment', root, '-o', out
    process = start(*words, '--workers', '2', '--quiet', start_new_session=True)
    # The first child is the tracker of resources.
    started = 2 if moment == 'a worker starts' else 3
    wait_for(lambda: len(children(process.pid)) >= started, 'worker')
    if moment == 'files are written':
        wait_for(lambda: labels_in(out), 'labels')
    workers = children(process.pid)
    if victim == 'all':
        os.killpg(process.pid, signal.SIGINT)
        assert process.communicate() == ('', 'gp-ground-seg: interrupted\n')
        assert process.returncode in INTERRUPTED
    elif victim == 'the run':
        process.kill()
        assert 'Traceback' not in process.communicate()[1]
    else:
        os.kill(workers[-1], signal.SIGKILL)
        said, errors = process.communicate()
        assert (process.returncode, errors) == (0, '') and f'{n_scans} frames' in said
    wait_for(lambda: not any(map(is_running, workers)), 'end of all processes')
    times = {path: path.stat().st_mtime_ns for path in labels_in(out)}
    assert (len(times) == n_scans) == (victim == 'a worker')
    assert run(*words) == 0
    said = capsys.readouterr().out
    assert not times or said.startswith(f'{len(times)} of {n_scans} were finished before\n')
    assert {path: path.stat().st_mtime_ns for path in times} == times
    found = label_files(out)
    assert len(found) == n_scans and len({*found.values()}) == 1
    assert len([*(out / 'sequences/00/predictions').iterdir()]) == n_scans


@pytest.mark.slow
def test_a_scheduler_that_ends_meanwhile(root, tmp_path):
    """As the machine that it runs on may."""
    words = [sys.executable, '-m', 'distributed.cli.dask_scheduler', '--no-dashboard', '--host']
    with subprocess.Popen(
        [*words, 'tcp://127.0.0.1', '--port', '0'], stderr=subprocess.PIPE, text=True
    ) as scheduler:
        said = (re.search(r'tcp://[\d.:]+', line) for line in scheduler.stderr)
        address = next(found[0] for found in said if found)
        process = start('segment', root, '-o', tmp_path / 'out', '--scheduler', address)
        next(line for line in process.stderr if 'no worker yet' in line)
        time.sleep(1.0)
        scheduler.kill()
        lost = 'gp-ground-seg: error: the scheduler is lost\n'
        assert (process.communicate(timeout=60), process.returncode) == (('', lost), 2)
    assert not [*tmp_path.rglob('*.label')]


def test_a_worker_of_another_version_is_refused():
    assert cluster._compute_block(__version__, _log, [1])[0] == 1
    with pytest.raises(DataError, match=r'gp_ground_seg .*, not 9\.9'):
        cluster._compute_block('9.9', _log, [1])
