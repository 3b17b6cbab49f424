"""Scans with their labels, and the page in a browser that viser serves to this user alone."""

from __future__ import annotations

import asyncio
import dataclasses
import html
import io
import logging
import re
import secrets
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, redirect_stdout
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.errors import DataError, require
from gp_ground_seg.core.frame import Label
from gp_ground_seg.core.log import LOGGER
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.data.colours import COLOURS, HEIGHTS, ramp_colours
from gp_ground_seg.data.inputs import Input
from gp_ground_seg.data.semantic_kitti import read_entries
from gp_ground_seg.lab.plotting.scan import CAMERA, GREEN, TARGET
from gp_ground_seg.lab.scoring.metrics import GROUNDGRID, Labels, count_labels, label_ratios
from gp_ground_seg.lab.scoring.objects import Objects, count_objects, labelled_objects

Colours = npt.NDArray[np.uint8]
BLACK = '#111111'
LEGENDS = {
    'class': {name: COLOURS[name] for name in ('unknown', 'ground', 'obstacle')},
    'changes': {'now ground': GREEN, 'now obstacle': BLACK},
    'errors': {
        name: COLOURS[name] for name in ('not scored', 'right', 'missed ground', 'false ground')
    },
}
RAMPS = {'height': HEIGHTS, 'p_ground': (0.0, 1.0)}
"""Ends of the ramp from dark blue to yellow of the height over the ground [m], and of p_ground."""


class View(NamedTuple):
    """A scan to look at, with its true labels and objects where they are known."""

    points: npt.NDArray[np.floating]  # (N, >=3)
    truth: Labels | None = None  # (N,) true `Label`; UNKNOWN does not count
    objects: Objects | None = None

    def scores(self, label: Labels) -> dict[str, float]:
        """Return IoU [%], objects lost and objects; nothing where the truth is not known."""
        if self.truth is None or self.objects is None:
            return {}
        rows = count_objects(self.points, label, self.objects)
        n_lost, n_objects = (sum(row[name] for row in rows) for name in ('n_lost', 'n_objects'))
        iou = 100.0 * label_ratios(count_labels(label, self.truth))['iou']
        return {'IoU': iou, 'lost': n_lost, 'objects': n_objects}


def read_view(item: Input, labels: str | None = None) -> View:
    """Read a scan, and its labels: a file, or what SemanticKITTI has beside the scan."""
    points, path = item.read().xyz, labels
    beside = item.path.parent.parent / 'labels' / f'{item.name}.label'
    if path is None and item.path.parent.name == 'velodyne' and beside.exists():
        path = str(beside)
    if path is None:
        return View(points)
    entries = read_entries(path, len(points))
    truth = GROUNDGRID.truth(entries & 0xFFFF, points[:, 2])
    objects = labelled_objects(points, entries, truth == Label.GROUND)
    return View(points, truth, objects)


def point_colours(name: str, result: Segmentation, other: Labels | None = None) -> Colours:
    """Colours of all points, (N, 3), by `name`.

    It is ``class`` or of `RAMPS`; ``errors`` against `other`, the truth; or ``changes``: the
    class, and where it differs from `other`, what it is now.
    """
    is_ground = result.label == Label.GROUND
    if name in RAMPS:
        shares = ramp_colours(getattr(result, name), *RAMPS[name])
        return np.asarray((255.0 * shares).round(), dtype=np.uint8)
    if name == 'errors' and other is not None:
        kind = np.where(is_ground == (other == Label.GROUND), 1, np.where(is_ground, 3, 2))
        kind[other == Label.UNKNOWN] = 0
        return palette(name)[kind]
    colours = palette('class')[result.label]
    if name == 'changes' and other is not None:
        changed = result.label != other
        colours[changed] = palette(name)[np.where(is_ground[changed], 0, 1)]
    return colours


def palette(name: str) -> Colours:
    """Return the colours of a legend, (n, 3)."""
    colours = [[*bytes.fromhex(colour[1:])] for colour in LEGENDS[name].values()]
    return np.array(colours, dtype=np.uint8)


HOST = '127.0.0.1'
LAST_PORT = 64_535
"""viser tries a port and the thousand that follow."""


