"""The command `experiment`: tables, files, options, the commands of the docs; Table I."""

import json
import re
import shlex

import numpy as np
import pytest
from cli_runner import error_line, run
from conftest import REPOSITORY
from evaluation_samples import write_frame, write_streets

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.cli.experiment import EXPERIMENTS, THREE
from gp_ground_seg.cli.main import build_parser
from gp_ground_seg.cli.options import read_config
from gp_ground_seg.core.errors import DataError
from gp_ground_seg.data.semantic_kitti import labelled_frames, read_labels, read_points
from gp_ground_seg.lab import table1 as paper_table
from gp_ground_seg.lab.scoring import evaluate as runner
from gp_ground_seg.lab.simulation import (
    DRIVES,
    HDL_32E,
    LOW,
    SCENES,
    STEEP,
    semantic_kitti_labels,
    simulate_scan,
)
from gp_ground_seg.lab.table1 import CHOICES, VARIANCES, table1

pytestmark = pytest.mark.usefixtures('compiled_code')


@pytest.fixture(scope='module')
def root(tmp_path_factory):
    return write_streets(tmp_path_factory.mktemp('kitti'), s00=3, s08=1)


@pytest.fixture(autouse=True)
def few_places(monkeypatch):
    for name in ('ablation', 'scenes'):
        fewer = EXPERIMENTS[name]._replace(places=(12.0 * (name == 'ablation'),))
        monkeypatch.setitem(EXPERIMENTS, name, fewer)
    chosen = {('00', '000000'): (3, 4), ('00', '000001'): (5,)}
    monkeypatch.setattr(paper_table, 'CHOICES', chosen)
    monkeypatch.setattr(paper_table, 'N_REPEATS', 1)


CASES = {
    'ablation ROOT --frame-step 2 --set grid.n_bins=40': ('models', 8 * 3),
    'ablation --simulated --seeds 1 --set grid.n_bins=40': ('pairs', 8),
    'steps ROOT --frame-step 3': ('steps', 9 * 2),
    'pseudo-inputs ROOT --frame-step 3 --set grid.n_bins=40': ('pseudo_inputs', 7 * 2),
    'scenes --sensors vlp-16,os1-128 --scenes flat,slope --seeds 1': ('scenes', 2 * 4),
    'scenes --sensors vlp-16 --scenes low_boxes,flat --seeds 1': ('low', 2 * 2),
    'scenes --scenes flat,bank,ramp --sensors vlp-16,mid-360 --seeds 1': ('rough', 2 * 6),
    'scenes --no-peer --sensors vlp-16 --scenes kerb --seeds 1': ('scenes', 1),
    'objects --sensors vlp-16 --scenes hidden_climb,hedge --seeds 1': ('objects', 4),
    'table1 ROOT': ('errors', 2 * 3),
    'table1 --preset paper ROOT --set learning.max_evaluations=4': ('errors', 2 * 3),
    'speed ROOT --frame-step 3 --set grid.n_bins=40': ('times', 2 * 5 * 3),
}
"""Words of the command, one of its tables, and the number of all rows."""


@pytest.mark.parametrize('case', CASES)
def test_record_and_markdown_say_the_same(case, root, tmp_path, capsys):
    name, n_rows = CASES[case]
    words = ['experiment', *(root if word == 'ROOT' else word for word in case.split())]
    assert run(*words, '--json', tmp_path / 'a.json', '--markdown') == 0
    shown = [line.split('|')[1:-1] for line in capsys.readouterr().out.splitlines()]
    document = json.loads((tmp_path / 'a.json').read_text())
    assert document['experiment'] == words[1]
    tables = {key: found for key, found in document.items() if isinstance(found, list)}
    assert len(tables.pop('rows')) == n_rows
    assert tables[name]
    for row in (row for table in tables.values() for row in table):
        first = str(next(iter(row.values())))
        assert len(row) in (len(cells) for cells in shown if cells and cells[0].strip() == first)
    assert document['backend'] and document['environment']['cpu']
    if 'grid.n_bins=40' in words:
        assert document['config_changes']['grid.n_bins'] == 40


