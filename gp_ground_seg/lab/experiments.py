"""The experiments of docs/: functions from scans, parameters and a runner to a report.

The docstring of each is its help. What an experiment compares it sets itself, over the parameters
given; scans are labelled frames, or simulated, with exact labels and heights.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from gp_ground_seg.core.backend import make_backend
from gp_ground_seg.core.errors import in_thousands
from gp_ground_seg.core.frame import Label
from gp_ground_seg.core.parameters.config import Config, find_preset
from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.lab.cluster import HERE, Runner
from gp_ground_seg.lab.scoring import evaluate, report, tables
from gp_ground_seg.lab.scoring.evaluate import KnownScan, Method, OurMethod, Scores
from gp_ground_seg.lab.scoring.metrics import ratio
from gp_ground_seg.lab.scoring.objects import CLASSES, LOW_CLASSES, LOW_HEIGHTS, Objects
from gp_ground_seg.lab.scoring.peers import INTERPOLATION, InterpolationMethod, PatchworkppMethod
from gp_ground_seg.lab.scoring.report import DataFrame, Form, Report, Table
from gp_ground_seg.lab.simulation import LOW, PLACES, SCENES, SENSORS, STEEP, Kind, simulate_scan
from gp_ground_seg.lab.simulation.objects import object_heights
from gp_ground_seg.lab.simulation.scenes import DRIVES
from gp_ground_seg.lab.table1 import table1

Changes = Mapping[str, Any]
"""Values of parameters, by dotted name."""

# Simulated scans.

OBJECT_KINDS = Kind.BOX, Kind.PERSON, Kind.CYCLIST
"""Kinds that rays hit, in the order of `CLASSES`, where they are of an object."""
LOWEST_OBJECT = 0.7
"""Objects of less than this height are of the nearest of `LOW_CLASSES`, of any kind [m]."""


class SimulatedFrame(NamedTuple):
    """A scan to simulate: `seed` is that of the scene and of the noise, `x` a place [m]."""

    sensor: str
    scene: str
    seed: int
    x: float = 0.0

    @property
    def sequence(self) -> str:
        """Scans of one sensor in one kind of scene belong together."""
        return f'{self.sensor} {self.scene}'


def simulated_frames(
    sensors: Sequence[str], scenes: Sequence[str], n_seeds: int, places: Sequence[float]
) -> list[SimulatedFrame]:
    """Sensors by scenes by seeds by places; scenes without a free lane from the origin only."""
    cases = itertools.product(sensors, scenes, range(n_seeds), places)
    return [SimulatedFrame(*case) for case in cases if not case[3] or case[1] not in PLACES]


def load_scan(item: Frame | SimulatedFrame) -> KnownScan:
    """Read a labelled frame, or simulate: what the ray hit of the terrain is ground."""
    if isinstance(item, Frame):
        return evaluate.load_kitti(item)
    scene, rng = SCENES[item.scene](item.seed), np.random.default_rng(item.seed)
    sensor = SENSORS[item.sensor]
    made = simulate_scan(scene, sensor, rng, x=item.x)
    truth = np.where(made.is_ground, Label.GROUND, Label.OBSTACLE).astype(np.uint8)
    of_kind = np.full(len(Kind), -1)
    of_kind[[*OBJECT_KINDS]] = range(len(OBJECT_KINDS))
    class_of = np.where(made.object_id > 0, of_kind[made.kind], -1)
    height = object_heights(scene.terrain, scene.solids)[made.object_id]
    low = height < LOWEST_OBJECT
    nearest = np.abs(height[low, None] - LOW_HEIGHTS).argmin(axis=1)
    class_of[low] = len(CLASSES) - len(LOW_CLASSES) + nearest
    return KnownScan(
        item.sequence, f'{item.seed}/{item.x:g}', made.points, truth,
        ground_z=made.ground_z, objects=Objects(class_of, made.object_id, made.ground_z),
        std='ground_std', cluster=f'{item.scene} {item.seed}',
        mount=(sensor.height, sensor.origin or (0.0, 0.0, 0.0)),
    )  # fmt: skip


# Variants of the method on the same scans.

MODELS: dict[str, Changes] = {
    f'{model}, {how}': {'length_scale.model': name, 'learning.mode': mode}
    for model, name in (('constant', 'constant'), ('Z', 'line_gradient'), ('Z-L', 'latent'))
    for how, mode in (('not learned', 'fixed'), ('learned', 'every_frame'))
}
ALL_LEARNED: Changes = {'length_scale.model': 'latent', 'learning.fixed': 'none'}
MODELS['Z-L, all learned'] = ALL_LEARNED
"""Length-scale models, each with theta given and with sigma_f and sigma_n learned, as by default;
the last one learns all length-scales too, as the paper does."""
PAIRS = [
    *(
        (f'{ours} - {other}', how, f'{ours}, {how}', f'{other}, {how}')
        for other, ours in itertools.combinations(('constant', 'Z', 'Z-L'), 2)
        for how in ('not learned', 'learned')
    ),
    ('Z-L - Z-L', 'all learned - learned', 'Z-L, all learned', 'Z-L, learned'),
    ('Z-L - interpolation', 'learned', 'Z-L, learned', INTERPOLATION),
]
"""Differences that are shown: their titles, what is learned, and the names of the two models."""

STEPS = {
    'vertical faces': ('faces.',),
    'labels by local roughness': ('label.',),
    'sloping mean': ('observation.slope_std',),
    'segments look aside': ('surface.',),
    'gate and lines of the growth': ('growth.', 'lines.'),
    'all else: bins, learning, sensor pose': ('',),
}
"""Steps from the preset ``paper`` to the parameters: beginnings of the names that change."""

CANDIDATES_PER_PSEUDO_INPUT = (1.0, 1.5, 2.0, 3.0, 5.0, 10.0, 30.0)
"""Candidates of a line for each pseudo-input; with the last, most lines have one."""

MODES = {'learning': 'every_frame', 'theta fixed': 'fixed'}
"""Values of ``learning.mode`` that are timed, by their titles."""
N_PASSES = 3
"""How often each frame is timed."""


def score_variants(
    items: Sequence[Any], variants: Mapping[str, Config], peers: Sequence[Method], runner: Runner
) -> tuple[Scores, DataFrame]:
    """Run variants, then `peers`, once on every scan, alternately, each scan without a past.

    Return the scores, and the measures of each method over all scans.
    """
    methods = [*(OurMethod(config, name) for name, config in variants.items()), *peers]
    scores = evaluate.score_methods(items, methods, load_scan, each_alone=True, runner=runner)
    return scores, tables.measured(scores.scans).reset_index()


def _differences(
    scores: Scores, name: str, pairs: Sequence[tuple[str, str]], prefix: str = ''
) -> dict[str, list[Any]]:
    """Columns of the difference of a measure of each pair of methods, and of its interval."""
    measure, value = tables.MEASURES[name], tables.measured(scores.scans)[name]
    return {
        f'{prefix}difference': [value[a] - value[b] if a != b else None for a, b in pairs],
        f'{prefix}interval': [
            tables.interval_text(scores, b, measure, ours=a) if a != b else None for a, b in pairs
        ],
    }


def _counted(scores: Scores) -> str:
    """Say of how many scans a table is, and in what units."""
    n_scans = len(scores.scans) // len(scores.methods)
    return (
        f'{n_scans} scans of {len(scores.sequences)} sequences; IoU [%], RMSE and median of the '
        'height under true ground [cm]'
    )


def compare_models(items: Sequence[Any], config: Config, runner: Runner = HERE) -> Report:
    """Compare length-scale models and ways to learn.

    A constant length-scale, the gradients of the lines (Z), and the latent process (Z-L), and
    beside them a surface that is interpolated between lowest points; then each pair with its
    interval. On labelled frames, or without ROOT on a simulated smooth road that ends in rubble,
    or the rough ground of ``--scenes``, by exact labels and heights.
    """
    variants = {name: config.replace(**changes) for name, changes in MODELS.items()}
    scores, models = score_variants(items, variants, [InterpolationMethod(config)], runner)
    pairs = [(ours, other) for _, _, ours, other in PAIRS]
    rows = report.frame_of({
        'pair': [title for title, *_ in PAIRS],
        'theta': [how for _, how, *_ in PAIRS],
        **_differences(scores, 'iou', pairs, 'iou_'),
        **_differences(scores, 'rmse', pairs, 'rmse_'),
    })  # fmt: skip
    names = 'IoU', 'RMSE'
    forms = {f'{name.lower()}_difference': Form(name, *report.SIGNED) for name in names}
    forms |= {f'{name.lower()}_interval': Form(f'{name}, 95 % interval') for name in names}
    of_pairs = (
        'Differences of IoU [%], where more is better, and of RMSE [cm], where less is; '
        f'{tables.interval_note(scores)}'
    )
    models = models[['method', 'iou', 'rmse', 'median_absolute']]
    parts = {'models': Table(_counted(scores), models), 'pairs': Table(of_pairs, rows, forms)}
    return tables.make_report(parts, scores, config)


def paper_steps(config: Config) -> dict[str, Config]:
    """Return parameters from the paper's to those given, by what is new in each."""
    steps = {'the paper (preset paper)': find_preset('paper').config}
    for title, beginnings in STEPS.items():
        *_, last = steps.values()
        new = {spec.name: value for spec, _, value in last.differences(config)}
        changes = {name: value for name, value in new.items() if name.startswith(beginnings)}
        steps[f'+ {title}'] = last.replace(**changes)
    return steps


