"""Whole data sets: one process, workers and a scheduler alike; what dies, and how it goes on."""

import ast
import contextlib
import json
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import BrokenExecutor, Executor, Future
from functools import partial
from pathlib import Path
from threading import Event, Thread, Timer

import pytest
from cli_runner import INTERRUPTED, children, error_line, is_running, run, start
from evaluation_samples import label_files, write_two_drives
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg.core.errors import DataError
from gp_ground_seg.lab import cluster

dask, distributed = pytest.importorskip('dask'), pytest.importorskip('distributed')
# Dask leaves sockets and event loops to the garbage collector when its processes end.
pytestmark = [
    pytest.mark.usefixtures('compiled_code'),
    pytest.mark.filterwarnings('ignore::pytest.PytestUnraisableExceptionWarning'),
]


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


SAME = {
    'evaluate ROOT': ', 2 workers beside one another  [ms]',
    'evaluate ROOT --peer patchworkpp': ', 2 workers beside one another  [ms]',
    'experiment ablation ROOT': 'workers with 2 threads in all',
    'experiment objects --sensors vlp-16 --scenes urban,car_park --seeds 1': '2 threads in all',
}


@pytest.mark.parametrize('line', SAME)
def test_reports_are_the_same_to_the_last_digit(line, root, scheduler, tmp_path, capsys):
    """Here, in processes and on a cluster."""
    words = [root if word == 'ROOT' else word for word in line.split()]
    assert run(*words, '--json', tmp_path / 'here.json') == 0
    assert SAME[line] not in capsys.readouterr().out
    for more in ('--workers', '2'), ('--scheduler', scheduler):
        assert run(*words, '--json', tmp_path / 'there.json', '--force', *more) == 0
        assert everything(tmp_path / 'there.json') == everything(tmp_path / 'here.json')
        assert SAME[line] in capsys.readouterr().out


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


@pytest.fixture(params=['workers', 'scheduler'])
def workers(request, scheduler):
    """A runner on two processes, or on a cluster."""
    given = (2, None) if request.param == 'workers' else (None, scheduler)
    with cluster.open_runner(*given, cluster._NO_BAR) as runner:
        yield runner


def test_results_are_those_of_one_process_also_if_a_worker_dies(workers, tmp_path, caplog):
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


def test_a_block_that_ends_every_worker_is_named(workers):
    with pytest.raises(DataError, match='died') as caught:
        workers.run(_die, [7])
    assert '7' in str(caught.value)


def test_a_worker_that_dies_before_the_work_begins(caplog):
    is_first = True

    @contextlib.contextmanager
    def opened():
        nonlocal is_first
        with cluster._processes(1) as executor:
            if is_first:
                is_first = False
                assert isinstance(executor.submit(_die, [0], iter).exception(), BrokenExecutor)
            yield executor

    runner = cluster.Runner(open_executor=opened, n_workers=1)
    assert runner.run(_last_first, range(3)) == [0, 2]
    assert caplog.messages == ['a worker died; computed again: 2 blocks']


def listening():
    """Sockets of this machine that wait for connections, by inode."""
    found = set()
    for name in ('tcp', 'tcp6', 'unix'):
        rows = [line.split() for line in Path(f'/proc/net/{name}').read_text().splitlines()[1:]]
        if name == 'unix':  # flag of a listening socket, see proc(5)
            found |= {row[6] for row in rows if int(row[3], 16) & 0x10000}
        else:
            found |= {row[9] for row in rows if row[3] == '0A'}
    return found


def sockets(pid):
    found = set()
    for path in Path(f'/proc/{pid}/fd').iterdir():
        with contextlib.suppress(FileNotFoundError):  # closed meanwhile
            found.add(os.readlink(path))
    return {link[8:-1] for link in found if link.startswith('socket:[')}


def _sockets_that_listen(block, progress):
    # A worker looks at its parent, itself and the other workers.
    parent = os.getppid()
    pids = [parent, *children(parent)]
    return len(pids), [pid for pid in pids if sockets(pid) & listening()]


def test_nothing_listens_with_workers(scheduler):
    assert sockets(os.getpid()) & listening()  # as that scheduler does
    code = (
        'from gp_ground_seg.lab import cluster; import test_scale; '
        'context = cluster.open_runner(2, None, cluster._NO_BAR); runner = context.__enter__(); '
        'print(runner.run(test_scale._sockets_that_listen, range(8)))'
    )
    folder = Path(__file__).parent
    done = subprocess.run(
        [sys.executable, '-c', code], cwd=folder, capture_output=True, text=True, check=True
    )
    found = ast.literal_eval(done.stdout)
    assert len(found) == 4
    assert all(n >= 3 and not pids for n, pids in found), found


