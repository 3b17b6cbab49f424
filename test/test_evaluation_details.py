"""Scores by range and class, the CSV by frame, and the sheet of the worst frames."""

import csv
import json
import math

import numpy as np
import pytest
from evaluation_samples import HeightRule, street, write_streets
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from matplotlib.image import imread
from test_cli_evaluate import run, table

from gp_ground_seg import Label
from gp_ground_seg.data.semantic_kitti import Frame, read_points
from gp_ground_seg.errors import DataError
from gp_ground_seg.evaluation.class_errors import class_errors
from gp_ground_seg.evaluation.conventions import GROUNDGRID, PATCHWORK
from gp_ground_seg.evaluation.evaluate import evaluate, labelled_frames
from gp_ground_seg.evaluation.frames_csv import write_frames_csv
from gp_ground_seg.evaluation.rings import RING_EDGES, count_rings, ring_titles
from gp_ground_seg.evaluation.scores import ClassCount, Confusion, FrameScore, count_confusion
from gp_ground_seg.evaluation.worst import WorstFrames
from gp_ground_seg.plotting import birds_eye
from gp_ground_seg.plotting.style import DPI

LABELS = st.sampled_from([0, 1, 2])


@given(
    hnp.arrays(
        np.float32,
        st.tuples(st.integers(0, 40), st.just(2)),
        elements=st.floats(-60, 60, width=32),
    ),
    st.data(),
)
def test_rings_against_a_loop(xy, data):
    label, truth = (data.draw(hnp.arrays(np.uint8, len(xy), elements=LABELS)) for _ in range(2))
    rings = count_rings(label, truth, xy)
    assert len(rings) == len(ring_titles()) == len(RING_EDGES) - 1
    for k, ring in enumerate(rings):
        inside = np.array(
            [RING_EDGES[k] <= math.hypot(*map(float, p)) < RING_EDGES[k + 1] for p in xy], bool
        )
        assert ring == count_confusion(label[inside], truth[inside])
    assert sum(rings, Confusion()) == count_confusion(label, truth)


def test_rings_hold_their_inner_edge_and_no_point_without_a_range():
    xy = np.array(
        [[0, 0], [10, 0], [0, -50], [3e3, 0], [np.nan, 1], [np.inf, 0]], dtype=np.float32
    )
    ones = np.ones(6, dtype=np.uint8)
    counts = [ring.tp for ring in count_rings(ones, ones, xy)]
    assert counts == [1, 1, 0, 0, 0, 2]
    assert ring_titles()[0] == '0-10 m' and ring_titles()[-1] == '> 50 m'


def test_class_errors_by_hand():
    found = class_errors({40: ClassCount(10, 7), 50: ClassCount(9, 4), 70: ClassCount(8, 8)})
    assert [one.number for one in found] == [50, 40, 70]
    assert [(one.missed, one.false, one.errors) for one in found] == [
        (0, 4, 4),
        (3, 0, 3),
        (0,) * 3,
    ]
    high_vegetation = class_errors({70: ClassCount(8, 8)}, PATCHWORK)
    assert high_vegetation[0].false == 8


def test_errors_of_classes_and_of_rings_are_all_errors(tmp_path):
    write_streets(tmp_path, s00=2)
    methods = [HeightRule('misses', -1.72), HeightRule('invents', -1.0)]
    misses, invents = evaluate(labelled_frames(tmp_path), methods)
    assert misses.pooled('groundgrid').fn > 0 and invents.pooled('groundgrid').fp > 0
    for score in (misses, invents):
        pooled = score.pooled('groundgrid')
        found = class_errors(score.classes())
        assert sum(one.missed for one in found) == pooled.fn
        assert sum(one.false for one in found) == pooled.fp
        assert sum(score.rings(), Confusion()) == pooled


@pytest.fixture(scope='module')
def evaluated(tmp_path_factory):
    folder = tmp_path_factory.mktemp('evaluated')
    root = write_streets(folder / 'kitti', s00=2, s08=1)
    names = ('a.json', 'a.csv', 'a.png')
    options = zip(('--json', '--frames-csv', '--sheet'), (folder / n for n in names), strict=True)
    words = [word for pair in options for word in pair]
    assert run(root, *words, '--worst', 2, '--peer', 'patchworkpp') == 0
    return folder


def test_ring_and_class_tables_say_what_the_json_says(evaluated, capsys):
    run(evaluated / 'kitti', '--peer', 'patchworkpp')
    output = capsys.readouterr().out
    methods = json.loads((evaluated / 'a.json').read_text())['methods']
    ours, peer = methods['gp_ground_seg'], methods['patchworkpp']
    rows = table(output, 'Horizontal range')
    assert list(rows) == list(ours['rings']) == list(ring_titles())
    for title, ring in ours['rings'].items():
        if ring['iou'] is None:
            assert rows[title][-3:] == ['-'] * 3
            continue
        iou, its = 100 * ring['iou'], 100 * peer['rings'][title]['iou']
        assert rows[title][-3:] == [f'{iou:.2f}', f'{its:.2f}', f'{iou - its:+.2f}']
    rows = table(output, 'Classes')
    assert sum(one['share_points'] for one in ours['classes'].values()) == pytest.approx(1.0)
    assert sum(one['share_errors'] for one in ours['classes'].values()) == pytest.approx(1.0)
    for one in ours['classes'].values():
        counts_as, _, share, as_ground, missed, false, of_errors = rows[one['name']]
        assert share == f'{100 * one["share_points"]:.2f}'
        assert as_ground == f'{100 * one["share_ground"]:.2f}'
        if counts_as == 'left out':
            assert (missed, false, of_errors) == ('-', '-', '-')
            continue
        wrong = {'ground': one['missed_ground'], 'obstacle': one['false_ground']}[counts_as]
        shown = f'{100 * wrong / one["points"]:.2f}'
        assert (missed, false) == ((shown, '-') if counts_as == 'ground' else ('-', shown))
        assert of_errors == f'{100 * one["share_errors"]:.2f}'


