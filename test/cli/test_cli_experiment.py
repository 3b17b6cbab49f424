"""The command `experiment`: tables, options, refusals (also of `evaluate`); Table I."""

import itertools
import json
import sys

import numpy as np
import pytest
from cli_runner import error_line, run
from evaluation_samples import write_frame, write_streets

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.cli.experiment import EXPERIMENTS, THREE
from gp_ground_seg.core.errors import DataError
from gp_ground_seg.data.semantic_kitti import labelled_frames, read_points
from gp_ground_seg.lab import table1 as paper_table
from gp_ground_seg.lab.scoring import evaluate as runner
from gp_ground_seg.lab.scoring.report import records
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
    'scenes --sensors vlp-16 --scenes low_boxes,flat --seeds 1': ('low', 2 * 2),
    'scenes --scenes flat,bank,ramp --sensors vlp-16,mid-360 --seeds 1': ('rough', 2 * 6),
    'scenes --no-peer --sensors vlp-16 --scenes kerb --seeds 1': ('scenes', 1),
    'objects --sensors vlp-16 --scenes hidden_climb,blind_slope --seeds 1': ('scenes', 4),
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


def test_scans_and_parameters_are_those_of_the_options(monkeypatch, capsys):
    found = []

    def note(frames, config, *_):
        """Note the scans."""
        found.append((frames, config))
        raise DataError('enough')

    monkeypatch.setitem(EXPERIMENTS, 'scenes', EXPERIMENTS['scenes']._replace(run=note))
    for words in ('--sensors mid-360,hdl-64e', '--seeds 2 --scenes flat,kerb'):
        assert run('experiment', 'scenes', *words.split(), '--set', 'grid.n_bins=40') == 2
        assert error_line(capsys) == 'enough'
    (first, config), (second, _) = found
    assert config == Config().replace(**{'grid.n_bins': 40})
    for frames, product in (
        (first, (['mid-360', 'hdl-64e'], [*DRIVES, *LOW, *STEEP], range(3))),
        (second, (THREE, ['flat', 'kerb'], range(2))),
    ):
        assert {frame[:3] for frame in frames} == {*itertools.product(*product)}


REFUSED = {
    'experiment ablation': 'either ROOT or --simulated',
    'experiment ablation ROOT --simulated': 'either ROOT or --simulated',
    'experiment ablation ROOT --seeds 2': '--seeds: is for the other kind',
    'experiment ablation --simulated --frame-step 2': '--frame-step: is for the other kind',
    'experiment ablation ROOT --sequences 07': 'no velodyne folder in it; sequences here: 00, 08',
    'experiment ablation --simulated --set length_scale.model=latent2': 'length_scale.model',
    'experiment steps ROOT --set grid.n_bins=40': '--set',
    'experiment scenes --sensors vlp-32': 'must be some of hdl-64e',
    'experiment scenes --scenes flat,flat': 'each once',
    'experiment table1': 'ROOT',
    'experiment table1 ROOT --sequences 08': 'no frame 000000 in sequence 00',
    'experiment objects --json MINE': '--force',
    'experiment': 'NAME',
    'experiment moon': 'moon',
    'evaluate ROOT --sequences 07': 'no velodyne folder in it; sequences here: 00, 08',
    'evaluate ROOT --sequences ,': 'no sequence has labels, of 00, 08',
    'evaluate ROOT --json /no/such/folder/x.json': '/no/such/folder',
    'evaluate ROOT --json MINE': '--force replaces it',
    'evaluate ROOT --cut=-0.1': 'must be a number, at least 0',
    'evaluate ROOT --set sensor.height=0 --peer patchworkpp': 'set sensor.origin_z above 0',
    'evaluate ROOT --against default': '--against default: the same parameters as given',
    'evaluate ROOT --against no.yaml': 'no.yaml: No such file',
    'evaluate ROOT --against paper --peer patchworkpp': '--peer: not allowed with',
    'evaluate no --against paper': 'no: no such file or folder',
    'evaluate MINE': 'no sequences/*/velodyne folder below it (SemanticKITTI layout); scans '
    'without labels need --against',
    **{
        f'evaluate MINE --against paper {option} 2': f'{option}: '
        for option in ('--sequences', '--frame-step', '--cut', '--workers')
    },
}
"""Commands that stop before any frame is read, and what they say."""


