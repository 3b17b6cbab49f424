"""Variants over frames: the lists, the sums, the search; simulated scenes."""

import itertools

import numpy as np
import pytest
from conftest import scene_of, simulated
from evaluation_samples import write_streets

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.core.errors import PointCloudError
from gp_ground_seg.core.parameters.config import PRESETS
from gp_ground_seg.data.semantic_kitti import labelled_frames
from gp_ground_seg.lab.experiments import ablation, scenes, variants
from gp_ground_seg.lab.experiments.ablation import MODELS
from gp_ground_seg.lab.experiments.variants import TOLD
from gp_ground_seg.lab.scoring import evaluate as runner
from gp_ground_seg.lab.scoring.evaluate import OURS, make_scores
from gp_ground_seg.lab.scoring.metrics import count_labels, height_sums, label_ratios
from gp_ground_seg.lab.scoring.objects import CLASSES, count_objects
from gp_ground_seg.lab.scoring.peers import InterpolationMethod, ground_points
from gp_ground_seg.lab.simulation import Kind
from gp_ground_seg.lab.simulation.objects import object_heights

FIXED = Config().replace(**{'learning.mode': 'fixed'})


def iou_of(label, truth):
    return label_ratios(count_labels(label, truth))['iou']


@pytest.fixture(scope='module')
def frames(tmp_path_factory):
    return labelled_frames(write_streets(tmp_path_factory.mktemp('kitti'), s00=2, s08=1))


def test_models_are_what_their_names_say_and_each_way_to_learn_gives_a_theta(frames):
    models = {'constant': 'constant', 'Z': 'line_gradient', 'Z-L': 'latent'}
    configs = {name: Config().replace(**changes) for name, changes in MODELS.items()}
    for title, config in configs.items():
        assert config.length_scale.model == models[title.split(',')[0]]
        assert (config.learning.mode == 'fixed') == ('not learned' in title)
    # The last one is the paper's method.
    assert config == Config().replace(**{'learning.fixed': 'none'})
    points = runner.load_kitti(frames[0]).points
    theta = {
        name: tuple(GroundSegmenter(config).segment(points).fit.theta.values())
        for name, config in configs.items()
    }
    assert len(set(theta.values())) == len(MODELS) - 2
    assert configs['Z-L, learned'] == Config()
    assert len({values for name, values in theta.items() if 'not learned' in name}) == 1


def test_latent_length_scales_win_where_smoothness_changes(monkeypatch):
    """The worth of the latent process; docs/experiments.md has the whole table."""
    names = ('constant, learned', 'Z, learned', 'Z-L, all learned')
    monkeypatch.setattr(ablation, 'MODELS', {name: MODELS[name] for name in names})
    frames = variants.simulated_frames(['hdl-64e'], [ablation.SCENE], 1, ablation.PLACES[1:])
    report = ablation.compare_models(frames, Config())
    constant, gradient, latent, _ = (row['rmse'] for row in report.tables['models'].json())
    assert latent < 0.95 * min(constant, gradient)


def test_pairs_are_differences_of_models_that_learn_alike():
    frames = variants.simulated_frames(['vlp-16'], ['ramp', 'bank'], 1, (0.0,))
    tables = ablation.compare_models(frames, Config()).tables
    of_models = {row['method']: row for row in tables['models'].json()}
    pairs = tables['pairs'].json()
    three = ['Z - constant', 'Z-L - constant', 'Z-L - Z']
    *alike, more, last = [(row['pair'], row['theta']) for row in pairs]
    assert sorted(alike) == sorted(itertools.product(three, ['learned', 'not learned']))
    assert (more, last) == (
        ('Z-L - Z-L', 'all learned - learned'),
        ('Z-L - interpolation', 'learned'),
    )
    for row in pairs[:-2]:
        ours, other = (of_models[f'{name}, {row["theta"]}'] for name in row['pair'].split(' - '))
        for name in ('iou', 'rmse'):
            assert row[name] == pytest.approx(ours[name] - other[name])
            low, high = map(float, row[f'{name}_interval'].removesuffix(' tie').split(' to '))
            assert low - 0.006 <= 100.0 * row[name] <= high + 0.006


