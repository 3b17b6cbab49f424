"""A scan in the browser, with sliders for the parameters: labels follow at once."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from gp_ground_seg.data.inputs import Inputs
from gp_ground_seg.errors import GroundSegError
from gp_ground_seg.evaluation.metrics import Labels
from gp_ground_seg.frame import Label
from gp_ground_seg.parameters.config import Config, find_spec, parameter_specs
from gp_ground_seg.parameters.schema import AUTO, ParameterSpec, ParameterValue
from gp_ground_seg.result import Segmentation
from gp_ground_seg.segmenter import GroundSegmenter
from gp_ground_seg.viewers.html_page import draw_points, draw_surface, legend
from gp_ground_seg.viewers.scene import View, change_colours, point_colours, read_view
from gp_ground_seg.viewers.scene import surface_mesh

N_STEPS = 400
"""Values that a slider goes through, at most."""
LOG_RANGE = 100.0
"""Ratio of the ends of a range from which on its slider is logarithmic."""
_NO_LABELS = ('frame', 'input', 'runtime', 'diagnostics')
"""Groups of parameters that change no label of a scan."""


def tunable() -> list[ParameterSpec]:
    """Parameters that a label may depend on."""
    return [spec for spec in parameter_specs() if spec.name.split('.')[0] not in _NO_LABELS]


def slider_values(spec: ParameterSpec, now: ParameterValue) -> list[ParameterValue]:
    """Values that a slider of a number goes through, `AUTO` and `now` among them."""
    low, high = spec.minimum, spec.maximum
    assert low is not None and high is not None
    is_log = low > 0.0 and high >= LOG_RANGE * low
    steps = (np.geomspace if is_log else np.linspace)(low, high, N_STEPS + 1)
    short = [low, high, *(float(f'{step:.{2 if is_log else 3}g}') for step in steps)]
    numbers = {spec.type(min(max(value, low), high)) for value in short}
    numbers |= {value for value in (now, spec.default) if not isinstance(value, str)}
    return [*([AUTO] if spec.auto else []), *sorted(numbers)]


class Tuner:
    """The page: `run` keeps its labels up to date.

    Parameters
    ----------
    server : viser.ViserServer
        Server whose page is empty.
    inputs : Inputs
        The scans.
    config : Config
        Parameters to start from; those of `names` get a control.
    names : sequence of str
        Names of parameters.
    labels : str, optional
        As of `read_view`.
    frame : int
        Number of the scan that is shown first.
    """

    def __init__(
        self,
        server: Any,
        inputs: Inputs,
        config: Config,
        names: Sequence[str],
        labels: str | None = None,
        frame: int = 0,
    ) -> None:
        self._server, self._inputs, self._labels = server, inputs, labels
        self._start, self._segmenter = config, GroundSegmenter(config)
        self._wanted = threading.Event()
        self._wanted.set()
        # Scan; labels and numbers with the parameters to compare with: None = to be computed.
        self._view: View | None = None
        self._before: tuple[Labels, dict[str, str]] | None = None
        self._before_config = config
        self._cloud: Any = None
        self._drawn: object = None
        self._mesh: Any = None

        gui, last = server.gui, len(inputs) - 1
        # Sharing would send the scan through a server of viser's makers.
        gui.configure_theme(control_width='large', show_share_button=False, show_logo=False)
        gui.set_panel_label(inputs.path.name)
        self._summary, self._legend = gui.add_markdown('segmenting ...'), gui.add_html('')
        self._frame = gui.add_slider('frame', 0, max(last, 1), 1, frame, visible=last > 0)
        colourings = ('changes', 'class', 'height', 'p_ground', 'errors')
        self._colouring = gui.add_dropdown('colours', colourings)
        self._with_surface = gui.add_checkbox('surface', initial_value=False)
        self._frame.on_update(self._on_frame)
        self._colouring.on_update(self._on_change)
        self._with_surface.on_update(self._on_change)
        self._controls = {name: self._add_control(find_spec(name)) for name in names}
        self.add_action('compare with these values', self._compare)

    @property
    def config(self) -> Config:
        """Parameters of the page; raises ConfigError if they contradict each other."""
        return self._start.replace(**{name: read() for name, read in self._controls.items()})

    def add_action(self, title: str, action: Callable[[Config], str]) -> None:
        """Add a button; `action` is given the parameters, and returns what to say."""
        button, said = self._server.gui.add_button(title), self._server.gui.add_markdown('')

        def run(_event: object) -> None:
            try:
                said.content = action(self.config)
            except GroundSegError as error:
                said.content = f'**{error}**'

        button.on_click(run)

    def run(self) -> None:
        """Segment whenever something has changed, for ever; of several changes the newest."""
        while self._wanted.wait():
            self._wanted.clear()
            try:
                self._show(self.config)
            except GroundSegError as error:
                self._summary.content = f'**{error}**'

    def _on_change(self, _event: object) -> None:
        self._wanted.set()

    def _on_frame(self, _event: object) -> None:
        self._view = None
        self._wanted.set()

    def _compare(self, config: Config) -> str:
        self._before_config, self._before = config, None
        self._wanted.set()
        return ''

    def _add_control(self, spec: ParameterSpec) -> Callable[[], ParameterValue]:
        """Add the control of a parameter, and return what reads it."""
        gui, now, name = self._server.gui, self._start[spec.name], spec.name
        hint = f'{spec.description} ({spec.accepted})'
        if spec.type is bool or spec.type is str:
            if spec.choices:
                handle = gui.add_dropdown(name, spec.choices, initial_value=now, hint=hint)
            elif spec.type is bool:
                handle = gui.add_checkbox(name, now, hint=hint)
            else:
                handle = gui.add_text(name, now, hint=hint)
            handle.on_update(self._on_change)
            return lambda: handle.value
        values, unit = slider_values(spec, now), f' {spec.unit}' if spec.unit else ''

        def title(value: ParameterValue) -> str:
            return f'{name} = {value}{unit if value != AUTO else ""}'

        last = len(values) - 1
        # A slider of viser is even, and shows its position: this one goes over `values`.
        slider = gui.add_multi_slider(
            title(now), 0, last, 1, (values.index(now),), hint=hint,
            marks=((0, f'{values[0]}'), (last, f'{values[-1]}')),
        )  # fmt: skip

        def changed(_event: object) -> None:
            slider.label = title(values[slider.value[0]])
            self._wanted.set()

        slider.on_update(changed)
        return lambda: values[slider.value[0]]

    def _segment(self, view: View, config: Config) -> Segmentation:
        self._segmenter.configure(config)
        # Of this scan alone, whatever was segmented before.
        self._segmenter.reset()
        return self._segmenter.segment(view.points)

    def _show(self, config: Config) -> None:
        number = int(self._frame.value)
        view, before = self._view, self._before
        if view is None:
            view = self._view = read_view(self._inputs[number], self._labels)
            before = None
        if before is None:
            result = self._segment(view, self._before_config)
            # Its time may be that of a first run.
            before = self._before = result.label, {**_numbers(view, result), 'time': ''}
        result = self._segment(view, config)
        colouring = self._colouring.value
        if colouring == 'errors' and view.truth is None:
            colouring = 'changes'
        finite = result.label != Label.UNKNOWN
        if colouring == 'changes':
            colours = change_colours(result.label, before[0])[finite]
        else:
            colours = point_colours(result, view.truth)[colouring][finite]
        drawn = number, result.pose.roll, result.pose.pitch
        with self._server.atomic():
            if drawn == self._drawn:
                self._cloud.colors = colours
            else:
                level = result.pose.level(view.points[:, :3])[finite]
                self._cloud = draw_points(self._server, 'scan', level.astype(np.float32), colours)
                self._drawn = drawn
            if self._mesh is not None:
                self._mesh.remove()
                self._mesh = None
            if self._with_surface.value:
                self._mesh = draw_surface(self._server, surface_mesh(result, config, 0.0))
            shown = [colouring, *(['surface'] if self._mesh else [])]
            words = legend(['class', *shown] if colouring == 'changes' else shown, config)
            self._legend.content = f'<div style="font-size:12px;padding:4px 12px">{words}</div>'
            self._summary.content = _summary(result.label, _numbers(view, result), *before)


def _numbers(view: View, result: Segmentation) -> dict[str, str]:
    """What the table shows of a result."""
    n_ground, n_obstacle = (
        np.count_nonzero(result.label == label) for label in (Label.GROUND, Label.OBSTACLE)
    )
    numbers = {'ground': f'{n_ground:,}', 'obstacle': f'{n_obstacle:,}'}
    if scores := view.scores(result):
        numbers['IoU'] = f'{scores["IoU"]:.2f} %'
        numbers['objects lost'] = f'{scores["lost"]} of {scores["objects"]}'
    numbers['time'] = f'{1e3 * result.timings["total"]:.0f} ms'
    return numbers


def _summary(label: Labels, numbers: dict[str, str], before: Labels, old: dict[str, str]) -> str:
    """Table of the numbers now and before, and how many labels have changed."""
    rows = [f'| {name} | {number} | {old[name]} |' for name, number in numbers.items()]
    ground = (label == Label.GROUND)[label != before]
    n_ground, n_changed = np.count_nonzero(ground), len(ground)
    return '\n'.join(
        ['| | now | before |', '|---|--:|--:|', *rows, '',
         f'{n_changed:,} changed: {n_ground:,} now ground, {n_changed - n_ground:,} now obstacle']
    )  # fmt: skip
