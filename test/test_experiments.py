"""Variants over frames: the lists, the sums, the search; simulated scenes."""

import itertools

import numpy as np
import pytest
from evaluation_samples import scores_of, write_streets

from gp_ground_seg import Config, GroundSegmenter, Label
from gp_ground_seg.core.errors import PointCloudError
from gp_ground_seg.core.parameters.config import PRESETS
from gp_ground_seg.data.semantic_kitti import labelled_frames
from gp_ground_seg.lab.experiments import ablation, scenes, variants
from gp_ground_seg.lab.experiments.ablation import MODELS
from gp_ground_seg.lab.scoring import evaluate as runner
from gp_ground_seg.lab.scoring.metrics import count_labels, height_sums, label_ratios
from gp_ground_seg.lab.scoring.peers import (
    InterpolationMethod,
    PatchworkppMethod,
    ground_points,
)
from gp_ground_seg.lab.simulation import SCENES, SENSORS, Kind, simulate_scan

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
    frames = variants.simulated_frames(['vlp-16'], ['kerb', 'hedge'], 1, (0.0, 6.0))
    places = [(frame.scene, frame.x) for frame in frames]
    assert places == [('kerb', 0.0), ('kerb', 6.0), ('hedge', 0.0)]


def test_lost_objects_follow_their_definitions(monkeypatch):
    sensor, scene = 'vlp-16', 'hidden_climb'
    score = variants.score_variants

    def refuse_hedges(frames, *rest):
        if frames[0].scene == 'hedge':
            raise PointCloudError('hedge: z does not point up')
        return score(frames, *rest)

    monkeypatch.setattr(variants, 'score_variants', refuse_hedges)
    frames = variants.simulated_frames([sensor], [scene, 'hedge'], 1, (0.0,))
    report = scenes.score_objects(frames, FIXED)
    (row,), (shares,) = (report.tables[name].json() for name in ('objects', 'vehicles'))
    made = simulate_scan(SCENES[scene](0), SENSORS[sensor], np.random.default_rng(0))
    x, y, z, _ = made.points.T.astype(float)
    reach, high = np.hypot(x, y), z - made.ground_z >= 0.3
    method = PatchworkppMethod(SENSORS[sensor].height)
    method.run(made.points)
    labels = {
        '': GroundSegmenter(FIXED).segment(made.points).label,
        'peer_': method.result().label,
    }
    for prefix, label in labels.items():
        is_ground = label == Label.GROUND
        truth = np.where(made.is_ground, Label.GROUND, Label.OBSTACLE)
        assert row[f'{prefix}iou'] == iou_of(label, truth)
        for title, kinds in (('vehicles', [Kind.BOX]), ('persons', [Kind.PERSON, Kind.CYCLIST])):
            own = np.isin(made.kind, kinds) & high
            parts = [own & (made.object_id == k) for k in range(1, made.object_id.max() + 1)]
            parts = [part for part in parts if part.sum() >= 10]
            assert row[title] == len(parts) > 0
            n_lost = sum(is_ground[part].mean() > 0.5 for part in parts)
            assert row[f'{prefix}lost_{title}'] == n_lost
        own = (made.kind == Kind.BOX) & high
        for title, low, far in (('0-10 m', 0, 10), ('10-20 m', 10, 20), ('> 20 m', 20, 1e9)):
            band = own & (reach >= low) & (reach < far)
            expected = is_ground[band].mean() if band.any() else None
            assert shares[f'{prefix}{title}'] == pytest.approx(expected)
    notes = report.tables['objects'].notes
    assert notes[0] == 'refused: hedge: z does not point up'
    assert notes[1].startswith(f'objects lost: {sensor} {scene} {row["lost_vehicles"]} of')
    with pytest.raises(PointCloudError, match='refused: hedge'):
        scenes.score_objects(frames[1:], FIXED, with_peer=False)


def test_low_things_lost_follow_their_definitions():
    """By plain loops over the returns of each object of two scenes, ours and the peer's."""
    frames = variants.simulated_frames(['vlp-16'], ['low_boxes', 'low_walls', 'ramp'], 2, (0.0,))
    report = scenes.score_scenes(frames, FIXED)
    assert [row['scene'] for row in report.tables['objects'].json()] == ['ramp']
    rows = report.tables['low'].json()
    assert [row['scene'] for row in rows] == ['low_boxes', 'low_walls']
    for row in rows:
        lost = {}
        for seed in range(2):
            scene = SCENES[row['scene']](seed)
            made = simulate_scan(scene, SENSORS['vlp-16'], np.random.default_rng(seed))
            high = made.points[:, 2] - made.ground_z >= 0.1
            method = PatchworkppMethod(0.8)
            method.run(made.points)
            labels = GroundSegmenter(FIXED).segment(made.points).label, method.result().label
            for number, solid in enumerate(scene.solids, 1):
                own = high & (made.object_id == number)
                if own.sum() >= 3:
                    height = f'{solid.top - float(scene.terrain.height(solid.x, solid.y)):.1f} m'
                    found = [(label[own] == Label.GROUND).mean() > 0.5 for label in labels]
                    lost.setdefault(height, []).append(found)
        assert row['things'] == sum(map(len, lost.values())) >= 5
        for height in ('0.2 m', '0.3 m', '0.4 m', '0.5 m', '0.6 m'):
            expected = np.mean(lost[height], axis=0) if height in lost else (None, None)
            assert (row[height], row[f'peer_{height}']) == pytest.approx(tuple(expected))
    assert len(lost) == 2  # heights of walls