def test_more_workers_than_a_machine_has_use_for(root, tmp_path, capsys):
    assert run('segment', root, '-o', tmp_path / 'out', '--workers', '99999999999') == 2
    assert 'must be 1 to' in error_line(capsys)
    assert not (tmp_path / 'out').exists()


class InThread(Executor):
    """A thread that does not keep Python from ending where it hangs."""

    def submit(self, function, /, *args):
        future = Future()
        self.thread = Thread(target=lambda: future.set_result(function(*args)), daemon=True)
        self.thread.start()
        return future


def test_ctrl_c_between_any_two_lines_of_the_wait_leaves_no_lock():
    """Or the executor could not set the result, and would never end."""
    last = 1
    while last:
        executor, gate, n_lines = InThread(), Event(), 0

        def wait(block, progress, gate=gate):
            gate.wait()

        def interrupt(frame, event, _, executor=executor, last=last):
            nonlocal n_lines
            if 'concurrent/futures' in frame.f_code.co_filename and hasattr(executor, 'thread'):
                n_lines += 1
                if n_lines == last:
                    sys.settrace(None)
                    signal.raise_signal(signal.SIGINT)
            return interrupt

        runner = cluster.Runner(open_executor=partial(contextlib.nullcontext, executor))
        opener = Timer(0.05, gate.set)
        opener.start()
        sys.settrace(interrupt)
        try:
            runner.run(wait, [1])
            last = 0
        except KeyboardInterrupt:
            last += 1
        finally:
            sys.settrace(None)
        opener.join()
        executor.thread.join(10)
        assert not executor.thread.is_alive(), f'at line {last}'
    assert n_lines > 10


@pytest.mark.parametrize('delay', [0.0, 0.1, 0.3])
def test_ctrl_c_while_workers_start(delay, root, tmp_path):
    process = start(
        'segment', root, '-o', tmp_path / 'out', '--workers', '2', start_new_session=True
    )
    deadline, started = time.monotonic() + 60, []
    while len(started) < 2:  # the tracker of resources, and a worker
        assert process.poll() is None and time.monotonic() < deadline
        started = children(process.pid)
    time.sleep(delay)
    started = children(process.pid)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert (out, err) == ('', 'gp-ground-seg: interrupted\n')
    assert process.returncode in INTERRUPTED
    while any(map(is_running, started)):
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.parametrize(
    ('address', 'problem'),
    [
        ('tcp://127.0.0.1:1', 'does not answer'),
        ('tls://127.0.0.1:1', 'does not answer'),
        ('somewhere', 'must be tcp://HOST:PORT'),
    ],
)
def test_a_scheduler_that_is_not_there(address, problem, root, monkeypatch, tmp_path, capsys):
    command = ['segment', root, '-o', tmp_path / 'out']
    monkeypatch.setattr(cluster, 'CONNECT_TIMEOUT', 0.2)
    assert run(*command, '--scheduler', address) == 2
    assert problem in error_line(capsys)
    assert run(*command) == 0


def test_a_scheduler_that_ends_meanwhile(root, tmp_path):
    """As the machine that it runs on may."""
    words = [sys.executable, '-m', 'distributed.cli.dask_scheduler', '--no-dashboard', '--host']
    with subprocess.Popen(
        [*words, 'tcp://127.0.0.1', '--port', '0'], stderr=subprocess.PIPE, text=True
    ) as scheduler:
        address = next(
            found[0] for line in scheduler.stderr if (found := re.findall(r'tcp://[\d.:]+', line))
        )
        process = start('segment', root, '-o', tmp_path / 'out', '--scheduler', address)
        for line in process.stderr:
            if 'no worker yet' in line:
                break
        time.sleep(1.0)
        scheduler.kill()
        assert process.communicate(timeout=60) == (
            '', 'gp-ground-seg: error: the scheduler is lost\n'
        )  # fmt: skip
        assert process.returncode == 2


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


def test_workers_of_other_versions():
    here = cluster._versions()
    found, notes = cluster._compute_block({**here, 'numpy': '1.0'}, _log, [1])
    assert found == 1 and 'last digits may differ' in notes[0][1]
    with pytest.raises(DataError, match=r'gp_ground_seg .*, not 9\.9'):
        cluster._compute_block({**here, 'gp_ground_seg': '9.9'}, _log, [1])


def test_without_the_extra(root, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, 'distributed', None)
    monkeypatch.chdir(tmp_path)
    assert run('segment', root, '--scheduler', 'tcp://127.0.0.1:1') == 2
    assert 'pip install distributed' in error_line(capsys)


@pytest.mark.parametrize('more', [[], ['--workers', '1']])
def test_this_machine_needs_no_dask(more, root, tmp_path):
    code = (
        'import sys; from gp_ground_seg.cli.main import main; main(sys.argv[1:]); '
        'assert not {"dask", "distributed"} & set(sys.modules)'
    )
    command = [sys.executable, '-c', code, 'segment', root, '-o', tmp_path / 'out', *more]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
