"""Data by URL: a store of objects as a server of this machine, and its faults; memory."""

import http.server
import re
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
from gp_ground_seg.lab.scale.dataset import Manifest, Scan

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


class Faults(http.server.BaseHTTPRequestHandler):
    """Announces 8 bytes, and sends what the name of the file says."""

    protocol_version = 'HTTP/1.1'
    n_sent = 0

    def log_message(self, *_words):
        """Print nothing."""

    def begin(self, name, text):
        self.send_response(200)
        self.send_header(name, text)
        self.end_headers()

    def do_HEAD(self):
        if 'unannounced' in self.path:
            self.begin('Transfer-Encoding', 'chunked')
        elif 'never' not in self.path:
            self.begin('Content-Length', '8')
        else:
            time.sleep(5)

    def do_GET(self):
        if 'cut' in self.path or 'long' in self.path:
            self.begin('Content-Length', '8' if 'cut' in self.path else '12')
            self.wfile.write(b'four' if 'cut' in self.path else b'four' * 3)
            self.close_connection = True
            return
        self.begin('Transfer-Encoding', 'chunked')
        type(self).n_sent = 0
        part, n_parts = (b'.' * 65536, 10**6) if 'endless' in self.path else (b'.', 8)
        try:
            for _ in range(n_parts):
                time.sleep(0.5 if 'slow' in self.path else 0)
                self.wfile.write(b'%x\r\n%s\r\n' % (len(part), part))
                type(self).n_sent += len(part)
            self.wfile.write(b'0\r\n\r\n')
        except OSError:
            pass


@pytest.fixture(scope='module')
def faults():
    """Address of a server that does not send what it announces."""
    pytest.importorskip('aiohttp')
    with http.server.ThreadingHTTPServer(('127.0.0.1', 0), Faults) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f'http://127.0.0.1:{server.server_port}'
        server.shutdown()


@pytest.mark.parametrize(
    ('name', 'problem'),
    [
        ('cut', 'received 4 of 8 bytes'),
        ('long', ': more than 8 bytes came'),
        ('endless', ': more than 8 bytes came'),
        ('endless_unannounced', ': 1001 bytes, accepted are at most 1000'),
        ('slow', ': no answer, or not all of it, in time'),
        ('never', ': no answer, or not all of it, in time'),
        ('unannounced', None),
    ],
)
def test_a_server_that_sends_something_else(name, problem, faults, monkeypatch):
    monkeypatch.setattr(files, 'URL_SECONDS', 1.5)
    url = f'{faults}/{name}.bin'
    if problem is None:
        assert files.read_bytes(url, 1000) == b'.' * 8
        return
    with pytest.raises(DataError, match=re.escape(url)) as raised:
        files.read_bytes(url, 1000)
    assert problem in str(raised.value)
    assert Faults.n_sent < 1e8


@pytest.mark.parametrize('protocol', ['s3', 'memory'])
def test_resume_by_url(protocol, store, root, tmp_path, capsys):
    system = store if protocol == 's3' else pytest.importorskip('fsspec').filesystem('memory')
    source, out = 'drives/a [1]', 'drives/out of [1]'
    system.put(f'{root}/', f'/{source}/' if protocol == 'memory' else f'{source}/', recursive=True)
    command = ['segment', f'{protocol}://{source}', '-o', f'{protocol}://{out}']
    assert run(*command) == 0
    before = labels(system, out)
    scans = f'{source}/sequences/00/velodyne'
    system.pipe_file(f'{scans}/000000.bin', system.cat_file(f'{scans}/000001.bin'))
    system.rm_file(f'{out}/sequences/08/predictions/000001.label')
    capsys.readouterr()
    assert run(*command, '--resume') == 0
    said = capsys.readouterr().out
    assert said.startswith('3 of 5 were finished before; done again: 1 with a changed input (')
    assert '1 with output missing or of another size (sequences/08/predictions/0' in said
    changed = labels(system, out)
    assert {name for name in before if before[name] != changed[name]} == {
        '00/predictions/000000.label'
    }
    assert changed.keys() == before.keys()


def test_files_of_this_machine_to_a_url(url, store, root, tmp_path, capsys):
    scan = root / 'sequences/00/velodyne/000000.bin'
    assert run('segment', scan, '-o', 's3://drives/one') == 0
    assert run('segment', scan, '-o', tmp_path / '0.label') == 0
    assert store.cat_file('drives/one/000000.label') == (tmp_path / '0.label').read_bytes()


def test_of_two_runs_on_a_url_one_ends(url):
    scans = [
        Scan(UrlPath(f'{url}/sequences/00/velodyne/00000{k}.bin'), f'{k}.label', list)
        for k in range(3)
    ]
    one, two = (Manifest(UrlPath('s3://drives/both'), '', scans) for _ in range(2))
    assert one.open(resume=True, force=False) == two.open(resume=True, force=False) == (set(), '')
    one.begin()
    two.begin()
    one.add(['0.label'], [4])
    with pytest.raises(DataError, match='has changed, another run writes to this folder'):
        two.add(['1.label'], [4])
    one.add(['2.label'], [4])


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
