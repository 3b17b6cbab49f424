"""Parameter files: those made from the declarations, presets, checks and comparison."""

import re

import pytest
import yaml
from cli_runner import run
from config_samples import configs
from conftest import REPOSITORY, load_script
from hypothesis import given, settings

from gp_ground_seg import Config, ConfigError
from gp_ground_seg.core.errors import DataError
from gp_ground_seg.core.parameters.config import PRESETS, find_preset, parameter_specs

GENERATE = 'run: make generate'
generate = load_script('docs/generate.py')


@settings(max_examples=15)
@given(configs())
def test_yaml_reads_back_in_the_types_that_ros_wants(tmp_path_factory, config):
    """ROS parameters are typed: 2 is not a double, and 1e-05 without a point is no number."""
    path = tmp_path_factory.mktemp('yaml') / 'a.yaml'
    path.write_text(config.to_yaml(), encoding='utf-8')
    assert Config.from_yaml(path) == config
    assert Config.problems_of_file(path) == []
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


def test_every_parameter_is_explained_above_it():
    lines = Config().to_yaml().splitlines()
    assert max(len(line) for line in lines) <= 99
    assert all(line == line.rstrip() for line in lines)
    specs = iter(parameter_specs())
    words = ''
    for line in (line for line in lines if line.startswith('      ')):
        if line[6] == '#':
            words += line.strip(' #') + ' '
            continue
        spec = next(specs)
        assert line.startswith(f'      {spec.name.split(".")[1]}: ')
        assert all(part in words for part in (spec.description, spec.unit, spec.symbol))
        if spec.type in (int, float):
            assert f'{spec.minimum:.10g} to {spec.maximum:.10g}' in words
        else:
            words_of = {bool: ['true or false'], tuple: ['none or six numbers, -100 to 100 m']}
            expected = words_of.get(spec.type, spec.choices or ['[a name]'])
            assert all(choice in words for choice in expected)
        words = ''
    assert next(specs, None) is None


def test_generated_files_are_up_to_date():
    files = generate.generated_files((REPOSITORY / 'README.md').read_text(encoding='utf-8'))
    assert set(files) == {
        'README.md', 'docs/parameters.md', *(f'config/{name}.yaml' for name in PRESETS)
    }  # fmt: skip
    for name, text in files.items():
        assert (REPOSITORY / name).read_text(encoding='utf-8') == text, GENERATE
    assert {f'config/{path.name}' for path in (REPOSITORY / 'config').glob('*.yaml')} <= set(files)


def test_the_table_has_a_row_for_each_parameter_that_people_set():
    table = generate.to_markdown_table()
    header, rule, *rows = table.splitlines()
    assert set(rule) <= set('| -')
    specs = [spec for spec in parameter_specs() if spec.basic]
    for row, spec in zip(rows, specs, strict=True):
        cells = row.replace(r'\|', '\0').split('|')
        assert len(cells) == len(header.split('|'))
        cells = [cell.strip().replace('\0', '|') for cell in cells[1:-1]]
        assert cells[0] == f'`{spec.name}`'
        assert yaml.safe_load(cells[1].strip('`')) == spec.default
        assert cells[2].endswith(spec.unit)
        assert cells[3] == spec.description + f' (`{spec.symbol}`)' * bool(spec.symbol)


def test_the_page_of_parameters_has_its_table_and_all_parameters():
    files = generate.generated_files(''.join(generate.marks_of(generate.SCORES)))
    source = [files['docs/parameters.md']]
    load_script('docs/conf.py').insert_code(None, 'parameters', source)
    table, _, listing = source[0].partition(generate.ALL_PARAMETERS)
    assert table.endswith(generate.to_markdown_table()) and listing == ''
    (path,) = re.findall('^```{literalinclude} (.*)$', source[0], re.MULTILINE)
    assert (REPOSITORY / 'docs' / path).samefile(REPOSITORY / 'config' / 'default.yaml')


@pytest.mark.parametrize('marks', ['', 'b', 'e', 'eb', 'bbe', 'bee'])
def test_the_readme_needs_its_markers(marks):
    begin, end = generate.marks_of('scores')
    readme = '\n'.join({'b': begin, 'e': end}[mark] for mark in marks)
    with pytest.raises(DataError, match=f'{begin} and {end} once each'):
        generate.with_table(readme, 'scores', '')


