"""The launch file: with launch_ros, where ROS is installed from apt; else with a stand-in."""

import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from conftest import REPOSITORY, load_script

pytestmark = pytest.mark.usefixtures('compiled_code')

FILE = REPOSITORY / 'launch' / 'ground_segmentation.launch.py'
PAGE = (REPOSITORY / 'docs' / 'node.md').read_text(encoding='utf-8')
(EXAMPLE,) = re.findall(r'```python\n(from launch import .*?)```', PAGE, re.DOTALL)


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


OURS = 'gp_ground_seg', FILE.name
WRONG = 'params_file:=/no/such.yaml', 'params:=3', 'rviz:=perhaps', 'required:=soon'


@pytest.fixture
def launched():
    """Log and exit code of ``ros2 launch``, interrupted once a node has had time to start."""
    pytest.importorskip('launch_ros', reason='launch_ros is not installed')
    packages = pytest.importorskip('ament_index_python.packages')
    try:
        packages.get_package_prefix('gp_ground_seg')
    except packages.PackageNotFoundError:
        pytest.skip('the workspace is not sourced')

    def launch(*words):
        command = ['timeout', '--signal', 'INT', '20', 'ros2', 'launch', *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        return done.stdout + done.stderr, done.returncode

    return launch


def test_launch_starts_the_node_and_the_two_of_the_page(launched, tmp_path):
    words = 'topic:=/lidar', 'namespace:=front', 'params:={sensor.height: 1.2}'
    log, _ = launched(*OURS, *words)
    for line in 'sensor.height: 1.2 m', 'listening to /lidar', 'front.ground_segmentation_node':
        assert line in log
    path = tmp_path / 'two.launch.py'
    path.write_text(EXAMPLE)
    log, _ = launched(path)
    for name in 'front', 'rear':
        assert f'listening to /lidar_{name}/points' in log


def test_launch_fails_with_what_it_is_given(launched):
    assert WRONG[0] in launched(*OURS, WRONG[0])[0]
    log, code = launched(*OURS, 'params:={grid.r_max: -1.0}')
    assert 'grid.r_max = -1.0' in log and code == 1


# Without launch: what the file asks of it is recorded, and the node started as it would.

STAND_IN = {
    'launch': ['LaunchDescription'],
    'launch.actions': [
        'DeclareLaunchArgument', 'LogInfo', 'OpaqueFunction', 'Shutdown', 'TimerAction',
    ],
    'launch_ros.actions': ['Node'],
}  # fmt: skip


class Recorded:
    def __init__(self, *args, **options):
        self.args, self.options = args, options


@pytest.fixture
def actions(monkeypatch, tmp_path):
    """A function from arguments to the actions, each its name and options; there is no RViz."""
    pytest.importorskip('ament_index_python', reason='ROS is not installed')
    index = tmp_path / 'share' / 'ament_index' / 'resource_index' / 'packages'
    index.mkdir(parents=True)
    (index / 'gp_ground_seg').touch()
    (tmp_path / 'share' / 'gp_ground_seg').symlink_to(REPOSITORY)
    for module, names in STAND_IN.items():
        monkeypatch.setitem(sys.modules, module, ModuleType(module))
        for name in names:
            setattr(sys.modules[module], name, type(name, (Recorded,), {}))

    def actions(*words):
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
            script = load_script('launch/ground_segmentation.launch.py')
            given = dict(word.split(':=', 1) for word in words)
            values = {name: default for name, default, _ in script.ARGUMENTS} | given
            context = SimpleNamespace(launch_configurations=values)
            *_, function = script.generate_launch_description().args[0]
            found = function.options['function'](context)
        return [(type(action).__name__, action.options) for action in found]

    actions.index = index
    return actions


def test_each_argument_reaches_the_node(actions):
    (_, node), (kind, note) = actions(
        'topic:=lidar', 'namespace:=/front/', 'log_level:=debug', 'use_sim_time:=True', 'rviz:=1',
        'params_file:=paper', 'params:={diagnostics.period: 0.1}',
    )  # fmt: skip
    # There is no RViz here: one line says so, and the node starts.
    assert kind == 'LogInfo' and 'rviz2 is not installed' in note['msg']
    name = dict(constants(FILE))['NODE']
    assert (node['package'], node['executable'], node['name']) == ('gp_ground_seg', name, name)
    assert (node['namespace'], node['remappings']) == ('front', [('points', 'lidar')])
    path, values = node['parameters']
    assert Path(path).samefile(REPOSITORY / 'config' / 'paper.yaml')
    assert values == {'diagnostics.period': 0.1, 'use_sim_time': True}
    # The log of the node, and of nothing else.
    assert node['ros_arguments'] == ['--log-level', f'front.{name}:=debug']


@pytest.mark.parametrize('text', ['false', 'False', '0'])
def test_nothing_else_starts_unless_asked_for(actions, text):
    ((_, node),) = actions(f'rviz:={text}', f'use_sim_time:={text}')
    assert node['parameters'] == []


def test_launch_ends_with_a_node_that_fails_unless_it_is_not_required(actions):
    ((_, node),) = actions()
    event = SimpleNamespace(returncode=2, process_name='node-1')
    with pytest.raises(RuntimeError, match='node-1 ended with exit code 2'):
        node['on_exit'](event, SimpleNamespace(is_shutdown=False))
    for event.returncode, is_shutdown in ((2, True), (0, False)):
        ended = node['on_exit'](event, SimpleNamespace(is_shutdown=is_shutdown))
        assert type(ended).__name__ == 'Shutdown'
    ((_, node),) = actions('required:=False')
    assert node['on_exit'] is None


@pytest.mark.parametrize('word', [*WRONG, 'use_sim_time:=yes'])
def test_a_wrong_argument_starts_nothing(actions, word):
    """It is said when launch knows all processes that it has to end."""
    ((kind, timer),) = actions(word)
    assert kind == 'TimerAction'
    (failure,) = timer['actions']
    with pytest.raises(RuntimeError) as raised:
        failure.options['function'](None)
    assert str(raised.value).startswith(word)


@pytest.mark.parametrize('pushed', ['', '/robot'])
def test_rviz_and_the_log_follow_the_namespace(actions, pushed):
    pytest.importorskip('ros_helpers')  # imports type support without its warnings
    outputs = importlib.import_module('gp_ground_seg.ros.outputs')
    (actions.index / 'rviz2').touch()
    words = 'rviz:=True', 'namespace:=front', 'use_sim_time:=1', f'ros_namespace:={pushed}'
    (_, node), (_, rviz) = actions(*words)
    assert node['parameters'] == rviz['parameters'] == [{'use_sim_time': True}]
    found, place = dict(constants(FILE)), f'{pushed}/front'
    plain = found['NODE']
    names = [output.topic.replace('~', plain) for output in outputs.OUTPUTS]
    assert rviz['remappings'] == [(f'/{name}', f'{place}/{name}') for name in names]
    logger = f'{place[1:].replace("/", ".")}.{plain}'
    assert node['ros_arguments'] == ['--log-level', f'{logger}:=info']