def compare_steps(items: Sequence[Any], config: Config, runner: Runner = HERE) -> Report:
    """Go from the paper's method to the defaults, one step after the other.

    Beside Patchwork++, and a surface that is interpolated between lowest points, with our labels.
    """
    steps = paper_steps(config)
    peers: list[Method] = [InterpolationMethod(config), PatchworkppMethod()]
    scores, table = score_variants(items, steps, peers, runner)
    names, last = scores.methods, [*steps][-1]
    above = [names[0], *names[: len(steps) - 1], *[last] * len(peers)]
    table = table.assign(**_differences(scores, 'iou', [*zip(names, above, strict=True)]))
    table = table[['method', 'iou', 'difference', 'interval', 'rmse']]
    title = (
        f'{_counted(scores)}; difference to the row above, below the steps to the last of them; '
        f'{tables.interval_note(scores)}'
    )
    return tables.make_report({'steps': Table(title, table)}, scores, config)


def compare_pseudo_inputs(items: Sequence[Any], config: Config, runner: Runner = HERE) -> Report:
    """Sweep the number of pseudo-inputs: time against precision, the trade-off of Table I.

    All length-scales are learned.
    """
    name = 'latent.candidates_per_pseudo_input'
    variants = {
        f'{n:g}': config.replace(**ALL_LEARNED, **{name: n}) for n in CANDIDATES_PER_PSEUDO_INPUT
    }
    scores, table = score_variants(items, variants, [], runner)
    pairs = [(own, scores.methods[0]) for own in scores.methods]
    table = table.assign(
        interval=_differences(scores, 'rmse', pairs)['interval'],
        n_pseudo_inputs=table['n_pseudo_inputs'] / table['n_segments'],
        median=scores.scans.groupby('method', sort=False)['seconds'].median().to_numpy(),
    )[['method', 'iou', 'rmse', 'interval', 'n_pseudo_inputs', 'median']]
    title = (
        f'{_counted(scores)}; candidates of a line for each pseudo-input; interval of the RMSE '
        f'minus that of the first row; n_L: pseudo-inputs of a segment, mean; time of a frame; '
        f'{tables.interval_note(scores)}'
    )
    forms = {'method': Form('candidates'), 'n_pseudo_inputs': Form('n_L', '.1f')}
    return tables.make_report({'pseudo_inputs': Table(title, table, forms)}, scores, config)