@pytest.mark.parametrize('words', REFUSED)
def test_errors_are_said_before_any_frame_is_read(root, words, capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(runner, 'read_points', None)
    target = tmp_path / 'mine.bin'
    target.write_text('mine')
    named = {'ROOT': root, 'MINE': target}
    assert run(*(named.get(word, word) for word in words.split())) == 2
    assert REFUSED[words] in error_line(capsys)
    assert target.read_text() == 'mine'


@pytest.mark.parametrize(
    ('module', 'words'),
    [
        ('pandas', 'evaluate ROOT'),
        ('pandas', 'experiment steps ROOT --no-peer'),
        ('tabulate', 'evaluate ROOT --markdown'),
        ('pypatchworkpp', 'evaluate ROOT --peer patchworkpp'),
    ],
)
def test_a_missing_package_is_said_before_any_frame_is_read(
    root, module, words, monkeypatch, capsys
):
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setattr(runner, 'read_points', None)
    assert run(*(root if word == 'ROOT' else word for word in words.split())) == 2
    line = error_line(capsys)
    assert line.startswith(f'{module} is not installed') and f'pip install {module}' in line


# Table I: its numbers against their definitions.

SEGMENTS = (90, 91)
ROAD = 40
FIRST = 'sequences/10/velodyne/000000.bin'


@pytest.fixture(scope='module')
def measured(tmp_path_factory):
    """Rows of ours with rubble ahead, from segment 90 on; the scan and its classes."""
    folder = tmp_path_factory.mktemp('kitti')
    scan = simulate_scan(SCENES['road_then_rubble'](1), HDL_32E, np.random.default_rng(1), x=12.0)
    semantic = semantic_kitti_labels(scan.kind)
    write_frame(folder, '00', 0, scan.points, semantic)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper_table, 'CHOICES', {('00', '000000'): SEGMENTS})
        patch.setattr(paper_table, 'N_REPEATS', 1)
        rows = table1(labelled_frames(folder), Config()).rows
    return [row for row in rows if row['by'] == 'ours'], scan.points, semantic


@pytest.mark.parametrize(
    ('method', 'model'), [('Z-L', 'latent'), ('Z', 'line_gradient')], ids=['Z-L', 'Z']
)
def test_columns_follow_their_definitions(measured, method, model):
    """Everything anew from a segmentation of its own, but for the times."""
    rows, points, semantic = measured
    z = points[:, 2].astype(float)
    changes = {'length_scale.model': model, 'learning.fixed': 'none'}
    result = GroundSegmenter(Config().replace(**changes)).segment(points)
    candidates, surface = result.candidates, result.surface
    for row, segment in zip(rows, SEGMENTS, strict=True):
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


def test_default_segments_of_real_frames(kitti, monkeypatch):
    """Segments on a slope and on uneven ground, predicted better than by their mean."""
    monkeypatch.setattr(paper_table, 'CHOICES', CHOICES)
    report = table1(labelled_frames(kitti, ['10', '03']), Config())
    assert [row['segment'][-3:] for row in report.rows] == ['157', '158', '147', '148'] * 2
    for row in report.rows[:4]:
        assert row['held out n'] > 200
        for name in ('held out Z-L', 'held out Z', 'in sample Z-L', 'in sample Z'):
            assert 0.0 < row[name] < 0.5
    # Below ours the preset, which learns until it converges, and what the paper printed.
    variances, errors = (records(report.tables[name].frame) for name in ('variances', 'errors'))
    assert [row['by'] for row in errors] == ['ours'] * 4 + ['preset'] * 4 + ['paper'] * 4
    result = GroundSegmenter('paper').segment(read_points(kitti / FIRST))
    assert variances[4]['sigma_f^2'] == pytest.approx(result.fit.theta['sigma_f'] ** 2)
    assert (variances[8]['n_L'], variances[8]['sigma_f^2']) == (23, 0.3663)
    assert [errors[-1][name] for name in ('in sample Z-L', 't Z [s]')] == [4.2903e-19, 0.3412]
    assert errors[-1]['held out Z'] is None
