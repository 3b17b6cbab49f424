"""The page of `tune` among strangers: who is answered, and what it survives."""

import http.client
import socket
import struct
from contextlib import closing
from urllib.parse import urlsplit

import numpy as np
import pytest
from cli_runner import until_ctrl_c
from conftest import hilly_scan

from gp_ground_seg import Config
from gp_ground_seg.data.inputs import list_inputs
from gp_ground_seg.lab import tuner as page

pytest.importorskip('viser', reason='viser is not installed')
import viser
from websockets.sync.client import connect

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures('compiled_code')]

VERSION = f'viser-v{viser.__version__}'
HANDSHAKE = {
    'Upgrade': 'websocket', 'Connection': 'Upgrade', 'Sec-WebSocket-Version': '13',
    'Sec-WebSocket-Key': 'AAAAAAAAAAAAAAAAAAAAAA==', 'Sec-WebSocket-Protocol': VERSION,
}  # fmt: skip


def status(address, path=None, host=None, origin=None, upgrade=True):
    """Status of the answer to a request; what is not given is that of the page itself."""
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=60.0)
    headers = {'Host': host or parts.netloc, **(HANDSHAKE if upgrade else {})}
    with closing(connection):
        headers |= {} if origin is None else {'Origin': origin}
        connection.request('GET', parts.path if path is None else path, headers=headers)
        return connection.getresponse().status


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


def test_what_is_no_message_and_who_closes_early_leave_the_page_alive(address):
    for data in ('text', b'', b'\xff', b'\x91\x01', b'\x81\xa4type\xa2no'):
        with connect(address.replace('http', 'ws', 1), subprotocols=[VERSION]) as client:
            client.send(data)
    parts = urlsplit(address)
    for data in (b'', b'GET', b'GET / HTTP/1.1\r\n', b'\x16\x03\x01', b'\r\n\r\n'):
        with socket.create_connection((parts.hostname, parts.port)) as stranger:
            stranger.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack('ii', 1, 0))
            stranger.sendall(data)
    assert status(address) == 101


def test_what_a_control_cannot_be_is_said(sequence):
    name = 'label.ground_tolerance'
    with page.open_server(0) as (server, _):
        tuner = page.Tuner(server, list_inputs(sequence), Config(), [name, 'sensor.height'])
        shown = {h.label: h for h in server.gui._gui_input_handle_from_uuid.values()}
        for odd in (-1.0, float('nan')):
            shown[f'{name} [m]'].value = odd
            page._tell(tuner._said, tuner._update)
            assert name in tuner._said.content
        shown[f'{name} [m]'].value = 0.1
        page._tell(tuner._said, tuner._update)
        assert tuner._said.content == '' and 'changed' in tuner._table.content
        estimated = shown['sensor.height [m]'].value
        assert f'sensor: {estimated:.2f} m over the ground (estimated)' in tuner._table.content
        shown['auto'].value, shown['sensor.height [m]'].value = False, 3.0
        page._tell(tuner._said, tuner._update)
        assert f'ground near the sensor is {estimated:.2f} m below' in tuner._said.content
        assert shown['sensor.height [m]'].value == 3.0
