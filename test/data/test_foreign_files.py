"""One unneeded part does not stop the reading: every file of the table, and what is read of it."""

import re

import numpy as np
import pytest
from foreign_files import CASES, XYZ

from gp_ground_seg.core.errors import DataError
from gp_ground_seg.data.bags import BagReader
from gp_ground_seg.data.cloud_files import decode_file
from gp_ground_seg.data.clouds import note
from gp_ground_seg.data.inputs import list_inputs


def what_is_read(path):
    """Names of the fields, topic and number of clouds, or the line of the error."""
    try:
        if path.suffix in ('.pcd', '.ply'):
            cloud = decode_file(path, path.read_bytes())
            n_points = {'one_point': 1, 'no_point': 0}.get(path.stem, len(XYZ))
            np.testing.assert_array_equal(cloud.xyz, XYZ[:n_points])
            return ' '.join(cloud.fields.dtype.names)
        inputs = list_inputs(path)
        for one in inputs:
            np.testing.assert_array_equal(one.read().xyz, XYZ)
        with BagReader(path) as bag:
            return f'{inputs.topic} {sum(1 for _ in bag.messages([inputs.topic]))}'
    except DataError as error:
        return str(error)


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('name', CASES)
def test_what_is_needed_is_read_of_every_file(tmp_path, name):
    content, expected = CASES[name]
    path = tmp_path / name
    if callable(content):
        content(path)
    else:
        path.write_bytes(content)
    found = what_is_read(path)
    if found != expected:
        assert str(path) in found and '\n' not in found
        assert re.search(expected, found)


def test_what_is_left_out_is_told_once(tmp_path, caplog):
    caplog.set_level('INFO', 'gp_ground_seg')
    note.cache_clear()
    for name in ('list_last.ply', 'list_last_text.ply', 'list_last_big.ply', 'nan_as_integer.pcd'):
        decode_file(tmp_path / name, CASES[name][0])
    assert caplog.messages == [
        'PLY: lists of the vertices are left out: views, w',
        'field ring: has numbers that are no uint16; read as float64',
    ]