@contextmanager
def open_server(port: int) -> Iterator[tuple[Any, str]]:
    """Yield viser's server on this machine, and the address of its page; port 0 is any free one.

    If the port is in use, the next free one is taken and logged. Who does not know the address
    gets no answer. It prints nothing.
    """
    viser, token = require('viser', 'viser'), secrets.token_urlsafe()
    if port > LAST_PORT:
        raise DataError(f'--port {port}: must be at most {LAST_PORT}')
    with redirect_stdout(io.StringIO()), _guarded(token):
        server = viser.ViserServer(host=HOST, port=port, verbose=False)
    if port not in (0, server.get_port()):
        LOGGER.warning('port %d is in use: %d instead', port, server.get_port())
    server.initial_camera.position, server.initial_camera.look_at = CAMERA, TARGET
    try:
        yield server, f'http://{HOST}:{server.get_port()}/{token}'
    finally:
        # A click may still be at work, and set what nobody sees any more.
        warnings.filterwarnings('ignore', category=UserWarning, module='viser')
        with redirect_stdout(io.StringIO()):
            server.stop()


@contextmanager
def _guarded(token: str) -> Iterator[None]:
    """Let the server of websockets that viser starts in the block answer only to the token.

    viser has no hook for this. Hence `websockets.asyncio.server.serve`, which it calls, is another
    one meanwhile; if a later viser does not call it, nothing is served.
    """
    module, is_guarded = require('websockets.asyncio.server', 'viser'), False
    serve, silent = module.serve, LOGGER.getChild('websockets')
    silent.setLevel(logging.CRITICAL)  # it logs tracebacks of connections, as errors

    def ignore(error: object) -> None:
        LOGGER.warning('the page: ignored what cannot be read (%s)', type(error).__name__)

    def guarded(
        handle: Callable[[Any], Any], host: str, port: int,
        process_request: Callable[[Any, Any], Any], **options: Any,
    ) -> Any:  # fmt: skip
        nonlocal is_guarded
        is_guarded = True
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda _loop, context: ignore(context.get('exception')))

        def process(connection: Any, request: Any) -> Any:
            if not _is_admitted(request, token):
                return connection.respond(403, 'Open the address that gp-ground-seg printed.\n')
            path = request.path.removeprefix(f'/{token}')
            return process_request(connection, dataclasses.replace(request, path=path))

        async def handle_any(connection: Any) -> None:
            try:
                await handle(connection)
            except Exception as error:  # of a page that sends anything
                ignore(error)

        options |= {'process_request': process, 'logger': silent}
        return serve(handle_any, host, port, **options)

    module.serve = guarded
    try:
        yield
    finally:
        module.serve = serve
    if not is_guarded:
        raise DataError('this version of viser cannot be kept to this user: install viser 1.1')


def _is_admitted(request: Any, token: str) -> bool:
    """Whether a request has the token, asks for this machine, and is of no other page.

    Another Host is a foreign page whose name leads here, which is its own origin to a browser.
    """
    hosts, origins = (request.headers.get_all(name) for name in ('Host', 'Origin'))
    given = request.path[1:].partition('?')[0].partition('/')[0]
    return (
        len(hosts) == 1
        and re.fullmatch(rf'({re.escape(HOST)}|localhost)(:\d+)?', hosts[0]) is not None
        and origins in ([], [f'http://{hosts[0]}'])
        and secrets.compare_digest(given.encode(errors='replace'), token.encode())
    )


def text(words: object) -> str:
    """Return HTML that shows `words` as they are: names and messages may come from a file."""
    return html.escape(str(words))


def box(content: str) -> str:
    """Return HTML `content` in the small type of viser's controls."""
    return f'<div style="font-size:12px;padding:4px 12px">{content}</div>'


def legend(names: Iterable[str]) -> str:
    """Return what the colours of points mean, as HTML."""
    samples = ramp_colours(np.linspace(0.0, 1.0, 6), 0.0, 1.0)
    stops = ','.join('rgb({:.0%} {:.0%} {:.0%})'.format(*rgb) for rgb in samples)
    bar = f'<span style="background:linear-gradient(90deg,{stops})">{"&emsp;" * 5}</span>'
    lines = []
    for name in names:
        if name in RAMPS:
            low, high = RAMPS[name]
            words = f'{low:g}&nbsp;{bar}&nbsp;{high:g}'
        else:
            words = ' '.join(
                f'<nobr><span style="background:{colour}">&emsp;</span> {word}</nobr>'
                for word, colour in LEGENDS[name].items()
                if word != 'unknown'
            )
        lines.append(f'{name}{" [m]" * (name == "height")}: {words}')
    return '<br>'.join(lines)
