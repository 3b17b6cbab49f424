"""Parameter files: those made from the declarations, presets, checks and comparison."""

import re

import pytest
import yaml
from cli_runner import run
from config_samples import configs
from conftest import REPOSITORY, load_script
from hypothesis import given, settings

from gp_ground_seg import Config
from gp_ground_seg.core.parameters.config import PRESETS, parameter_specs

generate = load_script('docs/generate.py')


@settings(max_examples=15)
@given(configs())
def test_yaml_reads_back_in_the_types_that_ros_wants(tmp_path_factory, config):
    """ROS parameters are typed: 2 is not a double, and 1e-05 without a point is no number."""
    path = tmp_path_factory.mktemp('yaml') / 'a.yaml'
    path.write_text(config.to_yaml(), encoding='utf-8')
    assert Config.from_yaml(path) == config
    document = yaml.safe_load(path.read_text())
    nested = yaml.safe_load(yaml.safe_dump(config.nested()))  # a box is a list there
    assert document == {'/**': {'ros__parameters': nested}}
    for spec in parameter_specs():
        group, name = spec.name.split('.')
        value = document['/**']['ros__parameters'][group][name]
        if spec.type is tuple:
            assert value == 'none' or [type(bound) for bound in value] == 6 * [float]
        else:
            assert type(value) is spec.type or (spec.auto and value == 'auto')


def test_generated_files_are_up_to_date():
    files = generate.generated_files((REPOSITORY / 'README.md').read_text(encoding='utf-8'))
    assert set(files) == {
        'README.md', 'docs/parameters.md', *(f'config/{name}.yaml' for name in PRESETS)
    }  # fmt: skip
    for name, text in files.items():
        assert (REPOSITORY / name).read_text(encoding='utf-8') == text, 'run: make generate'
    assert {f'config/{path.name}' for path in (REPOSITORY / 'config').glob('*.yaml')} <= set(files)


def test_the_paper_preset_has_none_of_our_departures():
    """What docs/algorithm.md says switches a departure back is switched back."""
    assert list(PRESETS) == ['default', 'paper'] and PRESETS['default'].config == Config()
    text = (REPOSITORY / 'docs' / 'algorithm.md').read_text(encoding='utf-8')
    cells = [line.split('|')[2] for line in text.splitlines() if line.startswith('| **')]
    settings = ' '.join(re.findall(r'`([^`]+)`', ' '.join(cells))).split()
    # The paper learns L-bar; keeping the first guess is no switch back.
    switches = [s.split('=') for s in settings if not s.startswith('learning.fixed')]
    assert len(switches) >= 7
    paper = PRESETS['paper'].config
    for name, value in switches:
        assert str(Config()[name]).lower() not in (value, f'{value}.0'), f'{name} by default'
        assert str(paper[name]).lower() in (value, f'{value}.0'), f'{name} of the preset paper'


def test_check_says_everything_that_is_wrong_at_once(tmp_path, capsys):
    path = tmp_path / 'my.yaml'
    path.write_text(
        '/**:\n  ros__parameters:\n    use_sim_time: true\n'
        '    lable: {ground_tolerance: 0.2}\n'
        '    label: {ground_tolerance: 9.0}\n'
        '    sensor: {height: 2}\n'
        '    grid: {n_segments: many}\n'
    )
    assert run('config', 'check', path) == 2
    lines = capsys.readouterr().err.splitlines()
    said = [
        'did you mean label.ground_tolerance?',
        'label.ground_tolerance = 9.0: must be a number in [0.001, 5] m',
        "grid.n_segments = 'many'",
    ]
    for line, part in zip(lines, said, strict=True):
        assert line.startswith(f'{path}: ') and part in line
    path.write_text('grid: {r_min: 20.0, r_max: 10.0}')
    (found,) = Config.problems_of_file(path)
    assert 'grid.r_min = 20: must be below grid.r_max = 10' in found


FOR_COMMANDS = 'good for --config, but not in the form of ROS that the node needs; from bare gr'


@pytest.mark.parametrize(
    ('text', 'use', 'n_given', 'n_changed'),
    [
        ('label: {ground_tolerance: 0.15}\nsensor: {height: 2}', FOR_COMMANDS, 2, 2),
        ('/**: {ros__parameters: {grid: {n_bins: 90}}}', 'good; ', 1, 1),
        ('/other: {ros__parameters: {}}', 'good for a node named /other only; ', 0, 0),
        ('# nothing', FOR_COMMANDS, 0, 0),
    ],
)
def test_check_says_who_reads_a_file_and_how_much_it_gives(
    text, use, n_given, n_changed, tmp_path, capsys
):
    path = tmp_path / 'robot.yaml'
    path.write_text(text)
    assert run('config', 'check', path) == 0
    out, err = capsys.readouterr()
    assert out.startswith(f'{path}: {use}')
    given = f'; {n_given} of {len(parameter_specs())} parameters given'
    assert out.endswith(f'{given}, {n_changed} unlike the default\n') and err == ''


def test_file_goes_over_preset_and_setting_over_file(tmp_path, capsys):
    path = tmp_path / 'my.yaml'
    path.write_text('grid: {n_bins: 77, n_segments: 66}\n')
    words = '--preset', 'paper', '--config', path, '--set', 'grid.n_segments=55'
    assert run('config', 'dump', *words) == 0
    text = capsys.readouterr().out
    path.write_text(text)
    expected = PRESETS['paper'].config.replace(**{'grid.n_bins': 77, 'grid.n_segments': 55})
    assert Config.from_yaml(path) == expected
    # The reasons of the preset are given for its own values only.
    assert 'Here: one zeta_g for all' in text
    assert 'Here: N in section IV' not in text and 'Preset paper' not in text
