"""A scan in the browser, with sliders for the parameters: its labels follow.

The page is one that viser serves to this user alone.
"""

import dataclasses
import html
import io
import logging
import math
import re
import secrets
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core import errors
from gp_ground_seg.core.errors import DataError, require
from gp_ground_seg.core.frame import Label
from gp_ground_seg.core.parameters.config import Config, parameter_specs
from gp_ground_seg.core.parameters.schema import AUTO, ParameterSpec
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.data.inputs import Input, Inputs
from gp_ground_seg.data.semantic_kitti import read_entries
from gp_ground_seg.lab.plotting import CAMERA, COLOURS, GREEN, TARGET, words_of_pose
from gp_ground_seg.lab.scoring.evaluate import KnownScan, labelled_scan, score_scan
from gp_ground_seg.lab.scoring.metrics import Labels, label_ratios

Colours = npt.NDArray[np.uint8]
BLACK = '#111111'
LEGENDS = {
    'class': {name: COLOURS[name] for name in ('unknown', 'ground', 'obstacle')},
    'changes': {'now ground': GREEN, 'now obstacle': BLACK},
    'errors': {name: COLOURS[name] for name in ('false ground', 'missed ground')},
}
"""Ways to colour the points, and what their colours mean; all have those of the class too."""


def read_view(item: Input, labels: str | None = None) -> KnownScan:
    """Read a scan, and its labels: a file, or that of SemanticKITTI next to it."""
    points, folder = item.read().xyz, item.path.parent
    path = Path(labels or folder.parent / 'labels' / f'{item.name}.label')
    if labels is None and not (folder.name == 'velodyne' and path.exists()):
        return KnownScan('', item.name, points)
    return labelled_scan('', item.name, points, read_entries(path, len(points)))


def point_colours(name: str, label: Labels, other: Labels) -> Colours:
    """Colours of all points, (N, 3), by the `name` of a legend.

    They are those of the class, and where it differs from `other`, which are labels before or the
    truth, those of the legend: what it is now, or how it is wrong.
    """
    colours, is_ground = palette('class')[label], label == Label.GROUND
    if name != 'class':
        differs = (other != Label.UNKNOWN) & (is_ground != (other == Label.GROUND))
        colours[differs] = palette(name)[np.where(is_ground[differs], 0, 1)]
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

    If the port is in use, the next free one is taken and logged. A request without the
    address gets no answer. It prints nothing.
    """
    viser, token = require('viser', 'viser'), secrets.token_urlsafe()
    if port > LAST_PORT:
        raise DataError(f'--port {port}: must be at most {LAST_PORT}')
    with redirect_stdout(io.StringIO()), _guarded(token):
        server = viser.ViserServer(host=HOST, port=port, verbose=False)
    if port not in (0, server.get_port()):
        errors.LOGGER.warning('port %d is in use: %d instead', port, server.get_port())
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

    viser has no hook for this. Hence the block replaces `websockets.asyncio.server.serve`, which
    viser calls; if a later viser does not call it, nothing is served.
    """
    module, is_guarded = require('websockets.asyncio.server', 'viser'), False
    serve, silent = module.serve, errors.LOGGER.getChild('websockets')
    silent.setLevel(logging.CRITICAL)  # it logs a traceback for a page that sends nonsense

    def guarded(*args: Any, process_request: Callable[[Any, Any], Any], **options: Any) -> Any:
        nonlocal is_guarded
        is_guarded = True

        def process(connection: Any, request: Any) -> Any:
            if not _is_admitted(request, token):
                return connection.respond(403, 'Open the address that gp-ground-seg printed.\n')
            path = request.path.removeprefix(f'/{token}')
            return process_request(connection, dataclasses.replace(request, path=path))

        options |= {'process_request': process, 'logger': silent}
        return serve(*args, **options)

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


def box(content: str) -> str:
    """Return HTML `content` in the small type of viser's controls."""
    return f'<div style="font-size:12px;padding:4px 12px;white-space:pre-line">{content}</div>'


def legend(names: Iterable[str]) -> str:
    """Return what the colours of points mean, as HTML."""
    sample = '<nobr><span style="background:{}">&emsp;</span> {}</nobr>'
    lines = []
    for name in names:
        colours = {word: c for word, c in LEGENDS[name].items() if word != 'unknown'}
        lines.append(f'{name}: {" ".join(sample.format(c, w) for w, c in colours.items())}')
    return '<br>'.join(lines)


