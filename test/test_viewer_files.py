"""What is shipped to look at: RViz, Foxglove, the Nav2 snippet, the picture of a scan."""

import json
import re

import matplotlib.image
import numpy as np
import pytest
import yaml
from conftest import REPOSITORY, hilly_scan

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.cli import main as cli
from gp_ground_seg.errors import PointCloudError
from gp_ground_seg.plotting.scan_view import Camera, plot_scan_view

NODE = '/ground_segmentation_node'
TOPICS = {
    '/ground',
    '/obstacles',
    f'{NODE}/labeled',
    f'{NODE}/ground_model',
    f'{NODE}/markers',
}


def test_topics_are_those_of_the_node():
    outputs = pytest.importorskip('gp_ground_seg.ros.outputs', reason='ROS is not installed')
    names = [output.topic for output in (*outputs.CLOUD_OUTPUTS, *outputs.marker_outputs())]
    found = {name.replace('~', NODE) if name[0] == '~' else f'/{name}' for name in names}
    assert found == TOPICS


def test_rviz_shows_every_topic():
    text = (REPOSITORY / 'config' / 'ground_segmentation.rviz').read_text(encoding='utf-8')
    manager = yaml.safe_load(text)['Visualization Manager']
    shown = [display for display in manager['Displays'] if 'Topic' in display]
    assert {display['Topic']['Value'] for display in shown} == TOPICS
    for display in shown:
        assert display['Topic']['Reliability Policy'] == 'Reliable'
        is_markers = display['Topic']['Value'].endswith('markers')
        kind = 'MarkerArray' if is_markers else 'PointCloud2'
        assert display['Class'] == f'rviz_default_plugins/{kind}'
    # What costs the node something is off until it is wanted, but for the markers.
    off = {display['Topic']['Value'] for display in shown if not display['Enabled']}
    assert off == {f'{NODE}/labeled', f'{NODE}/ground_model'}


def test_foxglove_shows_every_topic():
    text = (REPOSITORY / 'config' / 'foxglove_layout.json').read_text(encoding='utf-8')
    layout = json.loads(text)
    assert set(layout['configById']['3D!ground']['topics']) == TOPICS
    panels = re.findall(r'"(\w+!\w+)"', json.dumps(layout['layout']))
    assert sorted(panels) == sorted(layout['configById'])


def test_nav2_snippet_is_yaml_and_fits_the_command_above_it():
    text = (REPOSITORY / 'docs' / 'nav2.md').read_text(encoding='utf-8')
    (snippet,) = re.findall(r'```yaml\n(.*?)```', text, re.DOTALL)
    costmap = yaml.safe_load(snippet)['local_costmap']['local_costmap']['ros__parameters']
    layer = costmap['obstacle_layer']
    for source in layer['observation_sources'].split():
        assert f'-r {source}:={layer[source]["topic"]}' in text
    marking = {name for name in ('obstacles', 'ground') if layer[name]['marking']}
    assert marking == {'obstacles'}


def test_camera_projects_as_a_camera_does():
    camera = Camera(position=(0.0, 0.0, 0.0), target=(1.0, 0.0, 0.0), zoom=0.5)
    place, depth = camera.project(
        np.array([[10.0, 0, 0], [10.0, -2, 0], [10.0, 0, 4], [20.0, 0, 4], [-5.0, 0, 0]])
    )
    np.testing.assert_allclose(place[:4], [[0, 0], [0.1, 0], [0, 0.2], [0, 0.1]], atol=1e-12)
    np.testing.assert_allclose(depth, [10, 10, 10, 20, -5])
    assert np.isnan(place[4]).all()


def test_picture_shows_ground_obstacles_and_model(tmp_path):
    points = hilly_scan(8000)
    points[:10] = np.nan
    config = Config()
    found = GroundSegmenter(config).segment(points)
    path = tmp_path / 'scan.png'
    plot_scan_view(points, found, config, path, 'title with $ and _')
    picture = matplotlib.image.imread(path)
    assert picture.shape[:2] == (768, 1440)
    colours = (picture[60:650, ..., :3] * 255).round().astype(int).reshape(-1, 3)
    for wanted in ((185, 191, 198), (213, 94, 0)):
        assert (colours == wanted).all(axis=1).sum() > 500
    # Bluish or yellowish lines: neither grey nor orange.
    assert (colours[:, 2] - colours[:, 0] > 60).sum() > 300
    with pytest.raises(PointCloudError, match='must be the same scan'):
        plot_scan_view(points[1:], found, config, path)


def test_command_draws_a_simulated_scan_and_keeps_what_is_there(tmp_path, capsys):
    path = tmp_path / 'a.png'
    words = ['plot', 'scan', '--simulate', 'flat', '--sensor', 'vlp-16', '--preset', 'vlp16', '-o']
    assert cli.main([*words, str(path)]) == 0
    assert 'points, written to' in capsys.readouterr().out
    before = path.read_bytes()
    assert cli.main([*words, str(path)]) == 2
    assert '--force replaces it' in capsys.readouterr().err
    assert path.read_bytes() == before
    assert cli.main([*words, str(path), '--force']) == 0
    for wrong in (
        [*words, str(tmp_path / 'a.jpg')],
        [*words, str(path), '--force', '--seed', '-1'],
    ):
        assert cli.main(wrong) == 2


def test_command_draws_a_file(tmp_path):
    scan = tmp_path / 'x.bin'
    points = np.zeros((3000, 4), np.float32)
    points[:, :3] = hilly_scan(3000)
    points.tofile(scan)
    assert cli.main(['plot', 'scan', str(scan), '-o', str(tmp_path / 'x.png')]) == 0
    assert (tmp_path / 'x.png').stat().st_size > 10_000
