"""A scan in a browser, drawn by viser: on a page that needs no server, or by a server."""

from __future__ import annotations

import asyncio
import dataclasses
import errno
import html
import io
import logging
import re
import secrets
import socket
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from gp_ground_seg.core.errors import DataError, require
from gp_ground_seg.core.log import LOGGER
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.data.colours import ramp_colours
from gp_ground_seg.lab.plotting.scan import CAMERA, TARGET
from gp_ground_seg.lab.viewers.scene import LEGENDS, RAMPS, Cloud, Mesh, Scene

HOST = '127.0.0.1'
SHOWN = ('class', 'surface')
"""Clouds that a page shows at first."""
BAND_COLOUR = (86, 180, 233)
_BOX = (
    'position:fixed;left:12px;bottom:12px;z-index:9;padding:8px 12px;background:#ffffffd9;'
    'font:13px/1.6 sans-serif;border-radius:6px;max-width:330px'
)


def free_port(port: int, n_ports: int = 1) -> int:
    """Return the first from `port` on that is free with those behind it, `n_ports` in all.

    If it is another one, it is logged. Raises DataError if there is none among a hundred.
    """
    for found in range(port, min(port + 100, 65537 - n_ports)):
        try:
            with ExitStack() as stack:
                for k in range(n_ports):
                    stack.enter_context(socket.create_server((HOST, found + k)))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise DataError(f'--port {found}: {error.strerror}') from error
            continue
        if found != port:
            LOGGER.warning('port %d is in use: %d instead', port, found)
        return found
    raise DataError(f'--port {port}: no free port there; choose another, at most 65535')


@contextmanager
def open_server(port: int) -> Iterator[tuple[Any, str]]:
    """Yield viser's server on this machine, and the address of its page; port 0 is any free one.

    Who does not know the address gets no answer. It prints nothing.
    """
    viser, token = require('viser', 'viser'), secrets.token_urlsafe()
    port = port and free_port(port)
    try:
        with redirect_stdout(io.StringIO()), _guarded(token):
            server = viser.ViserServer(host=HOST, port=port, verbose=False)
    except OSError as error:
        raise DataError(f'--port {port}: {error.strerror}') from error
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


def draw_points(server: Any, name: str, cloud: Cloud, visible: bool = True) -> Any:
    """Add points, and return viser's handle of them."""
    # Half precision, the default, is 6 cm at 100 m.
    return server.scene.add_point_cloud(
        f'/{name}', cloud.points, cloud.colours, precision='float32', point_shading='flat',
        point_size=0.15 if name == 'candidates' else 0.05, visible=visible,
    )  # fmt: skip


def _draw_surface(server: Any, mesh: Mesh) -> None:
    # viser takes colours by way of trimesh and glTF, where they are linear.
    linear = (255.0 * (mesh.colours / 255.0) ** 2.2).astype(np.uint8)
    trimesh = require('trimesh', 'viser')
    solid = trimesh.Trimesh(mesh.vertices, mesh.triangles, vertex_colors=linear, process=False)
    server.scene.add_mesh_trimesh('/surface', solid, cast_shadow=False)


def write_page(path: str | Path, scene: Scene, title: str, config: Config, force: bool) -> None:
    """Write a page that holds everything, and opens from disk."""
    with staged_file(path, force=force) as part, open_server(0) as (server, _):
        for name, cloud in scene.clouds.items():
            draw_points(server, name, cloud, visible=name in SHOWN)
        _draw_surface(server, scene.surface)
        server.scene.add_mesh_simple(
            '/band', scene.band.vertices, scene.band.triangles, color=BAND_COLOUR, opacity=0.3,
            side='double', cast_shadow=False, visible=False,
        )  # fmt: skip
        head, body, rest = server.get_scene_serializer().as_html().rpartition('</body>')
        words = f'<b>{text(title)}</b><br>{legend([*scene.clouds, "surface"], config)}'
        words += '<br>The button at the top right shows and hides them, and the 2-sigma band.'
        part.write_text(f'{head}<div style="{_BOX}">{words}</div>{body}{rest}', 'utf-8')


def text(words: object) -> str:
    """Return HTML that shows `words` as they are: names and messages may come from a file."""
    return html.escape(str(words))


def box(content: str) -> str:
    """Return HTML `content` in the small type of viser's controls."""
    return f'<div style="font-size:12px;padding:4px 12px">{content}</div>'


def legend(names: Iterable[str], config: Config) -> str:
    """Return what the colours mean, as HTML: those of points, and of the ``surface``."""
    limits = config.length_scale
    ramps = {**RAMPS, 'surface': (limits.min, limits.max)}
    units = {'height': ' [m]', 'surface': ', length-scale [m]'}
    samples = ramp_colours(np.linspace(0.0, 1.0, 6), 0.0, 1.0)
    stops = ','.join('rgb({:.0%} {:.0%} {:.0%})'.format(*rgb) for rgb in samples)
    bar = f'<span style="background:linear-gradient(90deg,{stops})">{"&emsp;" * 5}</span>'
    lines = []
    for name in names:
        if name in ramps:
            low, high = ramps[name]
            words = f'{low:g}&nbsp;{bar}&nbsp;{high:g}'
        else:
            words = ' '.join(
                f'<nobr><span style="background:{colour}">&emsp;</span> {word}</nobr>'
                for word, colour in LEGENDS[name].items()
                if word != 'unknown'
            )
        lines.append(f'{name}{units.get(name, "")}: {words}')
    return '<br>'.join(lines)