def measure_speed(items: Sequence[Frame], config: Config, runner: Runner = HERE) -> Report:
    """Time each frame by stage, and Patchwork++ on the same frame.

    With theta learned in every frame and with theta fixed, by the backend of the parameters and
    by numpy. Each method takes one thread. Reading is left out. The ratio to Patchwork++ is taken
    frame by frame, so it holds although the speed of the machine drifts. Run nothing else
    meanwhile.
    """
    backends = {'': config.runtime.backend}
    if make_backend(config.runtime).name != 'numpy':
        backends[', numpy'] = 'numpy'
    methods: list[Method] = [
        OurMethod(
            config.replace(**{'learning.mode': mode, 'runtime.backend': backend}), name + end
        )
        for end, backend in backends.items()
        for name, mode in MODES.items()
    ]
    methods.insert(len(MODES), PatchworkppMethod.of_sensor(config.sensor))
    scores = evaluate.score_methods(
        [*items] * N_PASSES, methods,
        # The points alone: what is not scored leaves the caches as they are.
        lambda frame: KnownScan(frame.sequence, frame.index, frame.points), runner=runner,
    )  # fmt: skip
    points = scores.scans['points']
    title = (
        f'Time per frame: {len(items)} frames, {N_PASSES} passes, reading left out; '
        f'{in_thousands(points.median())} points (median), at most {in_thousands(points.max())}'
    )
    times = tables.time_tables(scores, evaluate.PATCHWORKPP, title)
    return tables.make_report(times, scores, config)


# Simulated scenes: ours beside Patchwork++, and objects lost.

ROUGH = ('rough', 'road_then_rubble', 'ramp', 'ditch', 'crest', 'blind_slope', *STEEP)
"""Scenes of rough and of steep ground."""
COUNTED = {'vehicles': ('vehicle',), 'persons': ('person', 'cyclist')}
"""Columns of objects, and their `CLASSES`."""


