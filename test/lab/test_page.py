"""The page of `tune` among strangers: who is answered, and what it survives."""

import http.client
import re
import socket
import struct
from contextlib import closing
from urllib.parse import urlsplit

import numpy as np
import pytest
from cli_runner import until_ctrl_c
from conftest import hilly_scan

pytest.importorskip('viser', reason='viser is not installed')
import msgspec
import viser
import zstandard
from websockets.sync.client import connect

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures('compiled_code')]

PATIENCE = 60.0
VERSION = f'viser-v{viser.__version__}'
TOLERANCE = 'label.ground_tolerance'
HANDSHAKE = {
    'Upgrade': 'websocket', 'Connection': 'Upgrade', 'Sec-WebSocket-Version': '13',
    'Sec-WebSocket-Key': 'AAAAAAAAAAAAAAAAAAAAAA==', 'Sec-WebSocket-Protocol': VERSION,
}  # fmt: skip
CAMERA = {
    'wxyz': [1, 0, 0, 0], 'position': [0, 0, 1], 'fov': 1, 'near': 1, 'far': 9, 'look_at': [0] * 3,
    'image_height': 9, 'image_width': 9, 'up_direction': [0, 0, 1],
}  # fmt: skip


class Page:
    """In place of the page in a browser: speaks viser's protocol, and keeps what it is told."""

    def __init__(self, address):
        self.socket = connect(
            address.replace('http', 'ws', 1), subprotocols=[VERSION], max_size=None
        )
        self.uuids, self.values, self.text = {}, {}, ''  # by name, by uuid
        # A control does nothing for a page without camera.
        self.send('ViewerCameraMessage', **CAMERA)
        self.wait_for('changed: ')

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.socket.close()

    def send(self, kind, **fields):
        """Send a message."""
        self.socket.send(msgspec.msgpack.encode({'type': kind, **fields}))

    def set(self, name, value):
        """Set a control."""
        self.send('GuiUpdateMessage', uuid=self.uuids[name], updates={'value': value})

    def wait_for(self, words):
        """Read until the page has been told something with these words, a regular expression."""
        self.text = ''
        while not re.search(words, self.text):
            data = self.socket.recv(PATIENCE)
            size = int.from_bytes(data[8:16], 'little')
            inner = zstandard.ZstdDecompressor().decompress(data[16 : 16 + size])
            for message in msgspec.msgpack.decode(inner)['messages']:
                props = message.get('props') or message.get('updates') or {}
                self.text += str(props)
                if 'uuid' in message and 'label' in props:
                    self.uuids[props['label'].partition(' [')[0]] = message['uuid']
                if 'value' in message or 'value' in props:
                    self.values[message['uuid']] = message.get('value', props.get('value'))

    def move(self):
        """Move a slider, and wait until the labels have followed."""
        uuid = self.uuids[TOLERANCE]
        # What a page sets it is not told.
        self.values[uuid] = 0.2 if self.values[uuid] == 0.1 else 0.1
        self.set(TOLERANCE, self.values[uuid])
        self.wait_for('changed: ')


def status(address, path=None, host=None, origin=None, upgrade=True):
    """Status of the answer to a request; what is not given is that of the page itself."""
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=PATIENCE)
    headers = {'Host': host or parts.netloc, **(HANDSHAKE if upgrade else {})}
    with closing(connection):
        headers |= {} if origin is None else {'Origin': origin}
        connection.request('GET', parts.path if path is None else path, headers=headers)
        return connection.getresponse().status


def close_early(address, data):
    """Send some bytes, and reset the connection."""
    parts = urlsplit(address)
    with socket.create_connection((parts.hostname, parts.port)) as stranger:
        stranger.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack('ii', 1, 0))
        stranger.sendall(data)


@pytest.fixture(scope='module')
def address(tmp_path_factory):
    """Address of a page; its process must end without a traceback, behind all tests."""
    folder = tmp_path_factory.mktemp('page')
    np.save(folder / 'a.npy', hilly_scan().astype(np.float32))
    with until_ctrl_c('tune', folder / 'a.npy', '-o', folder / 'a.yaml') as process:
        yield process.stdout.readline().strip()


def test_only_who_has_the_address_is_answered(address):
    path, port = urlsplit(address).path, urlsplit(address).port
    here, local, foreign = f'127.0.0.1:{port}', f'localhost:{port}', f'evil.example:{port}'
    for is_known, request in (
        (True, {}),
        (True, {'origin': f'http://{here}'}),
        (True, {'host': local, 'origin': f'http://{local}'}),
        (False, {'origin': f'http://{local}'}),
        (False, {'origin': 'http://127.0.0.1:1'}),
        (False, {'origin': 'http://evil.example'}),
        (False, {'origin': 'null'}),
        # The name of a foreign page that leads to this machine: DNS rebinding.
        (False, {'host': foreign, 'origin': f'http://{foreign}'}),
        (False, {'host': foreign}),
        (False, {'path': '/'}),
        (False, {'path': '/%C3%A9'}),
        (False, {'path': path[:-1]}),
        (False, {'path': f'{path}x'}),
    ):
        assert status(address, **request) == (101 if is_known else 403), request
        assert status(address, **request, upgrade=False) == (200 if is_known else 403), request


@pytest.mark.parametrize(
    ('control', 'odd'),
    [
        *((TOLERANCE, odd) for odd in (99999, -1, float('nan'))),
        ('learning.mode', 'no'),
        ('colours', '<b>'),
        ('frame', 1),
    ],
)
def test_what_a_control_cannot_be_is_taken_back(address, control, odd):
    with Page(address) as page:
        uuid = page.uuids[control]
        before = page.values[uuid]
        page.set(control, odd)
        page.wait_for("'value': ")
        assert page.values[uuid] == before
        page.move()


def test_what_is_no_message_and_who_closes_early_leave_the_page_alive(address):
    for data in ('text', b'', b'\xff', b'\x91\x01', b'\x81\xa4type\xa2no'):
        with Page(address) as page:
            page.socket.send(data)
    for data in (b'', b'GET', b'GET / HTTP/1.1\r\n', b'\x16\x03\x01', b'\r\n\r\n'):
        close_early(address, data)
    with Page(address) as page:
        page.move()
