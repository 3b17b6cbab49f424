"""The command `experiment`: tables, files, options, and the commands of the docs."""

import csv
import json
import re
import shlex

import pytest
from cli_runner import error_line, run
from conftest import REPOSITORY
from evaluation_samples import write_streets
from test_cli_evaluate import rows_of

from gp_ground_seg import Config
from gp_ground_seg.cli import experiment as command
from gp_ground_seg.cli.experiment import EXPERIMENTS, parse_departure, split_settings
from gp_ground_seg.cli.main import build_parser
from gp_ground_seg.cli.options import config_from_options
from gp_ground_seg.errors import ConfigError, DataError
from gp_ground_seg.evaluation import evaluate as runner
from gp_ground_seg.experiments import ablation, simulated_scenes
from gp_ground_seg.experiments.simulated_scenes import PRESET_OF
from gp_ground_seg.parameters.presets import PRESETS

SMALL = ['--set', 'grid.n_bins=40']


@pytest.fixture(scope='module')
def root(tmp_path_factory):
    return write_streets(tmp_path_factory.mktemp('kitti'), s00=3, s08=1)


@pytest.fixture(autouse=True)
def few_places(monkeypatch):
    monkeypatch.setattr(simulated_scenes, 'PLACES', (0.0,))
    monkeypatch.setattr(ablation, 'PLACES', (12.0,))


CASES = {
    'ablation': (['ROOT', '--frame-step', '2', *SMALL], 'models', 7 * 3),
    'ablation --simulated': (['--seeds', '1', *SMALL], 'models', 7),
    'departures': (
        ['ROOT', '--only-given', '--switch', 'small: grid.n_bins=79', '--switch',
         'near: grid.r_max=15', *SMALL],
        'departures', 3 * 4,
    ),
    'scenes': (
        ['--sensors', 'vlp-16,os1-128', '--scenes', 'flat,slope', '--seeds', '1'],
        'scenes', 2 * 4,
    ),
    'scenes --no-peer': (['--sensors', 'vlp-16', '--scenes', 'kerb', '--seeds', '1'], 'scenes', 1),
    'cross-validation': (['ROOT', '--set', 'grid.r_max=5,20.0,60', *SMALL], 'scores', 3 * 4),
    'sensor-pose': (
        ['ROOT', '--sequences', '08', '--set', 'learning.mode=fixed'], 'turns', 27,
    ),
    'table1': (
        ['ROOT', '--frames', '00/000000:3,4', '00/000001:5', '--repeats', '1'], 'errors', 3,
    ),
}  # fmt: skip


@pytest.mark.parametrize('case', CASES)
def test_files_and_terminal_say_the_same(case, root, tmp_path, capsys):
    words, name, n_rows = CASES[case]
    words = ['experiment', *case.split(), *(root if word == 'ROOT' else word for word in words)]
    files = [tmp_path / f'a.{ending}' for ending in ('json', 'csv', 'md')]
    outputs = zip(('--json', '--csv', '--markdown'), files, strict=True)
    assert run(*words, *(word for pair in outputs for word in pair)) == 0
    said = capsys.readouterr().out
    document = json.loads(files[0].read_text())
    markdown = files[2].read_text()
    typed = [str(word).replace(str(root), 'KITTI_ROOT') for word in words]
    assert sorted(shlex.split(document['command'])[1:]) == sorted(typed)
    assert markdown.startswith(f'`{document["command"]}`\n')
    # Every cell of Markdown is on the terminal, row by row.
    lines = said.splitlines()
    rows = re.findall(r'^\| (?!---)(.*) \|$', markdown, re.MULTILINE)
    for row in rows:
        cells = [cell.strip() for cell in row.split(' | ')]
        assert any(re.split(r'  +', line.strip()) == cells for line in lines), row
    tables = {key: found for key, found in document.items() if isinstance(found, list)}
    full = tables.pop('by_segment' if 'table1' in case else 'by_scan')
    assert len(full) == len(list(csv.DictReader(files[1].read_text().splitlines()))) == n_rows
    assert len(rows) == sum(len(found) + 1 for found in tables.values())
    assert tables[name]
    width = max(len(line) for line in lines if not line.startswith('written'))
    assert width <= (110 if case == 'ablation --simulated' else 100)
    assert document['n_threads'] >= 1 and document['environment']['cpu']
    if case != 'scenes' and 'grid.n_bins=40' in words:
        assert document['config_changes']['grid.n_bins'] == 40


def test_choices_and_scores_of_cross_validation(root, tmp_path, capsys):
    target = tmp_path / 'a.json'
    words = ['--set', 'grid.r_max=5,20.0,60', *SMALL, '--json', target]
    assert run('experiment', 'cross-validation', root, *words) == 0
    document = json.loads(target.read_text())
    (choice,) = document['choices']
    assert (choice['parameter'], choice['given']) == ('grid.r_max', '90')
    pooled = document['scores'][-1]
    assert pooled['iou tuned'] >= pooled['iou given']
    assert document['n_configurations'] == 4
    rows = rows_of(capsys.readouterr().out, 'sequence')
    assert rows['all'][0] == f'{100 * pooled["iou given"]:.2f}'


