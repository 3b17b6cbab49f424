"""The launch files: with launch_ros, where ROS is installed from apt; the rest without."""

import ast
import re
import subprocess

import pytest
import yaml
from conftest import REPOSITORY

FILE = REPOSITORY / 'launch' / 'ground_segmentation.launch.py'
PAGE = (REPOSITORY / 'docs' / 'node.md').read_text(encoding='utf-8')


def constants(path):
    """Values of the names that a file binds to literals."""
    for node in ast.parse(path.read_text(encoding='utf-8')).body:
        if isinstance(node, ast.Assign):
            try:
                yield node.targets[0].id, ast.literal_eval(node.value)
            except ValueError:
                continue


def test_the_page_has_the_arguments_and_their_defaults():
    declared = dict(constants(FILE))['ARGUMENTS']
    shown = dict(re.findall(r'^\| `(\w+)` \| (?:`([^`]*)`)? ?\| ', PAGE, re.MULTILINE))
    assert shown == {name: default for name, default, _ in declared}


def test_rviz_is_told_of_each_topic_that_it_shows():
    found = dict(constants(FILE))
    names = {f'/{name}' for name in found['OUTPUTS']}
    names |= {f'/ground_segmentation_node/{name}' for name in found['OPTIONAL']}
    text = (REPOSITORY / 'config' / 'ground_segmentation.rviz').read_text(encoding='utf-8')
    displays = yaml.safe_load(text)['Visualization Manager']['Displays']
    assert names == {one['Topic']['Value'] for one in displays if 'Topic' in one}


def test_the_example_sets_arguments_that_exist():
    declared = {name for name, _, _ in dict(constants(FILE))['ARGUMENTS']}
    sensors = dict(constants(FILE.with_name('two_sensors.launch.py')))['SENSORS']
    assert len(sensors) == 2
    for arguments in sensors.values():
        assert set(arguments) <= declared
        assert yaml.safe_load(arguments['params']).keys() == {'sensor.height'}


def launched(*words):
    """Log of ``ros2 launch``, interrupted after the time that a node needs to start."""
    command = ['timeout', '--signal', 'INT', '20', 'ros2', 'launch', 'gp_ground_seg', *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.stdout + done.stderr


@pytest.fixture
def ros2_launch():
    pytest.importorskip('launch_ros', reason='launch_ros is not installed')
    packages = pytest.importorskip('ament_index_python.packages')
    try:
        packages.get_package_prefix('gp_ground_seg')
    except packages.PackageNotFoundError:
        pytest.skip('the workspace is not sourced')


def test_launch_starts_the_node(ros2_launch):
    lines = 'sensor.height: 1.2 m', 'listening to /lidar', 'front.ground_segmentation_node'
    words = 'topic:=/lidar', 'namespace:=front', 'params:={sensor.height: 1.2}'
    log = launched(FILE.name, *words)
    assert all(line in log for line in lines)


def test_launch_starts_two_nodes(ros2_launch):
    lines = 'listening to /lidar_front/points', 'listening to /lidar_rear/points'
    log = launched('two_sensors.launch.py')
    assert all(line in log for line in lines)


@pytest.mark.parametrize('word', ['params_file:=/no/such.yaml', 'params:=3', 'rviz:=perhaps'])
def test_launch_refuses(ros2_launch, word):
    name = word.partition(':=')[0]
    assert f'{name}:=' in launched(FILE.name, word)