@pytest.mark.parametrize(
    ('words', 'sensors', 'scenes', 'n_seeds'),
    [
        ('--sensors mid-360,hdl-64e', ['mid-360', 'hdl-64e'], {*DRIVES, *LOW, *STEEP}, 3),
        ('--seeds 2 --scenes flat,kerb', THREE, ['flat', 'kerb'], 2),
    ],
)
def test_scans_and_parameters_are_those_of_the_options(
    words, sensors, scenes, n_seeds, monkeypatch, capsys
):
    found = []

    def note(frames, config, *_):
        """Note the scans."""
        found.append((frames, config))
        raise DataError('enough')

    monkeypatch.setitem(EXPERIMENTS, 'scenes', EXPERIMENTS['scenes']._replace(run=note))
    assert run('experiment', 'scenes', *words.split(), '--set', 'grid.n_bins=40') == 2
    assert error_line(capsys) == 'enough'
    ((frames, config),) = found
    assert config == Config().replace(**{'grid.n_bins': 40})
    assert list(dict.fromkeys(frame.sensor for frame in frames)) == list(sensors)
    assert {frame.scene for frame in frames} == set(scenes)
    assert len(frames) == len(sensors) * len(scenes) * n_seeds


@pytest.mark.parametrize(
    ('words', 'message'),
    [
        ('ablation', 'either ROOT or --simulated'),
        ('ablation ROOT --simulated', 'either ROOT or --simulated'),
        ('ablation ROOT --seeds 2', '--seeds: is for the other kind'),
        ('ablation --simulated --sequences 00', '--sequences: is for the other kind'),
        ('ablation --simulated --frame-step 2', '--frame-step: is for the other kind'),
        ('ablation ROOT --sequences 07', 'no sequence 07; sequences here: 00, 08'),
        ('steps ROOT --set grid.n_bins=40', '--set'),
        ('ablation --simulated --set length_scale.model=latent2', 'length_scale.model'),
        ('ablation ROOT --scenes flat', '--scenes: is for the other kind'),
        ('scenes --sensors vlp-32', 'must be some of hdl-64e'),
        ('scenes --scenes flat,flat', 'each once'),
        ('ablation --seeds 0', 'at least 1'),
        ('table1', 'ROOT'),
        ('table1 ROOT --sequences 08', 'no frame 000000 in sequence 00'),
        ('', 'NAME'),
        ('moon', 'moon'),
        ('objects --json MINE', '--force'),
    ],
)  # fmt: skip
def test_errors_are_said_before_any_frame_is_read(
    root, words, message, capsys, monkeypatch, tmp_path
):
    monkeypatch.setattr(runner, 'read_points', None)
    target = tmp_path / 'mine'
    target.write_text('mine')
    named = {'ROOT': root, 'MINE': target}
    assert run('experiment', *(named.get(word, word) for word in words.split())) == 2
    assert message in error_line(capsys)
    assert target.read_text() == 'mine'


def test_commands_of_the_docs_are_accepted():
    """Those above the tables of the docs, and those in their text."""
    names = set()
    for page in ('experiments', 'accuracy', 'algorithm', 'performance'):
        text = (REPOSITORY / 'docs' / f'{page}.md').read_text(encoding='utf-8')
        for words in re.findall(
            r'`gp-ground-seg ((?:experiment|evaluate|plot|pose) [^`]*?)`', text
        ):
            arguments = build_parser(words.split()[0]).parse_args(shlex.split(words))
            if 'experiment' not in vars(arguments):
                continue
            names.add(arguments.experiment)
            if EXPERIMENTS[arguments.experiment].takes_config:
                read_config(arguments)
    assert names == set(EXPERIMENTS)


# Table I: its numbers against their definitions.

SEGMENTS = (90, 91)
ROAD = 40
FIRST = 'sequences/10/velodyne/000000.bin'


@pytest.fixture(scope='module')
def rubble(tmp_path_factory):
    """Rubble ahead, from segment 90 on."""
    folder = tmp_path_factory.mktemp('kitti')
    scan = simulate_scan(SCENES['road_then_rubble'](1), HDL_32E, np.random.default_rng(1), x=12.0)
    write_frame(folder, '00', 0, scan.points, semantic_kitti_labels(scan.kind))
    return folder


@pytest.fixture(scope='module')
def frame(rubble):
    points = read_points(rubble / 'sequences/00/velodyne/000000.bin')
    return points, read_labels(rubble / 'sequences/00/labels/000000.label', len(points))


