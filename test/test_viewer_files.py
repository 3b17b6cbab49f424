"""What is shipped to look at: RViz, Foxglove, the Nav2 snippet."""

import json
import re

import pytest
import yaml
from conftest import REPOSITORY

NODE = '/ground_segmentation_node'
OPTIONAL = {f'{NODE}/{name}' for name in ('labeled', 'ground_model', 'markers')}
TOPICS = {'/ground', '/obstacles', *OPTIONAL}


def test_topics_are_those_of_the_node():
    outputs = pytest.importorskip('gp_ground_seg.ros.outputs', reason='ROS is not installed')
    names = [output.topic for output in outputs.OUTPUTS]
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
