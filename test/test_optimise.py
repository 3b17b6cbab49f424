"""Search of parameters: what is left out stays out, journals go on, what is won is said."""

import json
import re
import sys
from functools import partial

import optuna
import pytest
from cli_runner import error_line, run
from evaluation_samples import write_streets
from matplotlib.image import imread

from gp_ground_seg import Config
from gp_ground_seg.core.errors import ConfigError, DataError
from gp_ground_seg.core.parameters.config import find_spec
from gp_ground_seg.core.parameters.export import file_problems, is_logarithmic
from gp_ground_seg.data.semantic_kitti import labelled_frames
from gp_ground_seg.lab.experiments import optimise
from gp_ground_seg.lab.scale.cluster import HERE
from gp_ground_seg.lab.scoring.evaluate import OurMethod, load_kitti, score_methods

TOLERANCE = 'label.ground_tolerance'
BAD = Config().replace(**{'label.rule': 'tolerance', TOLERANCE: 0.001})
SETTINGS = ['--set', 'label.rule=tolerance', '--set', f'{TOLERANCE}=0.001']


@pytest.fixture(scope='module')
def root(tmp_path_factory):
    return write_streets(tmp_path_factory.mktemp('kitti'), s00=1, s01=1, s02=1, s03=1)


@pytest.fixture(scope='module')
def frames(root):
    return labelled_frames(root)


def test_what_is_left_out_are_whole_sequences_or_the_second_half_of_one(frames, tmp_path):
    def names(parts):
        return [[f'{frame.sequence}/{int(frame.index)}' for frame in part] for part in parts]

    split = optimise.split_frames
    assert names(split(frames)) == [['00/0', '02/0'], ['01/0', '03/0']]
    assert names(split(frames, ['00'])) == [['01/0', '02/0', '03/0'], ['00/0']]
    single = labelled_frames(write_streets(tmp_path, s05=5))
    assert names(split(single)) == [['05/0', '05/1'], ['05/2', '05/3', '05/4']]
    for wrong in ((single[:1], None), (frames, ['99']), (single, ['05'])):
        with pytest.raises(DataError, match='no frames to search on or to leave out'):
            split(*wrong)


def test_parameters_searched_are_in_the_ranges_declared(frames):
    assert optimise.DEFAULT_NAMES == [
        'grid.n_segments', 'grid.r_max', 'growth.seed_height_tolerance', TOLERANCE,
    ]  # fmt: skip
    scales = {'grid.n_segments': True, 'grid.bin_growth': False, 'sensor.origin_z': False,
              'grid.r_min': False, TOLERANCE: True, 'surface.look_aside': False}  # fmt: skip
    assert {name: is_logarithmic(find_spec(name)) for name in scales} == scales
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(0))
    drawn = [optimise._suggest(study.ask(), find_spec('grid.n_segments')) for _ in range(100)]
    # On a linear scale half of them would be above 1026.
    assert 60 < sorted(drawn)[50] < 140 and min(drawn) >= 4 and max(drawn) <= 2048
    for name, base in (('sensor.height', Config()), ('frame.base', Config())):
        with pytest.raises(ConfigError, match=f'{name} = '):
            optimise.searched_specs([name], base)
    names = ['grid.n_segments', 'surface.look_aside', 'label.rule', 'label.obstacle_min_height']
    trials = search(names, frames[:1], 6, base=Config())
    for trial in trials:
        assert list(trial.choice) == names
        Config().replace(**{name: trial.choice[name] for name in names[:3]})
    assert len({trial.choice['label.rule'] for trial in trials}) == 2


def search(names, frames, n, journal=None, seed=0, base=BAD):
    specs = optimise.searched_specs(names, base)
    return optimise.search(base, specs, frames, HERE, n, seed, journal)


def test_values_that_do_not_go_along_cost_a_trial_and_no_frame(frames):
    # obstacle_min_height must be below obstacle_max_height, 1 m, and goes up to 10 m.
    trials = search(['label.obstacle_min_height'], frames[:1], 12)
    assert len(trials) == 12
    for trial in trials:
        assert (trial.iou != trial.iou) == (trial.choice['label.obstacle_min_height'] >= 1.0)
    assert any(trial.iou != trial.iou for trial in trials)


def test_the_first_trial_is_what_is_given_and_its_iou_that_of_evaluate(frames):
    trials = search([TOLERANCE], frames, 3)
    assert trials[0].choice == {TOLERANCE: 0.001}
    (given,) = score_methods(frames, load_kitti, [OurMethod(BAD)], each_alone=True)
    assert trials[0].iou == given.iou
    assert search([TOLERANCE], frames, 3) == trials
    assert search([TOLERANCE], frames, 3, seed=1)[1:] != trials[1:]