@pytest.fixture(scope='module')
def measured(rubble):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper_table, 'CHOICES', {('00', '000000'): SEGMENTS})
        patch.setattr(paper_table, 'N_REPEATS', 1)
        rows = table1(labelled_frames(rubble), Config()).rows
        return [row for row in rows if row['by'] == 'ours']


@pytest.mark.parametrize(
    ('method', 'model'), [('Z-L', 'latent'), ('Z', 'line_gradient')], ids=['Z-L', 'Z']
)
def test_columns_follow_their_definitions(measured, frame, method, model):
    """Everything anew from a segmentation of its own, but for the times."""
    points, semantic = frame
    z = points[:, 2].astype(float)
    changes = {'length_scale.model': model, 'learning.fixed': 'none'}
    result = GroundSegmenter(Config().replace(**changes)).segment(points)
    candidates, surface = result.candidates, result.surface
    for row, segment in zip(measured, SEGMENTS, strict=True):
        own = slice(*candidates.offsets[segment : segment + 2])
        assert row['segment'] == f'00/000000:{segment}'
        assert row['n_PG'] == own.stop - own.start
        assert row['n_L'] == np.count_nonzero(
            np.repeat(np.arange(180), np.diff(result.pseudo.offsets)) == segment
        )
        names = ('sigma_f', 'sigma_n', 'sigma_f_bar', 'sigma_l_bar', 'sigma_n_bar')
        sigma = np.array([result.fit.theta[name] for name in names])
        if method == 'Z-L':
            found = [row[title] for title in VARIANCES]
            np.testing.assert_allclose(found, sigma**2, rtol=1e-12)

        inlier = surface.inlier[own]
        y = candidates.z[own][inlier]
        mu = np.interp(candidates.r[own][inlier], surface.knots, surface.mean[segment])
        assert row[f'inliers {method}'] == len(y)
        smse = np.mean((y - mu) ** 2 / np.var(y))
        assert row[f'in sample {method}'] == pytest.approx(smse, rel=1e-6)

        r = np.hypot(points[:, 0].astype(float), points[:, 1].astype(float))
        azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
        held_out = (azimuth >= 2 * (segment - 90)) & (azimuth < 2 * (segment - 89)) & (r < 90)
        held_out &= (semantic == ROAD) & ~np.isin(z, candidates.z[own])
        assert row['held out n'] == held_out.sum() > 100
        y = z[held_out]
        mu = np.interp(r[held_out], surface.knots, surface.mean[segment])
        smse = np.mean((y - mu) ** 2 / np.var(y))
        # The segmenter takes ranges in the precision of the points.
        assert row[f'held out {method}'] == pytest.approx(smse, rel=1e-6)
        assert row[f't {method} [s]'] > 0.0


def test_theta_is_of_the_whole_frame_and_learned(measured):
    first, second = ([row[title] for title in VARIANCES] for row in measured)
    assert first == second
    given = np.square([0.9, 2.0, 0.25])
    assert (np.abs(first[2:] / given - 1.0) > 1e-4).all()


def test_default_segments_of_real_frames(kitti, monkeypatch):
    """A pair on a slope and one on uneven ground, both predicted better than by their mean."""
    monkeypatch.setattr(paper_table, 'CHOICES', CHOICES)
    report = table1(labelled_frames(kitti, ['10', '03']), Config())
    assert [row['segment'][-3:] for row in report.rows] == ['157', '158', '147', '148'] * 2
    for row in report.rows[:4]:
        assert row['held out n'] > 200
        for name in ('Z-L', 'Z'):
            assert 0.0 < row[f'held out {name}'] < 0.5
            assert 0.0 < row[f'in sample {name}'] < 0.5
    # Below ours the preset, which learns until it converges, and what the paper printed.
    shown = [report.tables[name].json() for name in ('variances', 'errors')]
    for rows in shown:
        assert [row['by'] for row in rows] == ['ours'] * 4 + ['preset'] * 4 + ['paper'] * 4
    of_preset, of_paper = shown[0][4], shown[0][8]
    result = GroundSegmenter('paper').segment(read_points(kitti / FIRST))
    assert of_preset['sigma_f^2'] == pytest.approx(result.fit.theta['sigma_f'] ** 2)
    assert of_paper['n_L'] == 23 and of_paper['sigma_f^2'] == 0.3663
    last = shown[1][-1]
    assert last['in sample Z-L'] == 4.2903e-19 and last['t Z [s]'] == 0.3412
    assert last['held out Z'] is None
