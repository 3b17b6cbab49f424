"""Simulated scans with exact labels and heights: ours beside Patchwork++, and objects lost."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.frame import Label
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.lab.cluster import HERE, Runner
from gp_ground_seg.lab.scoring.evaluate import (
    ALL,
    KnownScan,
    Method,
    OurMethod,
    Scores,
    load_kitti,
    score_methods,
    sums,
)
from gp_ground_seg.lab.scoring.metrics import ratio
from gp_ground_seg.lab.scoring.objects import CLASSES, LOW_CLASSES, LOW_HEIGHTS, Objects
from gp_ground_seg.lab.scoring.peers import PatchworkppMethod
from gp_ground_seg.lab.scoring.report import COUNT, Form, Report, Table
from gp_ground_seg.lab.scoring.tables import beside, make_report, measured, peer_note
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
COUNTED = {'vehicles': ('vehicle',), 'persons': ('person', 'cyclist')}
"""Columns of objects, and their classes of `scoring.objects.CLASSES`."""
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
    scores = score_simulated(frames, config, runner, with_peer=with_peer)
    scene_of = {name: name.split()[1] for name in scores.sequences}
    tables = {'scenes': _scene_table(scores)}
    for name, make, scenes in (('low', _low_table, LOW), ('rough', _rough_table, ROUGH)):
        if sequences := [one for one, scene in scene_of.items() if scene in scenes]:
            tables[name] = make(scores.of(sequences))
    return make_report(tables, scores, config)


def score_simulated(
    frames: Sequence[SimulatedFrame], config: Config, runner: Runner = HERE, *, with_peer: bool
) -> Scores:
    """Segment simulated scans, grouped by sensor, all with the parameters `config`.

    `with_peer` runs Patchwork++ on the same clouds, as `peer_of` makes it.
    """
    parts = []
    for sensor, group in itertools.groupby(frames, attrgetter('sensor')):
        methods: list[Method] = [OurMethod(config), *([peer_of(sensor)] if with_peer else [])]
        parts.append(
            score_methods([*group], methods, load_simulated, each_alone=True, runner=runner)
        )
    return Scores.joined(parts)


def _placed(table: DataFrame) -> DataFrame:
    """Return rows by sequence with columns of sensor and scene in place of it."""
    places = [name.split() for name in table.index]
    table = table.reset_index(drop=True)
    table.insert(0, 'sensor', [sensor for sensor, _ in places])
    table.insert(1, 'scene', [scene for _, scene in places])
    return table


def _scene_table(scores: Scores) -> Table:
    """One row for each sensor and scene: ground, height, objects lost."""
    found = measured(scores.scans, 'sequence')[['iou', 'rmse']]
    forms = dict[str, Form]()
    for kind, classes in COUNTED.items():
        own = sums(scores.objects[scores.objects['class'].isin(classes)], 'sequence')
        own = own.reindex(found.index, fill_value=0)
        found = found.assign(**{kind: own['n_objects'], f'lost_{kind}': own['n_lost']})
        forms |= {kind: Form(kind, *COUNT), f'lost_{kind}': Form('lost', *COUNT)}
    lost = [name for name in found if name.startswith('lost_')]
    table = beside(found, scores, 'iou', 'rmse', *lost)
    title = (
        'IoU of the ground against exact labels [%]; RMSE of the surface [cm]; vehicles, persons '
        'and cyclists, and those lost'
    )
    title += peer_note(scores, ', which gets the true height and place of the sensor')
    return Table(title, _placed(table.drop(columns='difference', errors='ignore')), forms)


def _low_table(scores: Scores) -> Table:
    """Lay out the share of low things lost, by height; ours, then the peer if there is one."""
    low = scores.objects[scores.objects['class'].isin(LOW_CLASSES)]
    by_class = sums(low, 'sequence', 'class')
    shares = ratio(by_class['n_lost'], by_class['n_objects']).unstack('class')
    things = sums(low, 'sequence')['n_objects'].to_frame('things')
    found = things.join(shares.reindex(columns=[*LOW_CLASSES]))
    table = beside(found, scores, *LOW_CLASSES)
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
    table = beside(found, scores, 'iou', 'rmse', 'n_lost')
    means = table.mean()
    means.update(table.filter(like='n_').sum())
    table.loc[ALL] = means
    title = (
        'Rough and steep ground, means over the sensors: IoU against exact labels [%]; RMSE of '
        'the surface [cm]; vehicles, persons and crates, and those lost'
    )
    title += peer_note(scores, ', which gets the true height')
    return Table(title, table.reset_index())
