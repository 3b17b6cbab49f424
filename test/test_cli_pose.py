"""The commands `pose` and `pose-check`."""

import dataclasses
import math
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from cli_runner import error_line, run

from gp_ground_seg import Config
from gp_ground_seg.cli.main import build_parser
from gp_ground_seg.data.semantic_kitti import list_frames, list_sequences
from gp_ground_seg.errors import ConfigError
from gp_ground_seg.experiments.pose_trials import (
    AXES_UP,
    FOUND,
    HEIGHTS,
    LEVEL,
    TILT,
    TOLD,
    TURNS,
    check_frames,
    check_simulated,
    pooled,
)
from gp_ground_seg.pipeline.tilt import rotation
from gp_ground_seg.simulation import HDL_64E, SCENES, VLP_16, simulate_scan, write_semantic_kitti

SMALL = dataclasses.replace(HDL_64E, n_columns=500)
FIXED = Config().replace(**{'learning.mode': 'fixed'})


def write_scan(path, height, roll=0.0, pitch=0.0, turn=(0.0, 0.0)):
    mounted = dataclasses.replace(SMALL, height=height, roll=roll, pitch=pitch)
    points = simulate_scan(SCENES['flat'](1), mounted, np.random.default_rng(1)).points.copy()
    points[:, :3] = points[:, :3] @ rotation(*turn)
    path.write_bytes(points.astype('<f4').tobytes())


@pytest.fixture(scope='module')
def streets(tmp_path_factory):
    """Two frames of a simulated street, from KITTI's height."""
    root = tmp_path_factory.mktemp('streets')
    scans = (
        simulate_scan(SCENES['kerb'](seed), SMALL, np.random.default_rng(seed), time=0.1 * seed)
        for seed in range(2)
    )
    write_semantic_kitti(scans, root, '00')
    return root


def frames_of(root):
    return [frame for name in list_sequences(root) for frame in list_frames(root, name)]


def test_height_and_tilt_of_scans_and_their_medians(tmp_path, capsys):
    write_scan(tmp_path / 'a.bin', 1.2)
    write_scan(tmp_path / 'b.bin', 1.2, roll=math.radians(5.0), pitch=math.radians(-4.0))
    write_scan(tmp_path / 'c.bin', 1.2, turn=(-math.pi / 2, 0.0))
    assert run('pose', tmp_path) == 0
    lines = capsys.readouterr().out.splitlines()
    level, tilted = (next(line for line in lines if line.startswith(n)) for n in ('a', 'b'))
    number = r'[+-]?\d+\.\d+'
    assert float(re.findall(number, level)[0]) == pytest.approx(1.2, abs=0.03)
    _, roll, pitch = (float(word) for word in re.findall(number, tilted)[:3])
    assert (roll, pitch) == pytest.approx((5.0, -4.0), abs=0.15)
    (refused,) = (line for line in lines if line.startswith('c.bin'))
    assert refused.startswith('c.bin: refused: z does not point up: ')
    assert 'sensor.roll to -1.57' in refused
    (summary,) = (line for line in lines if line.startswith('median of 2: sensor.height=1.2'))
    assert 'sensor.roll=' in summary


def test_a_height_given_is_contradicted(tmp_path, capsys):
    write_scan(tmp_path / 'a.bin', 1.2)
    assert run('pose', tmp_path / 'a.bin', '--set', 'sensor.height=2.5') == 0
    said = capsys.readouterr().out
    assert 'height 2.5 (not measured)' in said
    assert 'a.bin: sensor.height = 2.5: the ground near the sensor is 1.2' in said


def test_a_scan_that_does_not_tell(tmp_path, capsys):
    np.zeros((3, 4), dtype='<f4').tofile(tmp_path / 'a.bin')
    assert run('pose', tmp_path / 'a.bin') == 0
    assert 'set sensor.height' in capsys.readouterr().out


def test_segment_names_the_scan_that_it_refuses(tmp_path, capsys):
    write_scan(tmp_path / 'a.bin', 1.2, turn=(math.pi, 0.0))
    words = ['segment', tmp_path / 'a.bin', '-o', tmp_path / 'a.label', '--quiet']
    assert run(*words) == 2
    said = error_line(capsys)
    assert said.startswith(f'{tmp_path / "a.bin"}: z does not point up: ')
    assert not (tmp_path / 'a.label').exists()
    roll, pitch = (re.search(rf'sensor\.{n} to (\S+)', said)[1] for n in ('roll', 'pitch'))
    assert run(*words, '--set', f'sensor.roll={roll}', '--set', f'sensor.pitch={pitch}') == 0
    assert (tmp_path / 'a.label').exists()


