"""The engine of the experiments: configurations scored over frames; simulated scenes."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from gp_ground_seg.core.errors import ConfigError, PointCloudError
from gp_ground_seg.core.frame import Label
from gp_ground_seg.core.parameters.config import Config, find_spec
from gp_ground_seg.core.parameters.schema import ParameterValue
from gp_ground_seg.lab.scale.cluster import HERE, Progress, Runner
from gp_ground_seg.lab.scoring import evaluate as methods
from gp_ground_seg.lab.scoring import report as results
from gp_ground_seg.lab.scoring.evaluate import KnownScan, MethodScore, OurMethod
from gp_ground_seg.lab.scoring.intervals import INTERVAL, interval_note, interval_text
from gp_ground_seg.lab.scoring.metrics import RATIOS, class_errors, class_name, ratio
from gp_ground_seg.lab.scoring.objects import BAND_TITLES, CLASSES, Objects
from gp_ground_seg.lab.scoring.patchworkpp import PatchworkppMethod
from gp_ground_seg.lab.scoring.report import Column, Report, Row, Table, percent
from gp_ground_seg.lab.simulation import PLACES, SCENES, SENSORS, Kind, simulate_scan

Changes = Mapping[str, ParameterValue]
"""Values of parameters, by dotted name."""

SCENE_PLACES = (0.0, 6.0)
"""Where the sensor stands in each scene [m]."""
OBJECT_KINDS = {'vehicle': Kind.BOX, 'person': Kind.PERSON, 'cyclist': Kind.CYCLIST}
"""What rays hit of objects, by `CLASSES`; crates are boxes too, but no objects."""


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


def load_simulated(frame: SimulatedFrame) -> KnownScan:
    """Simulate a scan: what the ray hit of the terrain is ground, all else is an obstacle."""
    scene, rng = SCENES[frame.scene](frame.seed), np.random.default_rng(frame.seed)
    made = simulate_scan(scene, SENSORS[frame.sensor], rng, x=frame.x)
    truth = np.where(made.is_ground, Label.GROUND, Label.OBSTACLE).astype(np.uint8)
    class_of = np.full(len(truth), -1)
    for number, name in enumerate(CLASSES):
        class_of[(made.kind == OBJECT_KINDS[name]) & (made.object_id > 0)] = number
    objects = Objects(class_of, made.object_id, made.ground_z)
    return KnownScan(
        frame.sequence, f'{frame.seed}/{frame.x:g}', made.points, {'exact': truth},
        ground_z=made.ground_z, is_ground=made.is_ground, objects=objects,
    )  # fmt: skip


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


def refuse_changed(config: Config, names: Iterable[str]) -> None:
    """Raise ConfigError if `config` changes what an experiment compares."""
    for name in sorted(names):
        if config[name] != find_spec(name).default:
            raise ConfigError(f'{name} = {config[name]}: the experiment sets it, leave it out')


def score_variants(
    items: Sequence[Any],
    load: Callable[[Any], KnownScan],
    variants: Mapping[str, Config],
    peers: Sequence[methods.Method] = (),
    *,
    runner: Runner = HERE,
) -> list[MethodScore]:
    """Run variants, then `peers`, once on every scan, alternately, each scan without a past."""
    with ExitStack() as stack:
        ours = [stack.enter_context(closing(OurMethod(c, name))) for name, c in variants.items()]
        every = [*ours, *peers]
        return methods.score_methods(items, load, every, each_alone=True, runner=runner)


def make_report(
    tables: dict[str, Table], scores: Sequence[MethodScore], base: Config, **facts: Any
) -> Report:
    """Report of scored variants; `base` is what they change, the first is of our method."""
    fit = scores[0].scans[-1].fit
    assert fit is not None
    given = {'config_changes': results.changed_parameters(base), 'config': base.nested()}
    return Report(tables, scan_rows(scores), fit, {**given, **facts})


def scan_rows(scores: Sequence[MethodScore]) -> list[dict[str, Any]]:
    """Every number of each scan of each method; heights in metres, angles in radians."""
    rows = []
    scans = [(score.name, scan) for score in scores for scan in score.scans]
    of_labels = ('tp', 'fp', 'fn', 'tn', *RATIOS)
    of_height = ('n_points', 'n_without_model', 'rmse', 'median_absolute', 'bias', 'smse')
    for method, scan in scans:
        row: dict[str, Any] = {'method': method, 'sequence': scan.sequence}
        row |= {'index': scan.index, 'seconds': scan.seconds}
        for key, confusion in scan.confusions.items():
            row |= {f'{key}_{name}': getattr(confusion, name) for name in of_labels}
        if scan.height is not None:
            row |= {f'{name}_all': getattr(scan.height, name) for name in of_height}
        if scan.calibration is not None:
            row['ece'] = scan.calibration.ece
        if scan.classes:
            main = class_errors(scan.classes)[0]
            row['points'] = sum(count.n_points for count in scan.classes.values())
            row['main_error_class'] = class_name(main.number) if main.errors else ''
        if scan.objects:
            row['objects'] = {
                name: dict(zip(BAND_TITLES, map(dataclasses.asdict, bands), strict=True))
                for name, bands in scan.objects.items()
            }
        if scan.fit is not None and scan.pose is not None:
            pose = scan.pose
            row |= {'status': scan.fit.status, 'n_segments': scan.fit.n_segments}
            row |= {'sensor_height': pose.height, 'sensor_height_estimated': pose.height_estimated}
            row |= {'sensor_roll': pose.roll, 'sensor_pitch': pose.pitch}
        rows.append(row)
    return rows


def score_simulated(
    frames: Sequence[SimulatedFrame],
    tables: Callable[[Sequence[MethodScore], Sequence[str]], dict[str, Table]],
    config: Config,
    with_peer: bool,
    runner: Runner = HERE,
) -> Report:
    """Segment simulated scans, all sensors with the parameters `config`.

    `with_peer` runs Patchwork++ on the same clouds, as `peer_of` makes it. A sensor and scene of
    which a scan is refused is left out; `tables` lays out the scores, with notes that say so.
    """
    groups = [list(own) for _, own in itertools.groupby(frames, lambda frame: frame.sequence)]
    parts = runner.run(partial(_score_groups, config, with_peer), groups)
    outcomes = list(itertools.chain(*parts))
    refused = [one for one in outcomes if isinstance(one, str)]
    found = [one for one in outcomes if not isinstance(one, str)]
    if not found:
        raise PointCloudError('; '.join(refused))
    scores = [methods.pool(own[0].name, own) for own in zip(*found, strict=True)]
    return make_report(tables(scores, refused), scores, config)


def _score_groups(
    config: Config,
    with_peer: bool,
    groups: Sequence[Sequence[SimulatedFrame]],
    progress: Progress,
) -> list[list[MethodScore] | str]:
    """Scores of each group of scans, of one sensor in one scene, or why one is refused."""
    outcomes: list[list[MethodScore] | str] = []
    for frames in progress(groups):
        peers = [peer_of(frames[0].sensor)] if with_peer else []
        try:
            ours = {methods.OURS: config}
            outcomes.append(score_variants(frames, load_simulated, ours, peers))
        except PointCloudError as error:
            outcomes.append(f'refused: {error}')
    return outcomes


def scene_parts(score: MethodScore) -> list[MethodScore]:
    """Return the scans of each scene: of one seed, from all places."""
    seeds: dict[str, list[methods.ScanScore]] = {}
    for scan in score.scans:
        seeds.setdefault(scan.index.split('/')[0], []).append(scan)
    return [MethodScore(score.name, tuple(scans)) for scans in seeds.values()]


def scene_tables(scores: Sequence[MethodScore], refused: Sequence[str] = ()) -> dict[str, Table]:
    """One row for each sensor and scene; a note says where the peer is ahead in IoU."""
    ours, *peers = scores
    rows: list[Row] = []
    behind, ties = [], []
    for group in ours.sequences:
        own = ours.of(group)
        height, (sensor, scene) = own.height, group.split()
        share = ratio(height.n_without_model, height.n_points + height.n_without_model)
        rows.append(
            [
                (Column('sensor'), sensor),
                (Column('scene'), scene),
                (percent('IoU', 'iou'), own.iou),
                (results.centimetres('RMSE', 'rmse'), height.rmse),
                (results.centimetres('median', 'median_absolute'), height.median_absolute),
                (percent('no model', 'share_without_model'), share),
            ]
        )
        for its in (peer.of(group) for peer in peers):
            median = its.height.median_absolute
            rows[-1] += [
                (percent('its IoU', 'peer_iou'), its.iou),
                (percent('ahead', 'difference', '+.2f'), own.iou - its.iou),
                (results.centimetres('its RMSE', 'peer_rmse'), its.height.rmse),
                (results.centimetres('its median', 'peer_median_absolute'), median),
            ]
            interval = interval_text(scene_parts(own), scene_parts(its))
            rows[-1].append((INTERVAL, interval))
            if interval is not None and interval.endswith('tie'):
                ties.append(group)
            elif not own.iou > its.iou:
                behind.append(group)
    n_scans = len(ours.of(ours.sequences[0]).scans)
    title = (
        f'{n_scans} simulated scans per row; IoU against exact labels [%], every point counts; '
        'height of the surface under true ground [cm]; share of it without a model [%]'
    )
    notes = [*refused]
    if peers:
        title += (
            f'; its: of {peers[0].title}, which has the true sensor height, and as surface its '
            'nearest patch'
        )
        title += f'; {interval_note("scenes of each row")}'
        n_ahead = len(rows) - len(behind) - len(ties)
        where = f'; ties on {", ".join(ties)}' if ties else ''
        where += f'; behind on {", ".join(behind)}' if behind else ''
        notes.append(f'ahead of {peers[0].title} on {n_ahead} of {len(rows)} rows{where}')
    return {'scenes': Table.of(rows, title=title, notes=notes)}
