"""Data by URL: a store of objects as a server of this machine, and its faults; memory."""

import socket
import subprocess
import sys
import threading
import time
import urllib.request
from pathlib import Path

import pytest
from cli_runner import error_line, run
from evaluation_samples import write_streets

from gp_ground_seg.core.errors import DataError
from gp_ground_seg.data import files
from gp_ground_seg.data.files import UrlPath

s3fs, _ = pytest.importorskip('s3fs'), pytest.importorskip('moto')
# Sessions of aiohttp are left to the garbage collector.
pytestmark = pytest.mark.filterwarnings('ignore::pytest.PytestUnraisableExceptionWarning')


def free_port():
    with socket.socket() as one:
        one.bind(('127.0.0.1', 0))
        return one.getsockname()[1]


def serve(port):
    command = [sys.executable, '-m', 'moto.server', '-H', '127.0.0.1', '-p', str(port)]
    # Its output would fill a pipe.
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while True:
        try:
            socket.create_connection(('127.0.0.1', port), 1).close()
            return server
        except OSError:
            assert server.poll() is None and time.monotonic() < deadline
            time.sleep(0.1)


@pytest.fixture(scope='module')
def root(tmp_path_factory):
    return write_streets(tmp_path_factory.mktemp('kitti'), s00=3, s08=2)


@pytest.fixture(scope='module')
def server():
    port = free_port()
    process = serve(port)
    yield f'http://127.0.0.1:{port}'
    process.kill()
    process.wait()


@pytest.fixture
def store(server, monkeypatch):
    """Environment of a store of objects, whose file system is returned, with one bucket."""
    names = {'ENDPOINT_URL': server, 'ACCESS_KEY_ID': 'key', 'SECRET_ACCESS_KEY': 'secret'}
    for name, value in {**names, 'DEFAULT_REGION': 'us-east-1'}.items():
        monkeypatch.setenv(f'AWS_{name}', value)
    monkeypatch.setenv('AWS_EC2_METADATA_DISABLED', 'true')
    s3fs.S3FileSystem.clear_instance_cache()
    system = s3fs.S3FileSystem(use_listings_cache=False)
    if not system.exists('drives'):
        system.mkdir('drives')
    yield system
    s3fs.S3FileSystem.clear_instance_cache()


@pytest.fixture
def url(store, root):
    if not store.exists('drives/kitti'):
        store.put(f'{root}/', 'drives/kitti/', recursive=True)
    return 's3://drives/kitti'


def labels(system, folder):
    return {
        name.split('sequences/')[1]: system.cat_file(name)
        for name in system.find(folder)
        if name.endswith('.label') and 'predictions' in name
    }


@pytest.mark.parametrize('protocol', ['s3', 'memory'])
def test_a_data_set_by_url_as_one_of_files(protocol, url, store, root, tmp_path, capsys):
    system = store
    if protocol == 'memory':
        system = pytest.importorskip('fsspec').filesystem('memory')
        system.put(f'{root}/', '/drives/kitti/', recursive=True)
    place = f'{protocol}://drives/kitti'
    out, here = f'{protocol}://drives/out', tmp_path / 'out'
    assert run('segment', root, '-o', here) == 0
    assert run('segment', place, '-o', out) == 0
    found = labels(system, '/drives/out' if protocol == 'memory' else 'drives/out')
    folder = here / 'sequences'
    assert found == {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob('*.label')}
    capsys.readouterr()
    assert run('segment', place, '-o', out, '--resume') == 0
    assert capsys.readouterr().out == '5 of 5 were finished before\n'
    assert run('segment', place, '-o', out) == 2
    assert f'{out}/sequences/00/predictions/000000.label: exists already' in error_line(capsys)
    assert run('segment', f'{place}/sequences/08/velodyne', '-o', f'{out}_flat') == 0
    assert '2 frames' in capsys.readouterr().out


def test_an_evaluation_by_url(url, root, capsys):
    said = []
    for place in (root, url):
        assert run('evaluate', place) == 0
        said.append(capsys.readouterr().out.partition('Time per frame')[0].splitlines()[2:])
    assert said[0] == said[1]


