"""The page of `tune` among strangers: who is answered, and what it survives."""

from urllib.parse import urlsplit

import pytest

pytest.importorskip('viser', reason='viser is not installed')
from torture_servers import TOLERANCE, Page, close_early, served, status

pytestmark = pytest.mark.slow


@pytest.fixture(scope='module')
def address(tmp_path_factory):
    """Address of a page; its process must end without a traceback, behind all tests."""
    with served(tmp_path_factory.mktemp('page')) as address:
        yield address


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
