"""A scan in a browser, drawn by viser: as one page that needs no server, or by a server."""

from __future__ import annotations

import html
import io
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.errors import DataError, require
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.plotting.style import length_scale_colours
from gp_ground_seg.viewers.scene import (
    CAMERA,
    CANDIDATES,
    CHANGES,
    CLASSES,
    ERRORS,
    RAMPS,
    TARGET,
    Mesh,
    Scene,
    palette,
)

HOST = '127.0.0.1'
POINT_SIZE = 0.05  # [m]
BAND_COLOUR = (86, 180, 233)
SHOWN = ('class', 'surface')


@contextmanager
def open_server(port: int, extra: str) -> Iterator[Any]:
    """viser server on this machine; 0 is any free port. It prints nothing."""
    viser = require('viser', extra)
    try:
        with redirect_stdout(io.StringIO()):
            server = viser.ViserServer(host=HOST, port=port, verbose=False)
    except OSError as error:
        raise DataError(f'--port {port}: {error.strerror}') from error
    try:
        server.initial_camera.position, server.initial_camera.look_at = CAMERA, TARGET
        yield server
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


def draw(server: Any, scene: Scene, shown: tuple[str, ...] = SHOWN) -> None:
    """Add what there is to see, each by its name; what is not `shown` is hidden at first."""
    add = server.scene
    for name, colours in scene.colours.items():
        draw_points(server, name, scene.points, colours, visible=name in shown)
    draw_surface(server, scene.surface, 'surface' in shown)
    band = scene.band
    add.add_mesh_simple(
        '/band', band.vertices, band.triangles, color=BAND_COLOUR, opacity=0.3, side='double',
        cast_shadow=False, receive_shadow=False, visible='band' in shown,
    )  # fmt: skip
    add.add_line_segments(
        '/faces', scene.faces, (122, 79, 163), thickness=0.02, visible='faces' in shown
    )
    colours = palette(CANDIDATES)[1 - scene.is_inlier]
    draw_points(
        server, 'candidates', scene.candidates, colours, 0.15, visible='candidates' in shown
    )


def draw_points(
    server: Any, name: str, points: Any, colours: Any, size: float = POINT_SIZE, **more: Any
) -> Any:
    """Add points, and return viser's handle of them; single precision, half is 6 cm at 100 m."""
    look = {'point_size': size, 'precision': 'float32', 'point_shading': 'flat', **more}
    return server.scene.add_point_cloud(f'/{name}', points, colours, **look)


def draw_surface(server: Any, mesh: Mesh, visible: bool = True) -> Any:
    """Add the surface, with its colours; viser takes them by way of trimesh."""
    # The format in between, glTF, has linear colours.
    linear = (255.0 * (mesh.colours / 255.0) ** 2.2).astype(np.uint8)
    solid = require('trimesh', 'tune').Trimesh(
        mesh.vertices, mesh.triangles, vertex_colors=linear, process=False
    )
    return server.scene.add_mesh_trimesh('/surface', solid, visible=visible, cast_shadow=False)


def legend(names: Iterable[str], config: Config) -> str:
    """Return what the colours mean, as HTML: those of points, and of the ``surface``."""
    known = {'class': CLASSES, 'errors': ERRORS, 'changes': CHANGES}
    limits = config.length_scale
    ramps = {**RAMPS, 'surface': (limits.min, limits.max)}
    units = {'height': ' [m]', 'surface': ', length-scale [m]'}
    lines = []
    for name in names:
        swatches = ' '.join(
            f'<nobr><span style="background:{colour}">&emsp;</span> {word}</nobr>'
            for word, colour in known.get(name, {}).items()
            if word != 'unknown'
        )
        lines.append(f'{name}{units.get(name, "")}: {swatches or _bar(*ramps[name])}')
    return '<br>'.join(lines)


def _bar(low: float, high: float) -> str:
    colours = length_scale_colours(np.geomspace(1.0, 10.0, 6), 1.0, 10.0)
    stops = ','.join('rgb({:.0%} {:.0%} {:.0%})'.format(*rgb) for rgb in colours)
    bar = f'<span style="background:linear-gradient(90deg,{stops})">{"&emsp;" * 5}</span>'
    return f'{low:g}&nbsp;{bar}&nbsp;{high:g}'


BOX = (
    'position:fixed;left:12px;bottom:12px;z-index:9;padding:8px 12px;background:#ffffffd9;'
    'font:13px/1.6 sans-serif;border-radius:6px;max-width:330px'
)


def write_page(path: str | Path, scene: Scene, title: str, config: Config, force: bool) -> None:
    """Write a page that holds everything, and opens from disk."""
    with staged_file(path, force=force) as part, open_server(0, 'view') as server:
        draw(server, scene)
        page = server.get_scene_serializer().as_html()
        words = f'<b>{html.escape(title)}</b><br>{legend([*scene.colours, "surface"], config)}'
        words += '<br>The button at the top right shows and hides: points by '
        words += f'{", ".join(scene.colours)}, surface, band, faces, candidates'
        head, body, rest = page.rpartition('</body>')
        part.write_text(f'{head}<div style="{BOX}">{words}</div>{body}{rest}', 'utf-8')
