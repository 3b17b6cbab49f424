"""Presets, and the commands that check and compare parameter files."""

import dataclasses
import re
import subprocess
import sys
import tarfile
from collections import Counter
from contextlib import closing

import numpy as np
import pytest
from conftest import REPOSITORY

from gp_ground_seg import Config, ConfigError, GroundSegmenter, Label
from gp_ground_seg.cli import main as cli
from gp_ground_seg.parameters.config import parameter_specs
from gp_ground_seg.parameters.export import file_problems
from gp_ground_seg.parameters.presets import PRESETS, find_preset
from gp_ground_seg.simulation import SCENES, SENSORS, simulate_scan


def run_cli(*words):
    return cli.main([str(word) for word in words])


def test_the_presets_are_those_promised(capsys):
    assert run_cli('config', 'presets') == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(PRESETS)
    assert list(PRESETS) == ['default', 'paper', 'hdl64', 'hdl32', 'vlp16', 'os1_128', 'mid360']
    assert PRESETS['default'].config == Config()


@pytest.mark.parametrize('preset', PRESETS.values(), ids=lambda preset: preset.name)
def test_every_override_has_a_reason_in_the_file(preset):
    text = (REPOSITORY / 'config' / f'{preset.name}.yaml').read_text(encoding='utf-8')
    words = ' '.join(re.sub(r'^\s*#', '', line).strip() for line in text.splitlines())
    words = ' '.join(words.split())
    assert preset.purpose in words
    for name, (value, reason) in preset.overrides.items():
        assert preset.config[name] == value
        assert reason
        assert f'Here: {reason} (default ' in words


def test_unknown_preset_is_refused_with_the_nearest():
    with pytest.raises(ConfigError, match=r"'vlp-16'; did you mean vlp16\? \(there are default,"):
        find_preset('vlp-16')


def test_the_paper_preset_has_none_of_our_departures():
    """What docs/algorithm.md says switches a departure back is switched back."""
    text = (REPOSITORY / 'docs' / 'algorithm.md').read_text(encoding='utf-8')
    rows = [line for line in text.splitlines() if line.startswith('| **')]
    switches = [
        setting.split('=')
        for row in rows
        for cell in re.findall(r'`([^`]+)`', row.split('|')[2])
        for setting in cell.split()
    ]
    # The paper learns L-bar; keeping the first guess is no switch back.
    switches = [(name, value) for name, value in switches if name != 'learning.fixed']
    assert len(switches) >= 7
    paper = PRESETS['paper'].config
    for name, value in switches:
        assert str(paper[name]) in (value, f'{value}.0'), f'{name} of the preset paper'
    label = paper.label
    assert label.ground_tolerance == label.obstacle_tolerance == label.below_tolerance
    assert paper['faces.min_height'] > paper['label.obstacle_max_height']
    growth = paper.growth
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
    assert run_cli('config', 'check', path, good) == 2
    out, err = capsys.readouterr()
    lines = err.splitlines()
    assert len(lines) == 4
    assert all(line.startswith(f'{path}: ') for line in lines)
    assert 'did you mean label.ground_tolerance?' in lines[0]
    assert 'label.ground_tolerance = 9.0: must be a number in [0.001, 5] m' in lines[1]
    assert 'with a decimal point as in 2.0' in lines[2]
    assert "grid.n_segments = 'many'" in lines[3]
    n = len(parameter_specs())
    assert out == f'{good}: good; 2 of {n} parameters given, 2 differ from the defaults\n'


@pytest.mark.parametrize(
    ('text', 'problem'),
    [
        ('grid: {r_min: 20.0, r_max: 10.0}', 'grid.r_min = 20: must be below grid.r_max = 10'),
        ('grid: [', 'not valid YAML'),
        ('a: 1\na: 2', 'given twice'),
        (None, 'No such file'),
    ],
)
def test_check_of_what_is_wrong_as_a_whole(tmp_path, text, problem):
    path = tmp_path / 'my.yaml'
    if text is not None:
        path.write_text(text)
    (found,) = file_problems(path)
    assert problem in found