def test_a_journal_goes_on_after_an_interrupt_and_is_of_one_search(frames, tmp_path, monkeypatch):
    path, real, calls = tmp_path / 'a.log', optimise.count_frames, []

    def interrupted(*words):
        calls.append(words)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return real(*words)

    monkeypatch.setattr(optimise, 'count_frames', interrupted)
    with pytest.raises(KeyboardInterrupt):
        search([TOLERANCE], frames, 5, path)
    trials = search([TOLERANCE], frames, 5, path)
    assert len(trials) == 5 and len(calls) == 3 + 3
    assert trials[0].choice == {TOLERANCE: 0.001}
    assert len({trial.choice[TOLERANCE] for trial in trials}) == 5
    assert search([TOLERANCE], frames, 5, path) == trials and len(calls) == 6
    before = path.read_bytes()
    for other in (
        partial(search, ['label.obstacle_min_height'], frames),
        partial(search, [TOLERANCE], frames[:2]),
        partial(search, [TOLERANCE], frames, base=Config()),
        partial(search, [TOLERANCE], frames, seed=1),
    ):
        with pytest.raises(DataError, match='of other parameters, frames or seed'):
            other(n=5, journal=path)
    assert path.read_bytes().startswith(before)
    assert search([TOLERANCE], frames, 5, path) == trials and len(calls) == 6


@pytest.mark.parametrize(
    'text', ['a note\n', 'two\nlines\n', '{"x": 1}\n', '{"op_code":0', '\xff']
)
def test_what_is_no_journal_is_left_as_it_is(frames, tmp_path, text):
    path = tmp_path / 'a.log'
    path.write_text(text, encoding='latin-1')
    with pytest.raises(DataError, match=r'a\.log: cannot be read as a journal'):
        search([TOLERANCE], frames, 1, path)
    assert path.read_text(encoding='latin-1') == text
    with pytest.raises(DataError, match='cannot be read as a journal'):
        search([TOLERANCE], frames, 1, tmp_path / 'no' / 'folder.log')


def optimised(root, tmp_path, *words):
    """Exit well, and return the document of --json."""
    assert run('optimise', root, '--json', tmp_path / 'a.json', '--force', *words) == 0
    return json.loads((tmp_path / 'a.json').read_text())


def test_what_is_won_is_said_by_frames_that_the_search_has_not_seen(
    root, tmp_path, capsys, monkeypatch
):
    real, seen = optimise.count_frames, set()

    def note(config, frames, progress):
        seen.update(frame.sequence for frame in frames)
        return real(config, frames, progress)

    monkeypatch.setattr(optimise, 'count_frames', note)
    files = ['-o', tmp_path / 'best.yaml', '--picture', tmp_path / 'trials.png']
    words = ['--parameters', TOLERANCE, '--trials', '8', *SETTINGS]
    document = optimised(root, tmp_path, *words, *files)
    assert seen == {'00', '02'}
    assert {row['sequence'] for row in document['rows']} == {'01', '03'}
    said = capsys.readouterr().out
    assert re.search(r'^Won: .*\b2 left out, of 01, 03$', said.replace('\n  ', ' '), re.MULTILINE)
    iou = document['measures'][0]
    assert iou['measure'] == 'iou' and 0.0 < iou['low'] <= iou['difference']
    best = max(trial['iou'] for trial in document['trials'])
    assert len(document['trials']) == 8 and best > document['trials'][0]['iou']
    assert file_problems(tmp_path / 'best.yaml') == []
    text = (tmp_path / 'best.yaml').read_text()
    assert text.startswith('# Won: ')
    chosen = next(t['choice'] for t in document['trials'] if t['iou'] == best)
    expected = Config().replace(**{'label.rule': 'tolerance'}, **chosen)
    assert Config.from_yaml(tmp_path / 'best.yaml') == expected
    assert len(text.splitlines()) == 6  # Nothing but what differs.
    assert imread(tmp_path / 'trials.png').std() > 0.1
    assert run('optimise', root, *words, *files) == 2
    assert 'exists already' in capsys.readouterr().err


def test_nothing_to_win_is_said(root, tmp_path, capsys):
    optimised(root, tmp_path, '--parameters', 'learning.period', '--trials', '2')
    assert capsys.readouterr().out.count('Nothing to win: the interval') == 1
    single = write_streets(tmp_path, s05=4)
    optimised(single, tmp_path, '--parameters', TOLERANCE, '--trials', '1')
    assert 'No verdict: too few frames' in capsys.readouterr().out


def test_a_worse_choice_is_said_to_be_lost(root, tmp_path, capsys, monkeypatch):
    """The search is told the opposite of what it should seek."""
    real = optimise.count_frames

    def opposite(*words):
        found = real(*words)
        return type(found)(tp=found.errors, fn=found.tp)

    monkeypatch.setattr(optimise, 'count_frames', opposite)
    optimised(root, tmp_path, '--parameters', TOLERANCE, '--trials', '8')
    assert 'Lost: the best is worse on frames left out' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('words', 'message'),
    [
        (['--parameters', 'sensor.height'], 'sensor.height = auto: is no number or choice'),
        (['--parameters', 'label.tolerance'], 'did you mean label.ground_tolerance?'),
        (['--left-out', '99'], 'no frames to search on or to leave out'),
        (['--journal', '/no/such/a.log'], '/no/such/a.log: cannot be read as a journal'),
    ],
)
def test_bad_input_is_one_line(root, capsys, words, message):
    assert run('optimise', root, *words) == 2
    assert message in error_line(capsys)


def test_optuna_is_optional(root, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, 'optuna', None)
    assert run('optimise', root) == 2
    assert 'pip install optuna' in error_line(capsys)