def test_steps_go_from_the_paper_to_the_defaults():
    steps = list(ablation.paper_steps().values())
    assert (steps[0], steps[-1]) == (PRESETS['paper'].config, Config())
    for before, after in itertools.pairwise(steps):
        assert before != after


def test_interpolation_joins_lowest_points_that_are_not_too_steep():
    r, z = np.array([5.0, 6.0, 10.0, 20.0]), np.array([-1.7, -1.0, -1.2, -3.0])
    # 0.7 m within 1 m is an obstacle, 0.5 m within 5 m a slope, and so is 1.8 m down in 10 m not.
    assert ground_points(r, z, -1.73) == ([0.0, 5.0, 10.0], [-1.73, -1.7, -1.2])


def test_interpolation_has_the_median_of_three_segments_and_our_labels(frames):
    scan = runner.load_kitti(frames[0])
    plain = InterpolationMethod(Config())
    plain.run(scan.points)
    result = plain.last
    candidates, surface, segment = result.candidates, result.surface, 60
    lines = []
    for k in (segment - 1, segment, segment + 1):
        own = candidates.segment == k
        found = ground_points(candidates.r[own], candidates.z[own], -1.73)
        lines.append(np.interp(surface.knots, *found))
    known = np.isfinite(surface.mean[segment])
    assert known.sum() > 5
    # The height of the sensor is estimated; it only moves what lies before the first point.
    far = known & (surface.knots > 8.0)
    expected = np.median(lines, axis=0)[far]
    np.testing.assert_allclose(surface.mean[segment][far], expected, atol=1e-9)
    assert result.fit.mode == 'fixed'
    assert iou_of(result.label, scan.truths['groundgrid']) > 0.9


def test_scenes_without_a_free_lane_are_seen_from_the_origin_only():
    frames = variants.simulated_frames(['vlp-16'], ['kerb', 'car_park'], 1, (0.0, 6.0))
    places = [(frame.scene, frame.x) for frame in frames]
    assert places == [('kerb', 0.0), ('kerb', 6.0), ('car_park', 0.0)]


@pytest.mark.parametrize('scene', ['hidden_climb', 'traffic_jam', 'low_boxes'])
def test_objects_of_a_simulated_scan_are_those_that_its_rays_hit(scene):
    """Vehicles, persons and cyclists by their kind; lower ones by the nearest of five heights."""
    objects = variants.load_simulated(variants.SimulatedFrame('vlp-16', scene, 1, 0.0)).objects
    made, solids = simulated(scene, seed=1), scene_of(scene, 1).solids
    heights = object_heights(scene_of(scene, 1).terrain, solids)
    names = {Kind.BOX: 'vehicle', Kind.PERSON: 'person', Kind.CYCLIST: 'cyclist'}
    expected = [names.get(kind) if number else None
                for kind, number in zip(made.kind, made.object_id, strict=True)]  # fmt: skip
    for k in np.flatnonzero(heights[made.object_id] < 0.69):
        expected[k] = f'low, {round(heights[made.object_id[k]] + 1e-6, 1):g} m'
    assert [[*CLASSES, None][number] for number in objects.class_of] == expected
    np.testing.assert_array_equal(objects.object_id, made.object_id)


def test_scenes_are_scored_by_ours_with_and_without_the_height_and_by_the_peer():
    frame = variants.SimulatedFrame('hdl-64e-vehicle', 'on_ramp', 0, 0.0)
    report = scenes.score_scenes([frame], FIXED)
    scan, peer = variants.load_simulated(frame), variants.peer_of(frame.sensor)
    told = GroundSegmenter(FIXED.replace(**{'sensor.height': 0.0})).segment(scan.points)
    peer.run(scan.points)
    ours = GroundSegmenter(FIXED).segment(scan.points)
    assert told.pose.height == 0.0 != ours.pose.height
    row = report.tables['rough'].json()[0]
    for who, result in (('', ours), ('told_', told), ('peer_', peer.result())):
        error = (result.ground_z - scan.ground_z)[scan.is_ground]
        assert row[f'{who}iou'] == iou_of(result.label, scan.truths['exact'])
        assert row[f'{who}rmse'] == pytest.approx(np.sqrt(np.nanmean(error**2)))
        lost = count_objects(scan.points, result.label, scan.objects)
        assert row[f'{who}lost'] == sum(one['n_lost'] for one in lost)
    (alone,) = scenes.score_scenes([frame], FIXED, with_peer=False).tables['rough'].json()[:1]
    assert alone.items() <= row.items() and 'told_iou' in alone and 'peer_iou' not in alone