def test_diff_of_files_and_presets(tmp_path, capsys):
    path = tmp_path / 'my.yaml'
    path.write_text('learning: {mode: fixed}\nlabel: {ground_tolerance: 0.15}\n')
    assert run_cli('config', 'diff', 'default', path) == 1
    assert capsys.readouterr().out == (
        f'label.ground_tolerance: {Config().label.ground_tolerance} -> 0.15 m\n'
        f'learning.mode: {Config().learning.mode} -> fixed\n'
    )
    assert run_cli('config', 'diff', path, path) == 0
    assert run_cli('config', 'diff', 'default', REPOSITORY / 'config' / 'default.yaml') == 0
    assert capsys.readouterr().out == ''
    assert run_cli('config', 'diff', 'default', 'vlp17') == 2
    assert 'vlp17: No such file' in capsys.readouterr().err


def test_file_goes_over_preset_and_setting_over_file(tmp_path, capsys):
    path = tmp_path / 'my.yaml'
    path.write_text('grid: {n_bins: 77, n_segments: 66}\n')
    words = '--preset', 'paper', '--config', path, '--set', 'grid.n_segments=55'
    assert run_cli('config', 'dump', *words) == 0
    dumped = tmp_path / 'dumped.yaml'
    dumped.write_text(capsys.readouterr().out)
    expected = PRESETS['paper'].config.replace(**{'grid.n_bins': 77, 'grid.n_segments': 55})
    assert Config.from_yaml(dumped) == expected
    text = dumped.read_text()
    assert 'Here: one zeta_g for all' in text
    # That is why the preset has 120 bins; these are others.
    assert 'Here: N in section IV' not in text
    assert 'Preset paper' not in text
    assert run_cli('segment', 'x.bin', '--preset', 'velodyne') == 2
    assert run_cli('config', 'dump', '--set', 'sensor.hight=2.5') == 2


@pytest.mark.parametrize(
    ('name', 'sensor'),
    [('hdl64', 'hdl-64e'), ('hdl32', 'hdl-32e'), ('vlp16', 'vlp-16'), ('os1_128', 'os1-128'),
     ('mid360', 'mid-360')],
)  # fmt: skip
def test_presets_fit_their_sensors(name, sensor):
    """Ground IoU on two simulated scenes each, level and sloped."""
    config = PRESETS[name].config
    # A preset knows the sensor, not where it is mounted.
    assert set(dataclasses.astuple(config.sensor)) == {'auto'}
    with closing(GroundSegmenter(config)) as segmenter:
        for scene in ('flat', 'slope'):
            both = Counter()
            for seed in (0, 1):
                rng = np.random.default_rng(seed)
                scan = simulate_scan(SCENES[scene](seed), SENSORS[sensor], rng)
                found = segmenter.segment(scan.points).label == Label.GROUND
                both['common'] += int((found & scan.is_ground).sum())
                both['either'] += int((found | scan.is_ground).sum())
            assert 100.0 * both['common'] / both['either'] >= 95.0, scene


def test_presets_are_installed_where_ros_looks(tmp_path):
    """As ``$(ros2 pkg prefix --share gp_ground_seg)/config/vlp16.yaml`` finds them."""
    source, prefix = tmp_path / 'source', tmp_path / 'prefix'
    packed = tmp_path / 'source.tar'
    with tarfile.open(packed, 'w') as tar:
        for name in ('gp_ground_seg', 'config', 'resource', 'setup.py', 'setup.cfg',
                     'pyproject.toml', 'package.xml', 'README.md'):  # fmt: skip
            tar.add(REPOSITORY / name, name, filter=lambda i: None if '__pyc' in i.name else i)
    with tarfile.open(packed) as tar:
        tar.extractall(source)
    pip = [sys.executable, '-m', 'pip', 'install', '--quiet', '--no-deps', '--no-index']
    pip += ['--no-build-isolation', '--prefix', prefix, '--ignore-installed', source]
    done = subprocess.run(pip, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    share = prefix / 'share' / 'gp_ground_seg' / 'config'
    for preset in PRESETS.values():
        assert Config.from_yaml(share / f'{preset.name}.yaml') == preset.config
    index = prefix / 'share' / 'ament_index' / 'resource_index' / 'packages' / 'gp_ground_seg'
    assert index.is_file()