_USUAL = {'sensor.height': (0.2, 4.0), 'sensor.roll': (-0.3, 0.3), 'sensor.pitch': (-0.3, 0.3)}
_NO_LABELS = ('frame', 'input', 'output', 'runtime', 'diagnostics')


def tunable() -> list[ParameterSpec]:
    """Parameters that the labels of a scan may depend on."""
    return [spec for spec in parameter_specs() if spec.name.split('.')[0] not in _NO_LABELS]


def slider_range(spec: ParameterSpec, now: Any) -> tuple[Any, Any, Any]:
    """Return least value, greatest value and step of the slider of a parameter.

    The values are those that people use, not all that are accepted: a fifth to five times the
    default, and `now`.
    """
    low, high = _USUAL.get(spec.name, (spec.minimum, spec.maximum))
    if spec.name not in _USUAL and spec.default != AUTO and float(spec.default) > 0.0:
        low, high = max(low, 0.2 * float(spec.default)), min(high, 5.0 * float(spec.default))
    numbers = [low, high, *(float(value) for value in (spec.default, now) if value != AUTO)]
    low, high = min(numbers), max(numbers)
    if spec.type is int:
        return int(low), int(high), 1
    return low, high, 10.0 ** (math.floor(math.log10(high - low)) - 3)


class Tuner:
    """The page of a viser server: `run` keeps its labels up to date with its controls.

    Parameters are those of `config`; those of `names` get a control. `labels` is as of
    `read_view`, `frame` the number of the first of the `inputs` to show.
    """

    def __init__(
        self, server: Any, inputs: Inputs, config: Config, names: Sequence[str],
        labels: str | None = None, frame: int = 0,
    ) -> None:  # fmt: skip
        self._server, self._start, self._reference = server, config, config
        self._segmenter, self._changed = GroundSegmenter(config), threading.Event()
        self._automatic: dict[str, tuple[Any, Any]] = {}  # slider and checkbox
        self._changed.set()
        self._cloud: Any = None
        self._drawn: object = None
        self._view = lru_cache(maxsize=1)(lambda number: read_view(inputs[number], labels))
        self._before = lru_cache(maxsize=1)(self._segment)

        gui, last = server.gui, len(inputs) - 1
        # Sharing would send the scan through a server of viser's makers.
        gui.configure_theme(control_width='large', show_share_button=False, show_logo=False)
        gui.set_panel_label(inputs.path.name)
        self._said = gui.add_html(box('segmenting; compiles for a minute the first time ...'))
        self._table, self._legend = gui.add_markdown(''), gui.add_html('')
        self._frame = gui.add_slider('frame', 0, max(last, 1), 1, frame, visible=last > 0)
        self._colours = gui.add_dropdown('colours', ('changes', 'class', 'errors'))
        self._watch(self._frame, self._colours)
        self._controls = {name: self._add_control(Config.find_spec(name)) for name in names}
        self.add_button('compare with these values', self._compare)

    @property
    def config(self) -> Config:
        """Parameters of the page; raises ConfigError if they contradict each other."""
        return self._start.replace(**{name: read() for name, read in self._controls.items()})

    def add_button(self, title: str, action: Callable[[Config], str | None]) -> None:
        """Add a button; `action` takes the parameters, and returns what to say, if anything."""
        button, said = self._server.gui.add_button(title), self._server.gui.add_html('')
        button.on_click(lambda _event: _tell(said, lambda: action(self.config)))

    def run(self) -> None:
        """Segment for ever whenever something has changed; the newest values count."""
        while self._changed.wait():
            self._changed.clear()
            _tell(self._said, self._update)

    def _update(self) -> str:
        return self.show(self._frame.value, self._colours.value, self.config)

    def _compare(self, config: Config) -> None:
        self._reference = config
        self._changed.set()

    def _watch(self, *controls: Any) -> None:
        """Have `run` segment again when one of the controls changes."""
        for control in controls:
            control.on_update(lambda _event: self._changed.set())

    def _add_control(self, spec: ParameterSpec) -> Callable[[], Any]:
        """Add the control of a parameter, and return what reads it.

        A number has a slider, and a checkbox for `AUTO` if it has that.
        """
        gui, now = self._server.gui, self._start[spec.name]
        hint = f'{spec.description} ({spec.accepted})'
        if spec.type in (bool, str):
            words = {str(option).lower(): option for option in spec.choices or (False, True)}
            first = str(now).lower()
            shown = gui.add_dropdown(spec.name, list(words), initial_value=first, hint=hint)
            self._watch(shown)
            return lambda: words[shown.value]
        low, high, step = slider_range(spec, now)
        number = spec.type(0.5 * (low + high) if now == AUTO else now)
        title = f'{spec.name} [{spec.unit}]' if spec.unit else spec.name
        slider = gui.add_slider(title, low, high, step, number, hint=hint, disabled=now == AUTO)
        _, is_said, effect = spec.description.partition('; larger: ')
        if is_said:
            gui.add_html(box(f'larger: {effect}'))
        if not spec.auto:
            self._watch(slider)
            return lambda: slider.value
        automatic = gui.add_checkbox(AUTO, now == AUTO, hint=f'{spec.name} = {AUTO}')
        automatic.on_update(lambda _event: setattr(slider, 'disabled', automatic.value))
        # Setting the slider to what was estimated segments once more, to the same result.
        self._watch(slider, automatic)
        self._automatic[spec.name] = slider, automatic
        return lambda: AUTO if automatic.value else slider.value

    def _segment(self, number: int, config: Config) -> tuple[Segmentation, dict[str, Any]]:
        """Segment a frame; return the result and its sums against the labels."""
        self._segmenter.configure(config)
        result = self._segmenter.segment(self._view(number).points)
        return result, score_scan(self._view(number), result)['scans'][0]

    def show(self, number: int, name: str, config: Config) -> str:
        """Segment a frame, draw it in the colours of that name, and return its warnings."""
        (before, sums_before), view = self._before(number, self._reference), self._view(number)
        result, sums = self._segment(number, config)
        other = view.truth if name == 'errors' else before.label
        if other is None:
            name, other = 'changes', before.label
        finite = result.label != Label.UNKNOWN
        colours = point_colours(name, result.label, other)[finite]
        drawn = number, result.pose.roll, result.pose.pitch
        with self._server.atomic():
            if drawn == self._drawn:
                self._cloud.colors = colours
            else:
                level = result.pose.level(view.points[:, :3])[finite].astype(np.float32)
                # Half precision, the default, is 6 cm at 100 m.
                self._cloud = self._server.scene.add_point_cloud(
                    '/scan', level, colours, point_size=0.05, precision='float32',
                    point_shading='flat',
                )  # fmt: skip
                self._drawn = drawn
            self._legend.content = box(legend(dict.fromkeys(['class', name])))
            self._table.content = _table(result, before.label, (sums, sums_before))
            for parameter, (slider, automatic) in self._automatic.items():
                if automatic.value:
                    value = round(getattr(result.pose, parameter.split('.')[1]), 3)
                    slider.value = min(max(value, slider.min), slider.max)
        return '\n'.join((*result.warnings, *result.pose.contradictions))