def test_a_scene_that_is_refused_is_said(monkeypatch):
    score = variants.score_variants

    def refuse_car_parks(frames, *rest):
        if frames[0].scene == 'car_park':
            raise PointCloudError('car_park: z does not point up')
        return score(frames, *rest)

    monkeypatch.setattr(variants, 'score_variants', refuse_car_parks)
    frames = variants.simulated_frames(['vlp-16'], ['car_park', 'low_boxes', 'ramp'], 1, (0.0,))
    tables = scenes.score_scenes(frames, FIXED, with_peer=False).tables
    assert tables['scenes'].notes[0] == 'refused: car_park: z does not point up'
    names = {'scenes': ['low_boxes', 'ramp'], 'objects': ['ramp'], 'low': ['low_boxes']}
    names['rough'] = ['ramp', 'all']
    assert {key: [r['scene'] for r in tables[key].json()] for key in names} == names
    with pytest.raises(PointCloudError, match='refused: car_park'):
        scenes.score_objects(frames[:1], FIXED, with_peer=False)


def scored_by_hand():
    """Ours and a peer on three scenes: errors of the height, and objects of two bands."""

    def rows(method, *ious, error, lost):
        height = height_sums(np.zeros(4), np.array([error, error, -3.0 * error, np.nan]))
        scans, objects = [], []
        for scene, iou in zip(('vlp-16 flat', 'vlp-16 ramp', 'os1 ramp'), ious, strict=True):
            key = {'method': method, 'sequence': scene, 'index': ''}
            scans.append({
                **key, **height, 'cluster': scene, 'n_scans': 1, 'seconds': 0.0, 'points': 100,
                'n_changed': 0, 'backend': 'numba', 'n_objects': 6, 'n_lost': lost,
                'exact_tp': iou, 'exact_fp': 100 - iou, 'exact_fn': 0, 'exact_tn': 0,
            })  # fmt: skip
            for k, (name, band) in enumerate((
                ('vehicle', '0-10 m'), ('vehicle', '20-40 m'), ('vehicle', '> 40 m'),
                ('person', '0-10 m'), ('cyclist', '0-10 m'), ('low, 0.3 m', '0-10 m'),
            )):  # fmt: skip
                counts = {'n_returns': 50, 'n_ground': lost * k, 'n_objects': 2, 'n_unknown': 0}
                objects.append({**key, 'class': name, 'range': band, **counts, 'n_lost': lost})
        return {'scans': scans, 'objects': objects}

    parts = rows(OURS, 90, 80, 70, error=0.1, lost=0), rows(TOLD, 90, 80, 90, error=0.1, lost=0)
    return make_scores([*parts, rows('x', 89, 81, 70, error=0.2, lost=1)])


