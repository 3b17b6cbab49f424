"""Scans in Rerun: in its viewer, in a browser, or in a file for either."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from gp_ground_seg.core.errors import DataError, require
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.lab.plotting.scan import CAMERA, TARGET
from gp_ground_seg.lab.viewers.html_page import HOST, free_port
from gp_ground_seg.lab.viewers.scene import RAMPS, Mesh, Scene

HIDDEN = ('height', 'p_ground', 'errors', 'faces', 'candidates', 'band')
"""Clouds and meshes that are hidden at first."""
SERIES = {'IoU': 'IoU [%]', 'lost': 'objects lost', 'latency': 'latency [ms]'}
"""Numbers that are drawn over the frames, and their titles; theta is recorded too."""
NEED_LABELS = ('IoU', 'lost')
ABOUT = f"""\
The eyes in the tree on the left show and hide:

- **class**: ground grey, obstacles orange
- **height** over the ground: {RAMPS['height'][0]:g} m dark blue, {RAMPS['height'][1]:g} m yellow
- **p_ground**, probability of ground: 0 dark blue, 1 yellow
- **errors**, with labels: missed ground blue, false ground purple
- **surface** of the ground: rough dark blue, smooth yellow (length-scale)
- **band**: two standard deviations below it and above
- **faces**: returns in tiles with a vertical face
- **candidates** of the ground: inliers green, outliers black
"""


class Recording:
    """Frames on their way to a viewer or a file, which `stream` is told."""

    def __init__(self, title: str) -> None:
        self._rr = rr = require('rerun', 'rerun-sdk')
        self.stream = rr.RecordingStream('gp_ground_seg')
        self.stream.send_recording_name(title)
        self._has_blueprint = False
        about = rr.TextDocument(ABOUT, media_type='text/markdown')
        self.stream.log('about', about, static=True)

    def log(self, k: int, scene: Scene, result: Segmentation, scores: dict[str, float]) -> None:
        """Add frame `k`."""
        rr, log = self._rr, self.stream.log
        if not self._has_blueprint:
            series = [name for name in SERIES if scores or name not in NEED_LABELS]
            self.stream.send_blueprint(_blueprint(require('rerun.blueprint', 'rerun-sdk'), series))
            self._has_blueprint = True
        self.stream.set_time('frame', sequence=k)
        for name, (points, colours) in scene.clouds.items():
            size = rr.Radius.ui_points(3.0 if name == 'candidates' else 1.5)
            log(f'scan/{name}', rr.Points3D(points, radii=size, colors=colours))
        log('scan/surface', self._mesh(scene.surface, 255))
        log('scan/band', self._mesh(scene.band, 90))
        numbers = {name: value for name, value in scores.items() if name in SERIES}
        numbers |= {f'theta/{name}': value for name, value in result.fit.theta.items()}
        for name, value in {**numbers, 'latency': 1e3 * result.timings['total']}.items():
            log(name, rr.Scalars([value]))

    def _mesh(self, mesh: Mesh, alpha: int) -> Any:
        vertices, triangles, colours = mesh
        return self._rr.Mesh3D(
            vertex_positions=vertices, triangle_indices=triangles, vertex_colors=colours,
            albedo_factor=(255, 255, 255, alpha),
        )  # fmt: skip


def _blueprint(rrb: Any, names: list[str]) -> Any:
    """Return the layout: scan on the left, the series of these names on the right."""
    hidden = {f'scan/{name}': rrb.EntityBehavior(visible=False) for name in HIDDEN}
    eye = rrb.EyeControls3D(position=CAMERA, look_target=TARGET, eye_up=(0.0, 0.0, 1.0))
    scan = rrb.Spatial3DView(origin='scan', name='scan', overrides=hidden, eye_controls=eye)
    about = rrb.TextDocumentView(origin='about', name='what is what')
    series = [rrb.TimeSeriesView(origin=name, name=SERIES[name]) for name in names]
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Tabs(scan, about), rrb.Vertical(*series), column_shares=[2.5, 1.0]),
        rrb.SelectionPanel(state='collapsed'),
        rrb.TimePanel(state='collapsed'),
    )


def _start(words: str, *ports: int) -> subprocess.Popen[bytes]:
    """Start Rerun, and return once it listens at these ports, of this machine only.

    rerun's functions for this listen on every network.
    """
    server = subprocess.Popen(
        [sys.executable, '-m', 'rerun', '--bind', HOST, *words.split()], start_new_session=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        # A stream that finds nobody gives up after a while.
        while not all(map(_is_listening, ports)):
            if server.poll() is not None:
                raise DataError(f'Rerun does not start: try `rerun {words}`')
            time.sleep(0.1)
    except BaseException:
        _stop(server)
        raise
    return server


def _stop(server: subprocess.Popen[bytes]) -> None:
    # The process is a wrapper of the one that serves.
    with suppress(ProcessLookupError):
        os.killpg(server.pid, signal.SIGTERM)
    server.wait()


def open_viewer() -> str:
    """Open Rerun's viewer, which stays open, and return where to send frames."""
    with socket.create_server((HOST, 0)) as free:
        port = free.getsockname()[1]
    _start(f'--port {port} --expect-data-soon', port)
    return f'rerun+http://{HOST}:{port}/proxy'


@contextmanager
def web_viewer(port: int) -> Iterator[tuple[subprocess.Popen[bytes], str, str]]:
    """Serve Rerun's web viewer; yield its process, the page's address, and where to send frames.

    They arrive at the next port.
    """
    require('rerun', 'rerun-sdk')
    port = free_port(port, 2)
    server = _start(f'--serve-web --web-viewer-port {port} --port {port + 1}', port, port + 1)
    try:
        source = f'rerun%2Bhttp%3A%2F%2F{HOST}%3A{port + 1}%2Fproxy'
        yield (
            server,
            f'http://{HOST}:{port}/?url={source}',
            f'rerun+http://{HOST}:{port + 1}/proxy',
        )
    finally:
        _stop(server)


def _is_listening(port: int) -> bool:
    with socket.socket() as trial:
        return trial.connect_ex((HOST, port)) == 0
