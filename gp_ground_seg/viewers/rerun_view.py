"""Scans in Rerun: in its viewer, in a browser, or in a file for either."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from gp_ground_seg.errors import DataError, require
from gp_ground_seg.result import Segmentation
from gp_ground_seg.viewers.scene import (
    CAMERA,
    CANDIDATES,
    CLASSES,
    RAMPS,
    TARGET,
    Mesh,
    Scene,
    palette,
)

HOST = '127.0.0.1'
START_TIMEOUT = 20.0  # of the web viewer [s]
HIDDEN = ('height', 'p_ground', 'errors', 'band', 'faces', 'candidates')
"""Entities below ``scan`` that are not shown at first."""
SERIES = {
    'IoU': 'IoU [%]', 'lost': 'objects lost', 'theta': 'theta', 'latency': 'latency [ms]',
}  # fmt: skip
"""What is drawn over the frames, and its titles."""
ABOUT = f"""\
The eyes in the tree on the left show and hide:

- **class**: ground grey, obstacles vermilion
- **height** over the ground: {RAMPS['height'][0]:g} m dark blue, {RAMPS['height'][1]:g} m yellow
- **p_ground**, probability of ground: 0 dark blue, 1 yellow
- **errors**, with labels: missed ground blue, false ground vermilion
- **surface** of the ground: rough dark blue, smooth yellow (length-scale)
- **band**: two standard deviations below it and above
- **faces**: tiles with a vertical face
- **candidates** of the ground: inliers blue, outliers black
"""


class Recording:
    """Frames on their way to a viewer or a file; see rerun's ``RecordingStream`` in `stream`."""

    def __init__(self, title: str) -> None:
        self._rr = rr = require('rerun', 'view')
        self.stream = stream = rr.RecordingStream('gp_ground_seg')
        stream.send_recording_name(title)
        stream.send_blueprint(_blueprint(require('rerun.blueprint', 'view')))
        stream.log('about', rr.TextDocument(ABOUT, media_type='text/markdown'), static=True)
        known = zip(CLASSES, palette(CLASSES).tolist(), strict=True)
        classes = [(k, name, tuple(rgb)) for k, (name, rgb) in enumerate(known)]
        stream.log('scan', rr.ViewCoordinates.FLU, rr.AnnotationContext(classes), static=True)

    def log(self, k: int, scene: Scene, result: Segmentation, scores: dict[str, float]) -> None:
        """Add frame `k`."""
        rr, log, size = self._rr, self.stream.log, self._rr.Radius.ui_points(1.5)
        self.stream.set_time('frame', sequence=k)
        for name, colours in scene.colours.items():
            look = {'class_ids': scene.label} if name == 'class' else {'colors': colours}
            log(f'scan/{name}', rr.Points3D(scene.points, radii=size, **look))
        log('scan/surface', self._mesh(scene.surface, 255))
        log('scan/band', self._mesh(scene.band, 90))
        log('scan/faces', rr.LineStrips3D(scene.faces, colors=(122, 79, 163)))
        colours = palette(CANDIDATES)[1 - scene.is_inlier]
        log('scan/candidates', rr.Points3D(scene.candidates, radii=0.06, colors=colours))
        numbers = {f'theta/{name}': value for name, value in result.fit.theta.items()}
        numbers |= {name: value for name, value in scores.items() if name in SERIES}
        numbers['latency'] = 1e3 * result.timings['total']
        for name, value in numbers.items():
            log(name, rr.Scalars([value]))

    def _mesh(self, mesh: Mesh, alpha: int) -> Any:
        return self._rr.Mesh3D(
            vertex_positions=mesh.vertices,
            triangle_indices=mesh.triangles,
            vertex_colors=mesh.colours,
            albedo_factor=(255, 255, 255, alpha),
        )


def _blueprint(rrb: Any) -> Any:
    """Scan on the left, what changes over the frames on the right."""
    hidden = {f'scan/{name}': rrb.EntityBehavior(visible=False) for name in HIDDEN}
    eye = rrb.EyeControls3D(position=CAMERA, look_target=TARGET, eye_up=(0.0, 0.0, 1.0))
    scan = rrb.Spatial3DView(origin='scan', name='scan', overrides=hidden, eye_controls=eye)
    series = [rrb.TimeSeriesView(origin=name, name=title) for name, title in SERIES.items()]
    about = rrb.TextDocumentView(origin='about', name='what is what')
    left, right = rrb.Tabs(scan, about), rrb.Vertical(*series)
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[2.5, 1.0]),
        rrb.BlueprintPanel(state='expanded'),
        rrb.SelectionPanel(state='collapsed'),
        rrb.TimePanel(state='collapsed'),
    )


@contextmanager
def web_viewer(port: int) -> Iterator[tuple[subprocess.Popen[bytes], str, str]]:
    """Serve Rerun's web viewer; yield its process, the page's address, and where to send frames.

    rerun's own ``serve_web_viewer`` would listen on every network of the machine.
    """
    require('rerun', 'view')
    web, grpc = _free_port(port), _free_port(0)
    server = subprocess.Popen(
        [sys.executable, '-m', 'rerun', '--serve-web', '--bind', HOST, '--port', str(grpc),
         '--web-viewer-port', str(web)],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    try:
        _wait_for(server, grpc)
        sink = f'rerun+http://{HOST}:{grpc}/proxy'
        source = sink.replace('+', '%2B').replace(':', '%3A').replace('/', '%2F')
        yield server, f'http://{HOST}:{web}/?url={source}', sink
    finally:
        # The process is a wrapper of the one that serves.
        os.killpg(server.pid, signal.SIGTERM)
        server.wait()


def _wait_for(server: subprocess.Popen[bytes], port: int) -> None:
    deadline = time.monotonic() + START_TIMEOUT
    while time.monotonic() < deadline and server.poll() is None:
        with socket.socket() as connection:
            if connection.connect_ex((HOST, port)) == 0:
                return
        time.sleep(0.1)
    raise DataError("Rerun's web viewer did not start; --save FILE.rrd needs none")


def _free_port(wanted: int) -> int:
    """Return `wanted` if it is free, any that is for 0."""
    with socket.socket() as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((HOST, wanted))
        except OSError as error:
            raise DataError(f'--port {wanted}: {error.strerror}') from error
        return int(trial.getsockname()[1])