def score_scenes(items: Sequence[SimulatedFrame], config: Config, runner: Runner = HERE) -> Report:
    """Score simulated scans by exact labels and heights, and count objects lost, low ones too.

    An object is lost if more than half of its returns from 0.3 m above the ground are called
    ground; returns on low objects count from 0.1 m on. Patchwork++ has its published
    parameters and the true height and place of the sensor. All sensors have one set of
    parameters. Low objects, and rough and steep ground, have tables of their own.
    """
    methods: list[Method] = [OurMethod(config), PatchworkppMethod()]
    scores = evaluate.score_methods(items, methods, load_scan, each_alone=True, runner=runner)
    parts = {'scenes': _scene_table(scores)}
    for name, make, scenes in (('low', _low_table, LOW), ('rough', _rough_table, ROUGH)):
        if own := [pair for pair in scores.sequences if pair.split()[1] in scenes]:
            parts[name] = make(scores.of(own))
    return tables.make_report(parts, scores, config)


def _placed(table: DataFrame) -> DataFrame:
    """Return rows by sequence with columns of sensor and scene in place of it."""
    names = table.index.str.split(expand=True).rename(['sensor', 'scene'])
    return table.set_axis(names).reset_index()


def _scene_table(scores: Scores) -> Table:
    """One row for each sensor and scene: ground, height, objects lost."""
    found = tables.measured(scores.scans, 'sequence')[['iou', 'rmse']]
    forms = dict[str, Form]()
    for kind, classes in COUNTED.items():
        own = evaluate.sums(scores.objects[scores.objects['class'].isin(classes)], 'sequence')
        own = own.reindex(found.index, fill_value=0)
        found = found.assign(**{kind: own['n_objects'], f'lost_{kind}': own['n_lost']})
        forms |= {kind: Form(kind, *report.COUNT), f'lost_{kind}': Form('lost', *report.COUNT)}
    table = tables.beside(found, scores).drop(columns='difference')
    title = (
        'IoU of the ground against exact labels [%]; RMSE of the surface [cm]; vehicles, persons '
        'and cyclists, and those lost'
    )
    title += tables.peer_note(scores, ', which gets the true height and place of the sensor')
    return Table(title, _placed(table), forms)


def _low_table(scores: Scores) -> Table:
    """Lay out the share of low things lost, by height; ours, then the peer."""
    low = scores.objects[scores.objects['class'].isin(LOW_CLASSES)]
    by_class = evaluate.sums(low, 'sequence', 'class')
    shares = ratio(by_class['n_lost'], by_class['n_objects']).unstack('class')
    things = evaluate.sums(low, 'sequence')['n_objects'].to_frame('things')
    found = things.join(shares.reindex(columns=[*LOW_CLASSES]))
    title = 'Low objects by height, in plain view 3 to 20 m away, and the share that is lost [%]'
    forms = {name: Form(name.removeprefix('low, '), '.0f', 100.0) for name in LOW_CLASSES}
    forms['things'] = Form('objects', *report.COUNT)
    return Table(title + tables.peer_note(scores), _placed(tables.beside(found, scores)), forms)


def _rough_table(scores: Scores) -> Table:
    """One row for each scene, over its sensors, and one for all."""
    found = tables.measured(scores.scans, 'sequence').reset_index()
    found['scene'] = found['sequence'].str.split().str[1]
    how = {'n_scans': 'sum', 'n_objects': 'sum', 'iou': 'mean', 'rmse': 'mean', 'n_lost': 'sum'}
    found = found.groupby(['method', 'scene'], sort=False).agg(how)
    table = tables.beside(found, scores)
    means = table.mean()
    means.update(table.filter(like='n_').sum())
    table.loc[evaluate.ALL] = means
    title = (
        'Rough and steep ground, means over the sensors: IoU against exact labels [%]; RMSE of '
        'the surface [cm]; vehicles, persons and crates, and those lost'
    )
    title += tables.peer_note(scores, ', which gets the true height')
    return Table(title, table.reset_index())


THREE = ('hdl-64e', 'vlp-16', 'os1-128')


class Experiment(NamedTuple):
    """A function from scans, parameters and a runner to tables; its docstring is the help.

    With `sensors` it simulates scans, by default of these and in these scenes.
    """

    run: Callable[..., Report]
    sensors: Sequence[str] = ()
    scenes: Sequence[str] = ()
    n_seeds: int = 0  # scenes of each kind
    places: Sequence[float] = ()  # of the sensor in each scene [m]
    labelled: bool = True  # whether it takes labelled frames
    is_timed: bool = False  # then it runs in one process


EXPERIMENTS = {
    'ablation': Experiment(compare_models, THREE[:1], ['road_then_rubble'], 10, (0.0, 6.0, 12.0)),
    'steps': Experiment(compare_steps),
    'pseudo-inputs': Experiment(compare_pseudo_inputs, is_timed=True),
    'scenes': Experiment(
        score_scenes, THREE, (*DRIVES, *LOW, *STEEP), 3, (0.0, 6.0), labelled=False
    ),
    'table1': Experiment(table1, is_timed=True),
    'speed': Experiment(measure_speed, is_timed=True),
}
"""Experiments by name: a new one is its function and a row here."""
