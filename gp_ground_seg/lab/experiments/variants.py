"""The engine of the experiments: configurations scored over labelled frames or simulated scans."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.errors import ConfigError, PointCloudError
from gp_ground_seg.core.frame import Label
from gp_ground_seg.core.parameters.config import Config, find_spec
from gp_ground_seg.core.parameters.schema import ParameterValue
from gp_ground_seg.lab.cluster import HERE, Progress, Runner
from gp_ground_seg.lab.scoring.evaluate import (
    OURS,
    KnownScan,
    Method,
    OurMethod,
    Scores,
    load_kitti,
    make_scores,
    score_methods,
)
from gp_ground_seg.lab.scoring.objects import CLASSES, LOW_CLASSES, LOW_HEIGHTS, Objects
from gp_ground_seg.lab.scoring.peers import PatchworkppMethod
from gp_ground_seg.lab.simulation import PLACES, SCENES, SENSORS, Kind, Scene, simulate_scan
from gp_ground_seg.lab.simulation.objects import object_heights
from gp_ground_seg.lab.simulation.scan import SimulatedScan

Changes = Mapping[str, ParameterValue]
"""Values of parameters, by dotted name."""

OBJECT_KINDS = {'vehicle': Kind.BOX, 'person': Kind.PERSON, 'cyclist': Kind.CYCLIST}
"""Kinds of objects that rays hit, by `CLASSES`; crates are boxes too, but no objects."""
TOLD = f'{OURS} told'
"""Ours where it is given the true height of the sensor."""
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


def load_scan(item: Any) -> KnownScan:
    """Read a labelled frame, or simulate a `SimulatedFrame`."""
    return load_simulated(item) if isinstance(item, SimulatedFrame) else load_kitti(item)


def load_simulated(frame: SimulatedFrame) -> KnownScan:
    """Simulate a scan: what the ray hit of the terrain is ground, all else is an obstacle."""
    scene, rng = SCENES[frame.scene](frame.seed), np.random.default_rng(frame.seed)
    made = simulate_scan(scene, SENSORS[frame.sensor], rng, x=frame.x)
    truth = np.where(made.is_ground, Label.GROUND, Label.OBSTACLE).astype(np.uint8)
    return KnownScan(
        frame.sequence, f'{frame.seed}/{frame.x:g}', made.points, {'exact': truth},
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


def simulated_frames(
    sensors: Sequence[str], scenes: Sequence[str], n_seeds: int, places: Sequence[float]
) -> list[SimulatedFrame]:
    """Sensors by scenes by seeds by places; scenes without a free lane from the origin only."""
    cases = itertools.product(sensors, scenes, range(n_seeds), places)
    return [SimulatedFrame(*case) for case in cases if not case[3] or case[1] not in PLACES]


def peer_of(sensor: str) -> PatchworkppMethod:
    """Return Patchwork++ with the place and the height of a simulated sensor."""
    model = SENSORS[sensor]
    return PatchworkppMethod(model.height, model.origin or (0.0, 0.0, 0.0))


def told(config: Config, sensor: str) -> Config:
    """Return parameters with the true height of a simulated sensor."""
    return config.replace(**{'sensor.height': SENSORS[sensor].height_of_cloud})


def refuse_changed(config: Config, names: Iterable[str], *variants: Changes) -> None:
    """Raise ConfigError if `config` changes what an experiment compares.

    A value that one of `variants` has itself contradicts nothing, as in the preset ``paper``.
    """
    for name in sorted(names):
        values = [find_spec(name).default, *(v[name] for v in variants if name in v)]
        if config[name] not in values:
            raise ConfigError(f'{name} = {config[name]}: the experiment sets it, leave it out')


def score_variants(
    items: Sequence[Any],
    variants: Mapping[str, Config],
    peers: Sequence[Method] = (),
    *,
    runner: Runner = HERE,
) -> Scores:
    """Run variants, then `peers`, once on every scan, alternately, each scan without a past."""
    ours = [OurMethod(config, name) for name, config in variants.items()]
    return score_methods(items, [*ours, *peers], load_scan, each_alone=True, runner=runner)


def score_simulated(
    frames: Sequence[SimulatedFrame],
    config: Config,
    runner: Runner = HERE,
    *,
    with_peer: bool,
    told_in: Collection[str] = (),
) -> tuple[Scores, list[str]]:
    """Segment simulated scans, all sensors with the parameters `config`.

    `with_peer` runs Patchwork++ on the same clouds, as `peer_of` makes it; in the scenes `told_in`
    ours runs once more, as `TOLD`. A sensor and scene of which a scan is refused is left out, and
    the second value says so.
    """
    groups = [list(group) for _, group in itertools.groupby(frames, lambda f: f.sequence)]
    parts = runner.run(partial(_score_groups, config, with_peer, told_in), groups)
    outcomes = list(itertools.chain(*parts))
    refused = [found for found in outcomes if isinstance(found, str)]
    scored = [found for found in outcomes if not isinstance(found, str)]
    if not scored:
        raise PointCloudError('; '.join(refused))
    return make_scores(score.rows for score in scored), refused


def _score_groups(
    config: Config,
    with_peer: bool,
    told_in: Collection[str],
    groups: Sequence[Sequence[SimulatedFrame]],
    progress: Progress,
) -> list[Scores | str]:
    """Scores of each group of scans, of one sensor in one scene, or why one is refused."""
    outcomes: list[Scores | str] = []
    for frames in progress(groups):
        sensor, scene, *_ = frames[0]
        ours = {OURS: config} | ({TOLD: told(config, sensor)} if scene in told_in else {})
        try:
            outcomes.append(score_variants(frames, ours, [peer_of(sensor)] * with_peer))
        except PointCloudError as error:
            outcomes.append(f'refused: {error}')
    return outcomes
