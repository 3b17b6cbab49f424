"""Simulated scans with exact labels and heights: ours beside Patchwork++, and objects lost."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.errors import PointCloudError
from gp_ground_seg.core.frame import Label
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.lab.cluster import HERE, Progress, Runner
from gp_ground_seg.lab.scoring.evaluate import (
    ALL,
    KnownScan,
    Method,
    OurMethod,
    Rows,
    Scores,
    load_kitti,
    make_scores,
    score_rows,
    sums,
    title_of,
)
from gp_ground_seg.lab.scoring.metrics import ratio
from gp_ground_seg.lab.scoring.objects import (
    CLASSES,
    LOW_CLASSES,
    LOW_HEIGHTS,
    Objects,
)
from gp_ground_seg.lab.scoring.peers import PatchworkppMethod
from gp_ground_seg.lab.scoring.report import Form, Report, Table
from gp_ground_seg.lab.scoring.tables import (
    COUNT,
    FORMS,
    IOU,
    beside,
    interval_text,
    make_report,
    measured,
    peer_note,
)
from gp_ground_seg.lab.simulation import (
    LOW,
    PLACES,
    SCENES,
    SENSORS,
    STEEP,
    Kind,
    Scene,
    simulate_scan,
)
from gp_ground_seg.lab.simulation.objects import object_heights
from gp_ground_seg.lab.simulation.scan import SimulatedScan

if TYPE_CHECKING:
    from pandas import DataFrame

CROWDED = (*(name for name in PLACES if name not in (*LOW, *STEEP)), 'urban')
"""Scenes where objects hide the ground."""
ROUGH = ('rough', 'road_then_rubble', 'ramp', 'ditch', 'crest', 'blind_slope', *STEEP)
"""Scenes of rough and of steep ground."""
COUNTED = {'vehicle': 'vehicles', 'person': 'persons', 'cyclist': 'persons'}
"""Columns of the objects lost, by classes of `scoring.objects.CLASSES`."""
OBJECT_KINDS = {'vehicle': Kind.BOX, 'person': Kind.PERSON, 'cyclist': Kind.CYCLIST}
"""Kinds of objects that rays hit, by `CLASSES`; crates are boxes too, but no objects."""
LOWEST_OBJECT = 0.7
"""Objects of less than this height are of the nearest of `LOW_CLASSES`, of any kind [m]."""


class SimulatedFrame(NamedTuple):
    """A scan to simulate: `seed` is that of the scene and of the noise, `x` a place [m]."""

    sensor: str
    scene: str
    seed: int
    x: float

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


def load_scan(item: Any) -> KnownScan:
    """Read a labelled frame, or simulate a `SimulatedFrame`."""
    return load_simulated(item) if isinstance(item, SimulatedFrame) else load_kitti(item)


def load_simulated(frame: SimulatedFrame) -> KnownScan:
    """Simulate a scan: what the ray hit of the terrain is ground, all else is an obstacle."""
    scene, rng = SCENES[frame.scene](frame.seed), np.random.default_rng(frame.seed)
    made = simulate_scan(scene, SENSORS[frame.sensor], rng, x=frame.x)
    truth = np.where(made.is_ground, Label.GROUND, Label.OBSTACLE).astype(np.uint8)
    return KnownScan(
        frame.sequence, f'{frame.seed}/{frame.x:g}', made.points, truth,
        ground_z=made.ground_z, is_ground=made.is_ground,
        objects=Objects(_class_of(scene, made), made.object_id, made.ground_z),
        std='ground_std', cluster=f'{frame.scene} {frame.seed}',
    )  # fmt: skip


def _class_of(scene: Scene, made: SimulatedScan) -> npt.NDArray[np.integer]:
    """Index into `CLASSES` of what each ray of a scan hit, (N,); -1: no object."""
    class_of = np.full(len(made.kind), -1)
    for number, name in enumerate(CLASSES):
        if name in OBJECT_KINDS:
            class_of[(made.kind == OBJECT_KINDS[name]) & (made.object_id > 0)] = number
    height = object_heights(scene.terrain, scene.solids)[made.object_id]
    low = height < LOWEST_OBJECT
    nearest = np.abs(height[low, None] - LOW_HEIGHTS).argmin(axis=1)
    class_of[low] = len(CLASSES) - len(LOW_CLASSES) + nearest
    return class_of


def peer_of(sensor: str) -> PatchworkppMethod:
    """Return Patchwork++ with the place and the height of a simulated sensor."""
    model = SENSORS[sensor]
    return PatchworkppMethod(model.height, model.origin or (0.0, 0.0, 0.0))


def score_scenes(
    frames: Sequence[SimulatedFrame],
    config: Config,
    runner: Runner = HERE,
    *,
    with_peer: bool = True,
) -> Report:
    """Score simulated scans by exact labels and heights, and count objects and low things lost.

    An object is lost if more than half of its returns from 0.3 m above the ground are called
    ground; returns on low things count from 0.1 m on. Patchwork++ beside it has its published
    parameters and the true height and place of the sensor. All sensors have one set of
    parameters. Low things, and rough and steep ground, have tables of their own.
    """
    scores, refused = score_simulated(frames, config, runner, with_peer=with_peer)
    scene_of = {name: name.split()[1] for name in scores.sequences}
    tables = {'scenes': _scene_table(scores, refused)}
    for name, make, scenes in (
        ('objects', _lost_table, {*SCENES} - {*LOW}),
        ('low', _low_table, {*LOW}),
        ('rough', _rough_table, {*ROUGH}),
    ):
        if sequences := [one for one, scene in scene_of.items() if scene in scenes]:
            tables[name] = make(scores.of(sequences))
    return make_report(tables, scores, config)


def score_simulated(
    frames: Sequence[SimulatedFrame], config: Config, runner: Runner = HERE, *, with_peer: bool
) -> tuple[Scores, list[str]]:
    """Segment simulated scans, all sensors with the parameters `config`.

    `with_peer` runs Patchwork++ on the same clouds, as `peer_of` makes it. A sensor and scene of
    which a scan is refused is left out, and the second value says so.
    """
    groups = [list(group) for _, group in itertools.groupby(frames, lambda f: f.sequence)]
    parts = runner.run(partial(_score_groups, config, with_peer), groups)
    outcomes = [*itertools.chain(*parts)]
    refused = [found for found in outcomes if isinstance(found, str)]
    if len(refused) == len(outcomes):
        raise PointCloudError('; '.join(refused))
    return make_scores(found for found in outcomes if not isinstance(found, str)), refused


def _score_groups(
    config: Config,
    with_peer: bool,
    groups: Sequence[Sequence[SimulatedFrame]],
    progress: Progress,
) -> list[Rows | str]:
    """Rows of each group of scans, of one sensor in one scene, or why one is refused."""
    outcomes: list[Rows | str] = []
    for frames in progress(groups):
        methods: list[Method] = [OurMethod(config)]
        methods += [peer_of(frames[0].sensor)] * with_peer
        try:
            outcomes.append(score_rows(load_simulated, methods, frames, each_alone=True))
        except PointCloudError as error:
            outcomes.append(f'refused: {error}')
    return outcomes


def _placed(table: DataFrame) -> DataFrame:
    """Return rows by sequence with columns of sensor and scene in place of it."""
    places = [name.split() for name in table.index]
    table = table.reset_index(drop=True)
    table.insert(0, 'sensor', [sensor for sensor, _ in places])
    table.insert(1, 'scene', [scene for _, scene in places])
    return table


def _scene_table(scores: Scores, refused: Sequence[str]) -> Table:
    """One row for each sensor and scene; notes say what is left out."""
    compared = 'iou', 'rmse', 'median_absolute'
    found = measured(scores.scans, 'sequence')[[*compared, 'without_model']]
    table = beside(found, scores.methods, *compared)
    title = (
        'Simulated scans: IoU against exact labels [%], every point counts; height of the '
        'surface under true ground [cm]; gaps: share of it without a model [%]'
    )
    for peer in scores.methods[1:]:
        table['interval'] = [interval_text(scores.of([one]), peer, IOU) for one in table.index]
        title += f'; peer: {title_of(peer)}, with the true height; its surface: the nearest patch'
        title += '; 95 % interval: bootstrap over the scenes of a row, which are few'
    forms = {**FORMS, 'without_model': FORMS['without_model']._replace(title='gaps')}
    return Table(title, _placed(table), forms, refused)


def _lost_table(scores: Scores) -> Table:
    """Objects lost; ours, then the peer if there is one."""
    kinds = scores.objects.assign(kind=scores.objects['class'].map(COUNTED))
    counts = sums(kinds.dropna(subset='kind'), 'sequence', 'kind')
    found = measured(scores.scans, 'sequence')[['iou']]
    forms = dict(FORMS)
    for kind in dict.fromkeys(COUNTED.values()):
        own = counts[counts.index.get_level_values('kind') == kind].droplevel('kind')
        own = own.reindex(found.index, fill_value=0)
        found = found.assign(**{kind: own['n_objects'], f'lost_{kind}': own['n_lost']})
        forms |= {kind: Form(kind, *COUNT), f'lost_{kind}': Form('lost', *COUNT)}
    lost = [name for name in found if name.startswith('lost_')]
    table = beside(found, scores.methods, 'iou', *lost).drop(columns='difference', errors='ignore')
    title = 'IoU of the ground against exact labels [%]; vehicles, persons, cyclists; those lost'
    title += peer_note(scores, ', which gets the true height and place of the sensor')
    return Table(title, _placed(table), forms)


def _low_table(scores: Scores) -> Table:
    """Lay out the share of low things lost, by height; ours, then the peer if there is one."""
    low = scores.objects[scores.objects['class'].isin(LOW_CLASSES)]
    by_class = sums(low, 'sequence', 'class')
    shares = ratio(by_class['n_lost'], by_class['n_objects']).unstack('class')
    things = sums(low, 'sequence')['n_objects'].to_frame('things')
    found = things.join(shares.reindex(columns=[*LOW_CLASSES]))
    table = beside(found, scores.methods, *LOW_CLASSES)
    title = 'Low things by height, in plain view 3 to 20 m away, and the share that is lost [%]'
    forms = {name: Form(name.removeprefix('low, '), '.0f', 100.0) for name in LOW_CLASSES}
    forms['things'] = Form('things', *COUNT)
    return Table(title + peer_note(scores), _placed(table), forms)


def _rough_table(scores: Scores) -> Table:
    """One row for each scene, over its sensors, and one for all."""
    found = measured(scores.scans, 'sequence').reset_index()
    found['scene'] = found['sequence'].str.split().str[1]
    how = {'n_scans': 'sum', 'n_objects': 'sum', 'iou': 'mean', 'rmse': 'mean', 'n_lost': 'sum'}
    found = found.groupby(['method', 'scene'], sort=False).agg(how)
    table = beside(found, scores.methods, 'iou', 'rmse', 'n_lost')
    means = table.mean()
    means.update(table.filter(like='n_').sum())
    table.loc[ALL] = means
    title = (
        'Rough and steep ground, means over the sensors: IoU against exact labels [%]; RMSE of '
        'the surface [cm]; vehicles, persons and crates, and those lost'
    )
    title += peer_note(scores, ', which gets the true height')
    return Table(title, table.reset_index(), FORMS)