@pytest.mark.parametrize(
    ('source', 'environment', 'problem'),
    [
        ('s3://nowhere/kitti', {}, 's3://nowhere/kitti: no such file or folder'),
        ('s3://drives/other', {}, 's3://drives/other: no such file or folder'),
        ('s3://drives/kitti', {'ACCESS_KEY_ID': None}, 'Unable to locate credentials'),
        pytest.param(
            's3://drives/kitti',
            {'ENDPOINT_URL': 'http://127.0.0.1:1'},
            'Could not connect',
            marks=pytest.mark.slow,
        ),
        ('odd://drives/kitti', {}, 'odd://drives/kitti: Protocol not known'),
        ('gs://drives/kitti', {}, 'gcsfs'),
        ('s3://drives/cut', {}, 's3://drives/cut/000000.bin: 1001 bytes is not a whole number'),
    ],
)
def test_faults_take_one_line(source, environment, problem, url, store, root, monkeypatch, capsys):
    data = (root / 'sequences/00/velodyne/000000.bin').read_bytes()
    store.pipe_file('drives/cut/000000.bin', data[:1001])
    for name, value in environment.items():
        if value is None:
            monkeypatch.delenv(f'AWS_{name}')
        else:
            monkeypatch.setenv(f'AWS_{name}', value)
    s3fs.S3FileSystem.clear_instance_cache()
    assert run('segment', source, '-o', 's3://drives/faults', '--force') == 2
    assert problem in error_line(capsys)


def test_a_key_that_is_not_known(url, server, capsys):
    def ask(n_free):  # requests that need no key from now on
        place, body = f'{server}/moto-api/reset-auth', str(n_free).encode()
        request = urllib.request.Request(place, body, {'Content-Type': 'text/plain'})
        urllib.request.urlopen(request).close()

    ask(0)
    s3fs.S3FileSystem.clear_instance_cache()
    try:
        assert run('evaluate', url) == 2
        line = error_line(capsys)
    finally:
        ask('inf')
    assert line == 's3://drives/kitti: Forbidden'


def test_output_to_a_bucket_that_is_not_there(url, capsys):
    assert run('segment', url, '-o', 's3://nowhere/out') == 2
    assert 's3://nowhere/out' in error_line(capsys)


@pytest.mark.slow
def test_a_server_that_dies_meanwhile(store, root, monkeypatch, capsys):
    port = free_port()
    other = serve(port)
    monkeypatch.setenv('AWS_ENDPOINT_URL', f'http://127.0.0.1:{port}')
    s3fs.S3FileSystem.clear_instance_cache()
    system = s3fs.S3FileSystem(use_listings_cache=False)
    try:
        system.mkdir('mortal')
        system.put(f'{root}/', 'mortal/kitti/', recursive=True)
        written, write = [], UrlPath.write_bytes

        def write_bytes(path, data):
            written.append(path)
            if len(written) == 3:
                other.kill()
                other.wait()
            write(path, data)

        monkeypatch.setattr(UrlPath, 'write_bytes', write_bytes)
        assert run('segment', 's3://mortal/kitti', '-o', 's3://mortal/out') == 2
        assert 's3://mortal/out/sequences/00/predictions/000001.label: ' in error_line(capsys)
    finally:
        other.kill()
        other.wait()


def test_an_object_whose_end_does_not_come(monkeypatch):
    class Cut:
        def info(self, path):
            return {'size': 8}

        def cat_file(self, path):
            return b'four'

    core = pytest.importorskip('fsspec.core')
    monkeypatch.setattr(core, 'url_to_fs', lambda *a, **k: (Cut(), 'x'))
    with pytest.raises(DataError, match='s3://drives/x: 4 of 8 bytes came'):
        UrlPath('s3://drives/x').read(100)


def test_a_path_and_a_url_have_the_same_parts():
    url, path = UrlPath('s3://drives/a/b.c.bin'), Path('/drives/a/b.c.bin')
    for name in ('name', 'stem', 'suffix'):
        assert getattr(url, name) == getattr(path, name)
    assert url.parent == UrlPath('s3://drives/a') and url.parent / 'b.c.bin' == url
    assert files.as_path('s3://drives/a') == url.parent and files.as_path('a/b') == Path('a/b')


def test_a_file_appears_whole_or_not_at_all(tmp_path):
    target = tmp_path / 'deep/er/file'
    stop, seen = threading.Event(), set()

    def watch():
        while not stop.is_set():
            if target.exists():
                seen.add(len(target.read_bytes()))

    watcher = threading.Thread(target=watch)
    watcher.start()
    for k in range(200):
        files.write_file(target, bytes([k % 2]) * 100_000)
    stop.set()
    watcher.join()
    assert seen == {100_000} and [p.name for p in target.parent.iterdir()] == ['file']
    target.unlink()
    target.mkdir()
    with pytest.raises(DataError, match='cannot be written'):
        files.write_file(target, b'')
    assert [p.name for p in target.parent.iterdir()] == ['file']
