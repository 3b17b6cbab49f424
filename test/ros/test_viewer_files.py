"""What is shipped to look at: RViz, Foxglove, the Nav2 snippet."""

import json
import re

import pytest
import yaml
from conftest import REPOSITORY

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.core.backend import NumpyBackend
from gp_ground_seg.core.parameters.schema import NODE_NAME
from gp_ground_seg.data.costmap import SegmentedCloud

NODE = '/ground_segmentation_node'
KINDS = {'scan': 'LaserScan', 'occupancy': 'Map'}
"""Displays of RViz that show no points."""
RVIZ = (REPOSITORY / 'config' / 'ground_segmentation.rviz').read_text(encoding='utf-8')
DISPLAYS = [d for d in yaml.safe_load(RVIZ)['Visualization Manager']['Displays'] if 'Topic' in d]
FOXGLOVE = json.loads((REPOSITORY / 'config' / 'foxglove_layout.json').read_text(encoding='utf-8'))
PANEL = FOXGLOVE['configById']['3D!ground']['topics']


def test_topics_are_those_of_the_node():
    outputs = pytest.importorskip('gp_ground_seg.ros.outputs', reason='ROS is not installed')
    # A message without a header has no place in a view.
    names = [o.topic for o in outputs.OUTPUTS if hasattr(o.message_type, 'header')]
    found = {name.replace('~', NODE) if name[0] == '~' else f'/{name}' for name in names}
    assert found == set(PANEL) == {one['Topic']['Value'] for one in DISPLAYS}


def test_rviz_and_foxglove_read_their_files():
    assert '<<:' not in RVIZ  # RViz reads it with yaml-cpp, which has no merge keys
    for display in DISPLAYS:
        assert display['Topic']['Reliability Policy'] == 'Reliable'
        kind = KINDS.get(display['Topic']['Value'].split('/')[-1], 'PointCloud2')
        assert display['Class'] == f'rviz_default_plugins/{kind}'
    # What costs the node something is off until it is wanted.
    on = {display['Topic']['Value'] for display in DISPLAYS if display['Enabled']}
    assert on == {'/ground', '/obstacles'}
    panels = re.findall(r'"(\w+!\w+)"', json.dumps(FOXGLOVE['layout']))
    assert sorted(panels) == sorted(FOXGLOVE['configById'])


def test_fields_are_those_of_the_messages():
    ros = pytest.importorskip('ros_helpers', reason='ROS is not installed')
    outputs = pytest.importorskip('gp_ground_seg.ros.outputs')
    points = ros.street(3000)
    cloud = ros.to_message(points)
    result = GroundSegmenter(backend=NumpyBackend()).segment(ros.xyz_of(points))
    segmented = SegmentedCloud(cloud, result, Config())
    made = {o.topic: o.build(segmented) for o in outputs.OUTPUTS}
    shown = {(d['Topic']['Value'], d['Channel Name']) for d in DISPLAYS if 'Channel Name' in d}
    shown |= {(topic, one['colorField']) for topic, one in PANEL.items() if 'colorField' in one}
    assert {(f'{NODE}/ground_model', name) for name in ('std', 'length_scale')} <= shown
    assert (f'{NODE}/labeled', 'label') in shown
    for topic, field in shown:
        assert field in {one.name for one in made[topic.replace(NODE, '~')].fields}


def snippets(page):
    text = (REPOSITORY / 'docs' / page).read_text(encoding='utf-8')
    return text, [yaml.safe_load(one) for one in re.findall(r'```yaml\n(.*?)```', text, re.DOTALL)]


def test_nav2_snippets_are_yaml_and_fit_the_command_and_the_messages():
    outputs = pytest.importorskip('gp_ground_seg.ros.outputs', reason='ROS is not installed')
    text, (costmap, *others) = snippets('nav2.md')
    layers = costmap['local_costmap']['local_costmap']['ros__parameters']
    assert set(layers['plugins']) <= set(layers)
    for other in others:
        layers |= other
    kinds = {o.topic.removeprefix('~/'): o.message_type.__name__ for o in outputs.OUTPUTS}
    names = {name: f'~/{name}' if name == 'scan' else name for name in kinds}
    for layer in (layers[name] for name in ('obstacle_layer', 'voxel_layer', 'stvl_layer')):
        sources = {source: layer[source] for source in layer['observation_sources'].split()}
        assert any(source['marking'] for source in sources.values())
        for output, source in sources.items():
            assert source['data_type'] == kinds[output]
            assert f'-r {names[output]}:={source["topic"]}' in text.replace("'", '')
            assert source['min_obstacle_height'] < -10.0 or not source['marking']
            assert not (output == 'ground' and source['marking'])
    consistency = layers['ground_consistency_layer']
    assert f'-r ground:={consistency["ground_points_topic"]}' in text
    assert f'-r obstacles:={consistency["nonground_points_topic"]}' in text
    assert layers['lifecycle_manager_lidar']['ros__parameters']['node_names'] == [NODE_NAME]
    given = dict(re.findall(r'-p ([\w.]+):=(\S+)', text))
    assert Config().replace(**{name: float(value) for name, value in given.items()})


def test_the_aggregator_of_the_diagnostics_finds_our_statuses():
    (found,) = (one for one in snippets('node.md')[1] if 'analyzers' in one)
    group = found['analyzers']['ros__parameters']['ground_segmentation']
    (part,) = group['contains']
    tasks = ('input', 'processing', 'model')
    assert all(part in f'front/{NODE_NAME}: {task}' for task in tasks)
    assert group['num_items'] == len(tasks)
