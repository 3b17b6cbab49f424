"""The command `pose`."""

import dataclasses
import json
import math
import re

import numpy as np
import pytest
from cli_runner import error_line, run

from gp_ground_seg.core.pipeline.tilt import rotation
from gp_ground_seg.lab.simulation import HDL_64E, SCENES, simulate_scan

SMALL = dataclasses.replace(HDL_64E, n_columns=500)


def write_scan(path, height, roll=0.0, pitch=0.0, turn=(0.0, 0.0)):
    mounted = dataclasses.replace(SMALL, height=height, roll=roll, pitch=pitch)
    points = simulate_scan(SCENES['flat'](1), mounted, np.random.default_rng(1)).points.copy()
    points[:, :3] = points[:, :3] @ rotation(*turn)
    path.write_bytes(points.astype('<f4').tobytes())


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


def test_json_has_every_number_unscaled_and_what_was_refused(tmp_path, capsys):
    write_scan(tmp_path / 'b.bin', 1.2, roll=math.radians(5.0), pitch=math.radians(-4.0))
    write_scan(tmp_path / 'c.bin', 1.2, turn=(-math.pi / 2, 0.0))
    words = ['pose', tmp_path, '--json', tmp_path / 'a.json']
    assert run(*words) == 0
    document = json.loads((tmp_path / 'a.json').read_text())
    (row,) = document['scans']
    assert (row['scan'], row['roll'], row['pitch']) == (
        'b.bin', pytest.approx(math.radians(5.0), abs=0.003),
        pytest.approx(math.radians(-4.0), abs=0.003),
    )  # fmt: skip
    assert 0.0 < row['support'] <= 1.0 and row['height'] == pytest.approx(1.2, abs=0.03)
    assert [note.partition(':')[0] for note in document['notes']] == ['median of 1', 'c.bin']
    capsys.readouterr()
    assert run(*words) == 2
    assert 'a.json: exists already; --force replaces it' in error_line(capsys)


def test_a_height_given_is_contradicted(tmp_path, capsys):
    write_scan(tmp_path / 'a.bin', 1.2)
    assert run('pose', tmp_path / 'a.bin', '--set', 'sensor.height=2.5') == 0
    said = capsys.readouterr().out
    assert 'height 2.5 (not measured)' in said
    assert 'a.bin: sensor.height = 2.5: the ground near the sensor is 1.2' in said


def test_a_scan_that_does_not_tell_and_one_that_is_not_there(tmp_path, capsys):
    assert run('pose', tmp_path / 'a.bin') == 2
    assert 'no such file' in error_line(capsys)
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


def test_a_scan_without_ground_is_named_on_stderr_and_never_a_silent_zero(tmp_path, capsys):
    flat_beam = dataclasses.replace(SMALL, elevations=(0.0,))
    points = simulate_scan(SCENES['urban'](1), flat_beam, np.random.default_rng(1)).points
    (tmp_path / 'a.bin').write_bytes(points.astype('<f4').tobytes())
    words = ['segment', tmp_path / 'a.bin', '--quiet', '-o', tmp_path / 'a.label']
    assert run(*words) == 0
    lines = capsys.readouterr().err.splitlines()
    assert [line for line in lines if 'does not show the ground' in line and '1.73 m' in line]
    assert [line for line in lines if 'next to nothing of the scan is ground' in line]
    assert run(*words, '--force', '--set', 'sensor.origin_z=up') == 2
    assert "sensor.origin_z = 'up': must be a number in [-50, 50] m" in error_line(capsys)
