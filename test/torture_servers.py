"""Strangers at the page of `tune`: foreign pages, connections that close early, odd messages.

The page refuses who does not know its address, answers after every tenth case, and
prints no traceback. `python test/torture_servers.py FIRST STOP` runs the cases of a range.
"""

import contextlib
import http.client
import re
import socket
import struct
import sys
import tempfile
from pathlib import Path
from urllib.parse import urlsplit

import msgspec
import numpy as np
import viser
import zstandard
from cli_runner import until_ctrl_c
from conftest import hilly_scan
from torture_cases import run_cases
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

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


@contextlib.contextmanager
def served(folder):
    """Address of the page of `tune`, which must end without a traceback."""
    np.save(folder / 'a.npy', hilly_scan().astype(np.float32))
    words = ('tune', folder / 'a.npy', '-o', folder / 'a.yaml')
    with until_ctrl_c(*words) as process:
        yield process.stdout.readline().strip()


def status(address, path=None, host=None, origin=None, upgrade=True):
    """Status of the answer to a request; what is not given is that of the page itself."""
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=PATIENCE)
    headers = {'Host': host or parts.netloc, **(HANDSHAKE if upgrade else {})}
    with contextlib.closing(connection):
        headers |= {} if origin is None else {'Origin': origin}
        connection.request('GET', parts.path if path is None else path, headers=headers)
        return connection.getresponse().status


def close_early(address, data):
    """Send some bytes, and reset the connection."""
    parts = urlsplit(address)
    with socket.create_connection((parts.hostname, parts.port)) as stranger:
        stranger.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack('ii', 1, 0))
        stranger.sendall(data)


def odd_value(rng):
    """Value that a slider or a list may be sent."""
    values = [
        None, True, -1, 99999, 2**63, 1.5, float('nan'), '', 'no', '<b>', [], {}, [None], [-1],
        [99999], ['x'], [0, 0], [[0]], {'a': 1}, 'x' * 10**5,
    ]  # fmt: skip
    return values[rng.integers(len(values))]


def odd_message(rng, page):
    """Message of a page that is broken, or no message."""
    uuids = [*page.uuids.values(), 'none', None]
    message = {
        'type': 'GuiUpdateMessage',
        'uuid': uuids[rng.integers(len(uuids))],
        'updates': {str(rng.choice(['value', 'value', 'label', 'none'])): odd_value(rng)},
    }
    if rng.random() < 0.5:
        message[str(rng.choice([*message, 'more']))] = odd_value(rng)
    data = bytearray(msgspec.msgpack.encode(message))
    for _ in range(rng.choice([0, 0, 1, 5])):
        data[rng.integers(len(data))] = rng.integers(256)
    return data.decode('latin-1') if rng.random() < 0.1 else bytes(data)


def attack(rng, address):
    """Be one stranger; return what is wrong, or None."""
    parts = urlsplit(address)
    kind = rng.integers(3)
    if kind == 0:
        foreign = str(
            rng.choice(['evil.example', f'evil.example:{parts.port}', '127.0.0.1.a', ''])
        )
        wrong = [{'host': foreign or 'x', 'origin': f'http://{foreign}'},
                 {'origin': f'http://{foreign}'}, {'path': str(rng.choice(['/', '/x', '/%00/']))},
                 {'path': parts.path[: rng.integers(1, len(parts.path))]}]  # fmt: skip
        found = status(address, **wrong[rng.integers(len(wrong))], upgrade=rng.random() < 0.5)
        return None if found == 403 else f'answered with status {found}'
    if kind == 1:
        head = ''.join(f'{name}: {value}\r\n' for name, value in HANDSHAKE.items())
        valid = f'GET {parts.path} HTTP/1.1\r\nHost: {parts.netloc}\r\n{head}\r\n'.encode()
        frames = valid + rng.bytes(30)
        close_early(address, rng.bytes(30) if rng.random() < 0.3 else frames[: rng.integers(400)])
        return None
    with Page(address) as page, contextlib.suppress(ConnectionClosed):
        for _ in range(rng.integers(1, 8)):
            page.socket.send(odd_message(rng, page))
    return None


def main():
    """Attack one page by the cases of the command line."""
    with tempfile.TemporaryDirectory() as folder, served(Path(folder)) as address:

        def run_case(number):
            wrong = attack(np.random.default_rng([23, number]), address)
            if number % 10 == 9:
                with Page(address) as page:
                    page.move()
            return wrong

        try:
            run_cases(run_case)
        except SystemExit as end:
            code = end.code
    # Behind the block, whose end looks for tracebacks.
    sys.exit(code)


if __name__ == '__main__':
    main()
