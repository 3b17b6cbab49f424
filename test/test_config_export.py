"""Files made from the declarations equal the declarations."""

import argparse
import os
from pathlib import Path

import pytest
import yaml
from config_samples import configs
from hypothesis import given, settings

from gp_ground_seg import Config
from gp_ground_seg.cli import config as command
from gp_ground_seg.errors import DataError
from gp_ground_seg.parameters.config import parameter_specs
from gp_ground_seg.parameters.export import (
    README_BEGIN,
    README_END,
    file_problems,
    generated_files,
    to_markdown_table,
    to_yaml,
)
from gp_ground_seg.parameters.presets import PRESETS

REPOSITORY = Path(__file__).resolve().parents[1]
GENERATE = 'run: python -m gp_ground_seg config generate'


def run(*words):
    parser = argparse.ArgumentParser()
    command.add_parser(parser.add_subparsers(required=True))
    arguments = parser.parse_args(['config', *(str(word) for word in words)])
    return arguments.run(arguments)


@settings(max_examples=40)
@given(configs())
def test_yaml_reads_back_in_the_types_that_ros_wants(tmp_path_factory, config):
    """ROS parameters are typed: 2 is not a double, and 1e-05 without a point is no number."""
    path = tmp_path_factory.mktemp('yaml') / 'a.yaml'
    path.write_text(to_yaml(config), encoding='utf-8')
    assert Config.from_yaml(path) == config
    assert file_problems(path) == []
    document = yaml.safe_load(path.read_text())
    parameters = document['/**']['ros__parameters']
    assert document == {'/**': {'ros__parameters': config.nested()}}
    for spec in parameter_specs():
        group, name = spec.name.split('.')
        value = parameters[group][name]
        assert type(value) is spec.type or (spec.auto and value == 'auto')


def test_every_parameter_is_explained_above_it():
    lines = to_yaml(Config()).splitlines()
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
            expected = ['true or false'] if spec.type is bool else spec.choices or ['[a name]']
            assert all(choice in words for choice in expected)
        words = ''
    assert next(specs, None) is None


@pytest.mark.parametrize('name', PRESETS)
def test_a_dumped_preset_is_its_file(capsys, name):
    assert run('dump', '--preset', name) == 0
    shipped = (REPOSITORY / 'config' / f'{name}.yaml').read_text(encoding='utf-8')
    assert capsys.readouterr().out == shipped, GENERATE


def test_generated_files_are_up_to_date():
    files = generated_files((REPOSITORY / 'README.md').read_text(encoding='utf-8'))
    assert set(files) == {
        'README.md', 'docs/parameters.md', *(f'config/{name}.yaml' for name in PRESETS)
    }  # fmt: skip
    for name, text in files.items():
        assert (REPOSITORY / name).read_text(encoding='utf-8') == text, GENERATE
    assert {f'config/{path.name}' for path in (REPOSITORY / 'config').glob('*.yaml')} <= set(files)


def rows(table):
    return [line for line in table.splitlines() if line.startswith('| `')]


def test_readme_has_the_basic_parameters_and_the_page_has_all():
    files = generated_files(f'{README_BEGIN}{README_END}')
    basic = [f'| `{spec.name}` ' for spec in parameter_specs() if spec.basic]
    assert [row[: row.index('` ') + 2] for row in rows(files['README.md'])] == basic
    assert rows(files['docs/parameters.md']) == rows(to_markdown_table())


def test_table_has_a_row_for_each_parameter(capsys):
    assert run('table') == 0
    header, rule, *rows = capsys.readouterr().out.splitlines()
    assert set(rule) <= set('| -')
    assert len(rows) == len(parameter_specs())
    for row, spec in zip(rows, parameter_specs(), strict=True):
        cells = row.replace(r'\|', '\0').split('|')
        assert len(cells) == len(header.split('|'))
        cells = [cell.strip().replace('\0', '|') for cell in cells[1:-1]]
        assert cells[0] == f'`{spec.name}`'
        assert yaml.safe_load(cells[1].strip('`')) == spec.default
        assert cells[3:] == [
            spec.unit,
            f'`{spec.symbol}`' if spec.symbol else '',
            spec.description,
        ]


def test_generate_rewrites_what_is_generated_and_nothing_else(tmp_path, capsys):
    readme = tmp_path / 'README.md'
    head, tail = '# Title — ünïcode\r\n\r\ntext\n', '\n\nmore\n'
    readme.write_bytes(f'{head}{README_BEGIN}\nold\n{README_END}{tail}'.encode())
    n_files = 2 + len(PRESETS)
    assert run('generate', tmp_path) == 0
    assert capsys.readouterr().out.count('rewritten') == n_files
    text = readme.read_bytes().decode()
    table = to_markdown_table(basic_only=True)
    assert text == f'{head}{README_BEGIN}\n\n{table}\n{README_END}{tail}'
    for name, preset in PRESETS.items():
        assert Config.from_yaml(tmp_path / 'config' / f'{name}.yaml') == preset.config

    def times():
        return {path: os.stat(path).st_mtime_ns for path in tmp_path.rglob('*')}

    before = times()
    assert run('generate', tmp_path) == 0
    assert capsys.readouterr().out.count('unchanged') == n_files
    assert times() == before
    assert len([path for path in before if path.is_file()]) == n_files


@pytest.mark.parametrize(
    'readme',
    [
        '',
        README_BEGIN,
        README_END,
        f'{README_END}\n{README_BEGIN}',
        f'{README_BEGIN}\n{README_BEGIN}\n{README_END}',
        f'{README_BEGIN}\n{README_END}\n{README_END}',
        None,
    ],
)
def test_generate_needs_a_readme_with_its_markers(tmp_path, readme):
    path = tmp_path / 'README.md'
    if readme is not None:
        path.write_text(readme)
    message = 'root of a checkout' if readme is None else r'README\.md: must hold .* once each'
    with pytest.raises(DataError, match=message):
        run('generate', tmp_path)
    assert readme is None or path.read_text() == readme
    assert len(list(tmp_path.iterdir())) == (readme is not None)