def test_rough_ground_is_a_mean_over_the_sensors_of_ours_with_and_without_the_height():
    sensors = {'vlp-16': 0.8, 'hdl-64e-vehicle': 0.0}
    frames = variants.simulated_frames([*sensors], ['flat', 'on_ramp', 'ditch'], 1, (0.0,))
    report = scenes.score_scenes(frames, FIXED)
    assert [row['scene'] for row in report.tables['rough'].json()] == ['on_ramp', 'ditch', 'all']
    found = {}
    for scene, (sensor, height) in itertools.product(('on_ramp', 'ditch'), sensors.items()):
        made = simulate_scan(SCENES[scene](0), SENSORS[sensor], np.random.default_rng(0))
        ground = made.is_ground
        truth = np.where(ground, Label.GROUND, Label.OBSTACLE)
        told = GroundSegmenter(FIXED.replace(**{'sensor.height': height}))
        peer = variants.peer_of(sensor)
        peer.run(made.points)
        results = {
            '': GroundSegmenter(FIXED).segment(made.points),
            'told_': told.segment(made.points),
            'peer_': peer.result(),
        }
        assert results['told_'].pose.height == height
        for who, result in results.items():
            iou = iou_of(result.label, truth)
            error = (result.ground_z - made.ground_z)[ground]
            found.setdefault((scene, who), []).append((iou, np.sqrt(np.nanmean(error**2))))
    rows = {row['scene']: row for row in report.tables['rough'].json()}
    for (scene, who), values in found.items():
        row = rows[scene]
        expected = np.mean(values, axis=0)
        assert [row[f'{who}iou'], row[f'{who}rmse']] == pytest.approx(expected, rel=1e-5)
    for name, value in rows['all'].items():
        own = [rows[scene][name] for scene in ('on_ramp', 'ditch')] if name != 'scene' else []
        counted = name in ('scans', 'objects') or name.endswith('lost')
        assert not own or value == pytest.approx(sum(own) if counted else np.mean(own))
    assert rows['all']['scans'] == 4 and rows['all']['objects'] > 20

    alone = scenes.score_scenes(frames, FIXED, with_peer=False).tables['rough'].json()
    for row in alone:
        assert row.items() <= rows[row['scene']].items() and 'told_iou' in row
        assert not any(name.startswith('peer_') for name in row)


def test_scenes_by_hand_and_behind_is_said():
    """Scores are those of each scan as `test_lost_objects_follow_their_definitions` has them."""

    def rows(*ious, error):
        height = height_sums(np.zeros(4), np.array([error, error, -3.0 * error, np.nan]))
        return [
            {'sequence': f'vlp-16 {name}', 'index': '', **height,
             'exact_tp': iou, 'exact_fp': 100 - iou, 'exact_fn': 0, 'exact_tn': 0}
            for name, iou in zip(('flat', 'ramp', 'kerb'), ious, strict=True)
        ]  # fmt: skip

    scores = scores_of(y=rows(90, 80, 70, error=0.1), x=rows(89, 81, 70, error=0.2))
    table = scenes.scene_table(scores)
    (note,) = table.notes
    assert note == 'ahead of x on 1 of 3 rows; behind on vlp-16 ramp, vlp-16 kerb'
    row = table.json()[0]
    assert (row['sensor'], row['scene'], row['interval']) == ('vlp-16', 'flat', None)
    found = [row[name] for name in ('iou', 'peer_iou', 'difference', 'share_without_model')]
    assert found == pytest.approx([0.9, 0.89, 0.01, 0.25])
    found = [row[f'{who}{name}'] for name in ('rmse', 'median_absolute') for who in ('', 'peer_')]
    assert found == pytest.approx([*(np.sqrt(11 / 3) * np.array([0.1, 0.2])), 0.1, 0.2])
    row = scenes.lost_table(scores).json()[0]
    assert [row[name] for name in ('vehicles', 'lost_vehicles', 'peer_lost_persons')] == [0, 0, 0]


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