def test_scenes_by_hand_and_behind_is_said():
    """Of each scan the counts are those of test_objects.py."""
    every = scored_by_hand()
    scores = every.of([OURS, 'x'])
    table = scenes.scene_table(scores)
    (note,) = table.notes
    assert note == 'ahead of x on 1 of 3 rows; behind on vlp-16 ramp, os1 ramp'
    row = table.json()[0]
    assert (row['sensor'], row['scene'], row['interval']) == ('vlp-16', 'flat', None)
    found = [row[name] for name in ('iou', 'peer_iou', 'difference', 'share_without_model')]
    assert found == pytest.approx([0.9, 0.89, 0.01, 0.25])
    found = [row[f'{who}{name}'] for name in ('rmse', 'median_absolute') for who in ('', 'peer_')]
    assert found == pytest.approx([*(np.sqrt(11 / 3) * np.array([0.1, 0.2])), 0.1, 0.2])
    table = scenes.lost_table(scores)
    row = table.json()[0]
    assert [row['iou'], row['peer_iou']] == [0.9, 0.89]
    assert [row[name] for name in ('vehicles', 'lost_vehicles', 'peer_lost_vehicles')] == [6, 0, 3]
    assert [row[name] for name in ('persons', 'lost_persons', 'peer_lost_persons')] == [4, 0, 2]
    assert table.notes == ['objects lost: none', 'IoU behind x: vlp-16 ramp']
    (note, _) = scenes.lost_table(scores.of(['x'], ['os1 ramp', 'vlp-16 flat'])).notes * 2
    names = ('vlp-16 flat', 'os1 ramp')
    lost = [f'{name} 3 of 6 vehicles, {name} 2 of 4 persons' for name in names]
    assert note == f'objects lost: {", ".join(lost)}'
    table = scenes.return_table(scores)
    row = table.json()[0]
    assert [row[name] for name in scenes.BANDS] == [0.0, None, 0.0]
    assert [row[f'peer_{name}'] for name in scenes.BANDS] == [0.0, None, 3 / 100]
    assert table.notes == ['more than x: nowhere']
    row = scenes.low_table(scores).json()[0]
    assert (row['things'], row['0.3 m'], row['peer_0.3 m'], row['0.2 m']) == (2, 0.0, 0.5, None)
    flat, ramp, total = scenes.rough_table(every).json()
    assert [row['scene'] for row in (flat, ramp, total)] == ['flat', 'ramp', 'all']
    counts = [(ramp[name], total[name]) for name in ('scans', 'objects', 'lost', 'peer_lost')]
    assert counts == [(2, 3), (12, 18), (0, 0), (2, 3)]
    found = [(row['iou'], row['told_iou'], row['peer_iou']) for row in (flat, ramp, total)]
    expected = [(0.9, 0.9, 0.89), (0.75, 0.85, 0.755), (0.825, 0.875, 0.8225)]
    assert found == [pytest.approx(ratios) for ratios in expected]
    assert total['peer_rmse'] == pytest.approx(0.2 * np.sqrt(11 / 3))


@pytest.mark.slow
@pytest.mark.parametrize(
    ('sensor', 'scene', 'n_seeds', 'largest'),
    [
        ('vlp-32c', 'urban', 8, 0.001),
        ('vlp-32c-31', 'urban', 8, 0.001),
        ('vlp-32c', 'traffic_jam', 2, 0.001),
        ('vlp-32c-31', 'traffic_jam', 8, 0.001),
        ('pandar64', 'traffic_jam', 2, 0.001),
    ],
)
def test_nothing_near_is_taken_for_ground(sensor, scene, n_seeds, largest):
    """Before candidates joined in doubt it was 0.3 to 1.2 %."""
    frames = variants.simulated_frames([sensor], [scene], n_seeds, (0.0,))
    report = scenes.score_objects(frames, Config(), with_peer=False)
    (row,) = report.tables['vehicles'].json()
    assert row['0-10 m'] <= largest, row


@pytest.mark.slow
def test_a_sensor_near_the_ground_loses_few_vehicles():
    """0.15 m over it, of 99 vehicles 20 were lost when what is higher than itself was a seed."""
    frames = variants.simulated_frames(['vlp-16-low'], ['traffic_jam', 'car_park'], 2, (0.0,))
    report = scenes.score_objects(frames, Config(), with_peer=False)
    rows = report.tables['objects'].json()
    assert sum(row['lost_vehicles'] for row in rows) <= 14, rows


@pytest.mark.parametrize(
    'sensor',
    [
        'vlp-32c-pair',
        pytest.param('hdl-64e', marks=pytest.mark.slow),
        pytest.param('os1-128', marks=pytest.mark.slow),
    ],
)
def test_in_traffic_no_vehicle_is_lost(sensor):
    """Cars hide the ground near the sensor; docs/accuracy.md has the table."""
    frames = variants.simulated_frames([sensor], ['traffic_jam', 'car_park'], 1, (0.0,))
    report = scenes.score_objects(frames, Config(), with_peer=False)
    for row in report.tables['objects'].json():
        assert row['vehicles'] > 20 and row['lost_vehicles'] == 0, row
    for row in report.tables['vehicles'].json():
        assert row['0-10 m'] <= 0.01, row