def test_the_presets_are_those_promised_and_another_is_refused():
    assert list(PRESETS) == ['default', 'paper']
    assert PRESETS['default'].config == Config()
    for wrong, message in (
        ('papr', "'papr'; did you mean paper? (there are default, paper)"),
        ('hdl64', "'hdl64' (there are default, paper)"),
    ):
        with pytest.raises(ConfigError, match=re.escape(message) + '$'):
            find_preset(wrong)


@pytest.mark.parametrize('preset', PRESETS.values(), ids=lambda preset: preset.name)
def test_a_dumped_preset_is_its_file_with_a_reason_for_every_override(preset, capsys):
    assert run('config', 'dump', '--preset', preset.name) == 0
    text = (REPOSITORY / 'config' / f'{preset.name}.yaml').read_text(encoding='utf-8')
    assert capsys.readouterr().out == text, GENERATE
    words = ' '.join(re.sub(r'^\s*#', '', line).strip() for line in text.splitlines())
    words = ' '.join(words.split())
    assert preset.purpose in words
    for name, (value, reason) in preset.overrides.items():
        assert preset.config[name] == value
        assert reason
        assert f'Here: {reason} (default ' in words


def test_the_paper_preset_has_none_of_our_departures():
    """What docs/algorithm.md says switches a departure back is switched back."""
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
    growth = paper.growth
    assert paper.label.rule == 'tolerance'
    assert paper.faces.max_normal_z == 0.0
    assert growth.max_standardised_depth == growth.max_standardised_residual


def test_check_says_everything_at_once(tmp_path, capsys):
    path = tmp_path / 'my.yaml'
    path.write_text(
        '/**:\n  ros__parameters:\n    use_sim_time: true\n'
        '    lable: {ground_tolerance: 0.2}\n'
        '    label: {ground_tolerance: 9.0}\n'
        '    sensor: {height: 2}\n'
        '    grid: {n_segments: many}\n'
    )
    good = tmp_path / 'good.yaml'
    good.write_text('label: {ground_tolerance: 0.15}\nsensor: {height: 2}\n')
    assert run('config', 'check', path, good) == 2
    out, err = capsys.readouterr()
    lines = err.splitlines()
    assert len(lines) == 3
    assert all(line.startswith(f'{path}: ') for line in lines)
    assert 'did you mean label.ground_tolerance?' in lines[0]
    assert 'label.ground_tolerance = 9.0: must be a number in [0.001, 5] m' in lines[1]
    assert "grid.n_segments = 'many'" in lines[2]
    n = len(parameter_specs())
    assert out.startswith(f'{good}: good for --config, but not for the node, which needs the form')
    assert out.endswith(f'; 2 of {n} parameters given, 2 differ from the defaults\n')
    good.write_text('sensor: {height: 2}\n')
    assert run('config', 'check', good) == 0
    assert capsys.readouterr().out.endswith(', 1 differs from the defaults\n')
    for text, problem in (
        ('grid: {r_min: 20.0, r_max: 10.0}', 'grid.r_min = 20: must be below grid.r_max = 10'),
        ('grid: [', 'not valid YAML'),
        ('a: 1\na: 2', 'given twice'),
    ):
        good.write_text(text)
        (found,) = Config.problems_of_file(good)
        assert problem in found
    (found,) = Config.problems_of_file(tmp_path / 'missing.yaml')
    assert 'No such file' in found


@pytest.mark.parametrize('words', [('check',), ('dump', '--config')])
def test_a_file_without_parameters_gets_a_note(tmp_path, capsys, words):
    path = tmp_path / 'my.yaml'
    path.write_text('# nothing\n')
    assert run('config', *words, path) == 0
    note = f'gp-ground-seg: note: {path}: no parameters of the segmentation in it\n'
    assert capsys.readouterr().err == note


def test_file_goes_over_preset_and_setting_over_file(tmp_path, capsys):
    path = tmp_path / 'my.yaml'
    path.write_text('grid: {n_bins: 77, n_segments: 66}\n')
    words = '--preset', 'paper', '--config', path, '--set', 'grid.n_segments=55'
    assert run('config', 'dump', *words) == 0
    text = capsys.readouterr().out
    path.write_text(text)
    expected = PRESETS['paper'].config.replace(**{'grid.n_bins': 77, 'grid.n_segments': 55})
    assert Config.from_yaml(path) == expected
    assert 'Here: one zeta_g for all' in text
    # That is why the preset has 120 bins; these are others.
    assert 'Here: N in section IV' not in text
    assert 'Preset paper' not in text
    assert run('segment', 'x.bin', '--preset', 'velodyne') == 2
    assert run('config', 'dump', '--set', 'sensor.hight=2.5') == 2