def test_csv_says_what_the_json_says(evaluated):
    rows = list(csv.DictReader((evaluated / 'a.csv').read_text().splitlines()))
    methods = json.loads((evaluated / 'a.json').read_text())['methods']
    assert len(rows) == 6
    for method, row in zip(['gp_ground_seg'] * 3 + ['patchworkpp'] * 3, rows, strict=True):
        (frame,) = (
            f
            for f in methods[method]['frames']
            if (f['sequence'], f['index']) == (row['sequence'], row['frame'])
        )
        assert row['method'] == method
        assert int(row['points']) == len(street()[0])
        for key in ('groundgrid', 'patchwork'):
            assert [int(row[f'{key}_{n}']) for n in ('tp', 'fp', 'fn', 'tn')] == [
                frame[key][n] for n in ('tp', 'fp', 'fn', 'tn')
            ]
            assert float(row[f'{key}_iou']) == pytest.approx(frame[key]['iou'], rel=1e-5)
        assert float(row['ms']) == pytest.approx(frame['ms'], abs=1e-3)
        assert row['main_error_class'] in ('road', 'building')
        # What only ours tells is empty for the peer.
        assert row['status'] == frame.get('status', '')
    assert rows[0]['status'] in ('converged', 'budget')


def test_csv_of_an_undefined_score(tmp_path):
    frame = FrameScore('00', '7', 0.5, {}, {'groundgrid': Confusion(), 'patchwork': Confusion()})
    (score,) = evaluate([], [HeightRule('rule', -1.5)])
    write_frames_csv([type(score)('rule', (frame,))], tmp_path / 'a.csv')
    (row,) = csv.DictReader((tmp_path / 'a.csv').read_text().splitlines())
    assert row['groundgrid_iou'] == row['main_error_class'] == ''
    assert row['points'] == '0' and float(row['ms']) == 500.0


def make_score(tp, fp):
    return FrameScore('00', '0', 0.1, {}, {'groundgrid': Confusion(tp=tp, fp=fp)})


@given(st.lists(st.integers(0, 20), max_size=12), st.integers(1, 5))
def test_worst_frames_against_sorting(counts, n):
    worst = WorstFrames('ours', n)
    frame = Frame('00', '0', None, None, 0.0)
    for k, tp in enumerate(counts):
        worst.see('ours', frame, make_score(tp, 20 - tp), np.array([k], np.uint8))
        worst.see('peer', frame, make_score(0, 20), np.array([99], np.uint8))
    worst.see('ours', frame, make_score(0, 0), np.array([99], np.uint8))  # no IoU
    expected = sorted(range(len(counts)), key=lambda k: counts[k])[:n]
    assert [one.label[0] for one in worst.found()] == expected


def test_evaluate_shows_each_frame_with_its_labels(tmp_path):
    write_streets(tmp_path, s00=2)
    seen = []
    rule = HeightRule('rule', -1.72)
    (score,) = evaluate(labelled_frames(tmp_path), [rule], observe=lambda *all: seen.append(all))
    assert [(name, frame.index) for name, frame, *_ in seen] == [
        ('rule', '000000'),
        ('rule', '000001'),
    ]
    for (_, frame, shown, label), kept in zip(seen, score.frames, strict=True):
        assert shown == kept
        low = read_points(frame.points_path)[:, 2] < -1.72
        np.testing.assert_array_equal(label == Label.GROUND, low)


def test_sheet_of_the_command(evaluated, tmp_path, monkeypatch):
    image = imread(evaluated / 'a.png')
    one = sum(birds_eye.SHEET[:3])  # square, left, right
    assert image.shape[1] == round(2 * one * DPI)
    drawn = []

    def draw(panels, path, title):
        drawn.append((panels, title))
        path.write_text('drawn')

    monkeypatch.setattr('gp_ground_seg.cli.worst_sheet.plot_error_sheet', draw)
    run(evaluated / 'kitti', '--sheet', tmp_path / 'a.png', '--worst', 60)
    ((panels, title),) = drawn
    methods = json.loads((evaluated / 'a.json').read_text())['methods']
    ious = sorted(f['groundgrid']['iou'] for f in methods['gp_ground_seg']['frames'])
    assert [float(p.title.split()[-2]) for p in panels] == [round(100 * iou, 2) for iou in ious]
    assert title.startswith('Worst 3 of 3 frames')
    for panel in panels:
        assert panel.truth.tolist() == GROUNDGRID.truth(street()[1], panel.points[:, 2]).tolist()
        n_false = np.count_nonzero(panel.layers()[-1].chosen)
        assert panel.subtitle.startswith(f'{n_false} false, ')
        assert 'building' in panel.subtitle


@pytest.mark.parametrize('option', ['--frames-csv', '--sheet'])
def test_files_are_not_overwritten_without_force(evaluated, tmp_path, option):
    target = tmp_path / 'mine'
    target.write_text('mine')
    with pytest.raises(DataError, match='--force'):
        run(evaluated / 'kitti', option, target)
    assert target.read_text() == 'mine'


def test_worst_without_a_sheet(evaluated):
    with pytest.raises(DataError, match='--worst: is for --sheet only'):
        run(evaluated / 'kitti', '--worst', 2)