def _tell(place: Any, action: Callable[[], str | None]) -> None:
    """Show at a place of the page what `action` says, or why it failed: the page lives on."""
    try:
        words = action()
    except Exception as error:
        words = str(error) if isinstance(error, errors.GroundSegError) else repr(error)
    # Names and messages may come from a file.
    place.content = box(html.escape(words)) if words else ''


def _table(result: Segmentation, before: Labels, sums: Sequence[dict[str, Any]]) -> str:
    """Numbers of a result and of labels before, and how many labels have changed."""
    both = result.label, before
    rows = {
        word: [errors.in_thousands(np.count_nonzero(label == value)) for label in both]
        for word, value in (('ground', Label.GROUND), ('obstacle', Label.OBSTACLE))
    }
    if 'tp' in sums[0]:
        rows['IoU'] = [f'{100.0 * label_ratios(own)["iou"]:.2f} %' for own in sums]
        rows['objects lost'] = [f'{own["n_lost"]} of {own["n_objects"]}' for own in sums]
    rows['time'] = [f'{1e3 * result.timings["total"]:.0f} ms', '']
    is_ground = result.is_ground[result.label != before]
    numbers = is_ground.size, is_ground.sum(), (~is_ground).sum()
    n_changed, n_ground, n_obstacle = map(errors.in_thousands, numbers)
    return '\n'.join(
        ['| | now | before |', '|---|--:|--:|',
         *(f'| {word} | {now} | {then} |' for word, (now, then) in rows.items()), '',
         f'{n_changed} changed: {n_ground} now ground, {n_obstacle} now obstacle', '',
         f'sensor: {words_of_pose(result.pose)}']
    )  # fmt: skip