def test_scenes_have_the_presets_of_their_sensors(monkeypatch):
    found = {}

    def note(configs, *_):
        found.update(configs)
        raise DataError('enough')

    monkeypatch.setattr(command, 'score_scenes', note)
    words = ['--sensors', ','.join(PRESET_OF)]
    for extra, expected in (
        ([], {sensor: PRESETS[preset].config for sensor, preset in PRESET_OF.items()}),
        (['--preset', 'default'], dict.fromkeys(PRESET_OF, Config())),
    ):
        assert run('experiment', 'scenes', *words, *extra) == 2
        assert found == expected


def test_simulated_poses_have_their_own_options(monkeypatch, capsys):
    found = []

    def note(n_seeds, config, scenes, progress):
        found.append((n_seeds, config.grid.n_bins, scenes))
        raise DataError('enough')

    monkeypatch.setattr(command, 'score_simulated_poses', note)
    words = ['--simulated', '--seeds', 2, '--scenes', 'flat,kerb', *SMALL]
    assert run('experiment', 'sensor-pose', *words) == 2
    assert error_line(capsys) == 'enough'
    assert found == [(2, 40, ['flat', 'kerb'])]


def test_a_departure_in_words():
    found = parse_departure('gate: at all: growth.max_std=1 learning.mode=fixed')
    assert found.title == 'gate: at all'
    assert found.changes == {'growth.max_std': 1, 'learning.mode': 'fixed'}
    for text in ('growth.max_std=1', 'title: ', ': growth.max_std=1', 'title: x'):
        with pytest.raises(ConfigError):
            parse_departure(text)


@pytest.mark.parametrize(
    ('words', 'message'),
    [
        (['ablation'], 'either ROOT or --simulated'),
        (['ablation', 'ROOT', '--simulated'], 'either ROOT or --simulated'),
        (['ablation', 'ROOT', '--seeds', '2'], '--seeds: is for --simulated only'),
        (['ablation', '--simulated', '--sequences', '00'], '--sequences: is for labelled frames'),
        (['ablation', '--simulated', '--frame-step', '2'], '--frame-step: is for labelled frames'),
        (['ablation', 'ROOT', '--sequences', '07'], 'no sequence 07; sequences here: 00, 08'),
        (['ablation', 'ROOT', '--set', 'learning.mode=fixed'], 'leave it out'),
        (['ablation', '--simulated', '--set', 'length_scale.constant=3'], 'leave it out'),
        (['departures', 'ROOT', '--only-given'], 'none given'),
        (['cross-validation', 'ROOT', '--set', 'grid.r_max=50,0.001'], 'grid.r_max'),
        (['cross-validation', 'ROOT', '--set', 'grid.rmax=50,60'], 'grid.rmax'),
        (['cross-validation', 'ROOT', '--set', 'grid.r_max=50'], 'nothing to choose'),
        (
            ['cross-validation', 'ROOT', '--set', 'grid.r_max=50,60', '--set', 'grid.r_max=5,6'],
            'searched twice',
        ),
        (['sensor-pose', 'ROOT', '--scenes', 'flat'], '--scenes: is for --simulated only'),
        (['sensor-pose', 'ROOT', '--set', 'sensor.height=1.0'], 'sensor.height = 1.0: the exp'),
        (['sensor-pose', 'ROOT', '--set', 'sensor.roll=1.0'], 'sensor.roll = 1.0: the exp'),
        (['scenes', '--preset', 'vlp-16'], 'vlp16'),
        *(([name, 'ROOT', '--json', 'MINE'], '--force') for name in EXPERIMENTS
          if name not in ('scenes', 'cross-validation')),
    ],
)  # fmt: skip
def test_errors_are_said_before_any_frame_is_read(
    root, words, message, capsys, monkeypatch, tmp_path
):
    monkeypatch.setattr(runner, 'read_points', None)
    target = tmp_path / 'mine'
    target.write_text('mine')
    named = {'ROOT': root, 'MINE': target}
    assert run('experiment', *(named.get(word, word) for word in words)) == 2
    assert message in error_line(capsys)
    assert target.read_text() == 'mine'


@pytest.mark.parametrize(
    ('words', 'message'),
    [
        (['ablation', '--seeds', '0'], 'at least 1'),
        (['ablation', '--frame-step', 'x'], 'at least 1'),
        (['scenes', '--sensors', 'vlp-32'], 'must be some of hdl-64e'),
        (['scenes', '--scenes', 'flat,flat'], 'each once'),
        (['table1'], 'ROOT'),
        ([], 'NAME'),
        (['moon'], 'moon'),
    ],
)
def test_usage_errors(words, message, capsys):
    with pytest.raises(SystemExit) as caught:
        run('experiment', *words)
    assert caught.value.code == 2
    assert message in capsys.readouterr().err


def test_commands_of_the_docs_are_accepted():
    """Those above the tables of the docs, and those in their text."""
    names = set()
    for page in ('experiments', 'accuracy', 'algorithm', 'pose'):
        text = (REPOSITORY / 'docs' / f'{page}.md').read_text(encoding='utf-8')
        for words in re.findall(r'`gp-ground-seg ((?:experiment|evaluate) [^`]*?)`', text):
            arguments = build_parser(words.split()[0]).parse_args(shlex.split(words))
            if 'experiment' not in vars(arguments):
                continue
            names.add(arguments.experiment)
            if arguments.experiment == 'cross-validation':
                grid, arguments.settings = split_settings(arguments.settings)
                for name, values in grid.items():
                    for value in values:
                        Config().replace(**{name: value})
            arguments.preset = arguments.preset or 'default'  # scenes: one for each sensor
            config_from_options(arguments)
    assert names == set(EXPERIMENTS)