def test_input_that_is_not_there(tmp_path, capsys):
    assert run('pose', tmp_path / 'none.bin') == 2
    assert 'no such file' in error_line(capsys)


def test_frames_turned(streets):
    trials, axes = check_frames(frames_of(streets), FIXED)
    assert len(trials) == 2 * len(TURNS)
    untouched = [trial for trial in trials if trial.turn == (0, 0)]
    assert {trial.height for trial in trials} == {1.73}
    # Level already, so told and taken to be level are the same to the last point.
    assert pooled(untouched, TOLD) == pooled(untouched, LEVEL)
    told = pooled(untouched, TOLD).iou
    assert told > 0.9
    for turn in TURNS:
        own = [trial for trial in trials if trial.turn == turn]
        assert pooled(own, TOLD).iou == pytest.approx(told, abs=1e-3)
        assert pooled(own, FOUND).iou > told - 0.01
        for trial in own:
            roll, pitch = (TILT * steps for steps in turn)
            measured = trial.found.measured
            assert (measured.roll, measured.pitch) == pytest.approx((roll, pitch), abs=0.01)
    assert {(a.up, a.n_scans, a.n_refused) for a in axes} == {
        ('z', 2, 0),
        *((up, 2, 2) for up in AXES_UP),
    }


def test_simulated_scans():
    sensor = dataclasses.replace(VLP_16, n_columns=600)
    trials, axes = check_simulated(1, FIXED, ['flat'], [sensor])
    assert {trial.height for trial in trials} == set(HEIGHTS)
    assert len(trials) == 2 * len(HEIGHTS)
    for trial in trials:
        assert trial.found.height == pytest.approx(trial.height, abs=0.06)
    tilted = [trial for trial in trials if trial.turn != (0, 0)]
    assert pooled(tilted, FOUND).iou > pooled(tilted, LEVEL).iou
    assert sum(a.n_scans for a in axes) == len(HEIGHTS) * (1 + len(AXES_UP))
    with pytest.raises(ConfigError, match='no scene'):
        check_simulated(1, FIXED, ['moon'])


@pytest.mark.parametrize('name', ['sensor.height', 'sensor.roll', 'sensor.pitch'])
def test_what_is_compared_cannot_be_set(streets, capsys, name):
    assert run('pose-check', streets, '--set', f'{name}=1.0') == 2
    assert error_line(capsys) == f'{name} = 1.0: is what is compared, leave it out'


def test_tables_on_the_terminal_and_in_markdown(streets, tmp_path, capsys):
    target = tmp_path / 'tables.md'
    words = ['pose-check', streets, '--set', 'learning.mode=fixed', '--markdown', target]
    assert run(*words) == 0
    text = capsys.readouterr().out
    assert max(len(line) for line in text.splitlines()) <= 100
    markdown = target.read_text(encoding='utf-8')
    first, *_ = markdown.splitlines()
    assert first == '`gp-ground-seg pose-check KITTI_ROOT --set learning.mode=fixed`'
    cells = re.findall(r'^\| (?!---)(.*) \|$', markdown, re.MULTILINE)
    for row in cells:
        line = [cell.strip() for cell in row.split(' | ') if cell.strip()]
        assert any(all(cell in shown for cell in line) for shown in text.splitlines())
    assert len(cells) == (1 + 1) + (1 + len(TURNS)) + (1 + 1 + len(AXES_UP))
    assert run(*words) == 2
    assert '--force' in error_line(capsys)


@pytest.mark.parametrize(
    ('words', 'reason'),
    [
        ([], 'either ROOT or --simulated'),
        (['ROOT', '--simulated'], 'either ROOT or --simulated'),
        (['ROOT', '--seeds', '2'], '--seeds: is for --simulated only'),
        (['ROOT', '--scenes', 'flat'], '--scenes: is for --simulated only'),
        (['--simulated', '--frame-step', '2'], '--frame-step: is for labelled frames only'),
        (['--simulated', '--scenes', 'moon'], "no scene 'moon'; there are flat, "),
    ],
)
def test_options_that_contradict_one_another(words, reason, capsys):
    assert run('pose-check', *words) == 2
    assert reason in error_line(capsys)


def test_commands_of_the_docs_are_accepted():
    text = (Path(__file__).parents[1] / 'docs' / 'pose.md').read_text(encoding='utf-8')
    commands = re.findall(r'`gp-ground-seg (.*?)`', text)
    assert {words.split()[0] for words in commands} == {'pose', 'pose-check'}
    for words in commands:
        build_parser(words.split()[0]).parse_args(shlex.split(words))
