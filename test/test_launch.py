"""The launch files: with launch_ros, where ROS is installed from apt; else with a stand-in."""

import ast
import re
import signal
import subprocess
import sys
from types import ModuleType, SimpleNamespace

import pytest
import yaml
from conftest import REPOSITORY, load_script

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


WRONG = 'params_file:=/no/such.yaml', 'params:=3', 'rviz:=perhaps', 'respawn_delay:=soon'


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


@pytest.mark.parametrize('word', WRONG)
def test_launch_refuses(ros2_launch, word):
    name = word.partition(':=')[0]
    assert f'{name}:=' in launched(FILE.name, word)


@pytest.mark.parametrize('word', ['rviz:=True', 'use_sim_time:=True'])
def test_launch_takes_what_nav2_writes(ros2_launch, word):
    assert 'listening to' in launched(FILE.name, word)


def test_launch_ends_with_the_node_and_its_code(ros2_launch):
    command = ['ros2', 'launch', 'gp_ground_seg', FILE.name, 'params:={grid.r_max: -1.0}']
    assert subprocess.run(command, timeout=60, check=False).returncode == 1


# Without launch: what the file asks of it is recorded, and the node started as it would.

STAND_IN = {
    'launch': ['LaunchDescription'],
    'launch.actions': [
        'DeclareLaunchArgument', 'ExecuteProcess', 'GroupAction', 'IncludeLaunchDescription',
        'LogInfo', 'OpaqueFunction', 'Shutdown', 'TimerAction',
    ],
    'launch.launch_description_sources': ['PythonLaunchDescriptionSource'],
    'launch.substitutions': ['LaunchConfiguration'],
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


def command_of(node):
    """Arguments that launch_ros makes of the options of a node; parameters given by name."""
    words = ['--ros-args', '-r', f'__node:={node["name"]}', *node['ros_arguments']]
    words += ['-r', f'__ns:=/{node["namespace"]}'] if node['namespace'] else []
    words += [word for pair in node['remappings'] for word in ('-r', ':='.join(pair))]
    given = (item for values in node['parameters'] for item in values.items())
    return words + [word for name, v in given for word in ('-p', f'{name}:={str(v).lower()}')]


def test_each_argument_reaches_the_node(actions, tmp_path):
    ros = pytest.importorskip('ros_helpers', reason='ROS is not installed')
    namespace = ros.NAMESPACE.strip('/')
    (_, node), (kind, note) = actions(
        'topic:=lidar', 'ground:=free', 'obstacles:=/taken', f'namespace:={namespace}',
        'name:=cutter', 'log_level:=debug', 'use_sim_time:=True', 'rviz:=1',
        'params:={diagnostics.period: 0.1}',
    )  # fmt: skip
    # There is no RViz here: one line says so, and the node starts.
    assert kind == 'LogInfo' and 'rviz2 is not installed' in note['msg']
    with (
        ros.Process(*command_of(node), folder=tmp_path) as process,
        ros.isolated_context() as context,
    ):
        probe = ros.Node('probe', context=context, namespace=ros.NAMESPACE)
        lidar = probe.create_publisher(ros.PointCloud2, 'lidar', ros.RELIABLE)
        outputs = [ros.Collector(probe, ros.PointCloud2, name) for name in ('free', '/taken')]
        reports = ros.Collector(probe, ros.DiagnosticArray, '/diagnostics')
        with ros.spinning(context, probe):
            cloud = ros.to_message(ros.street(1000))
            ros.wait_for(
                lambda: lidar.publish(cloud) or all(o.messages for o in outputs), 'both outputs'
            )
            n_reports = len(reports.messages)
            statuses = reports.wait(n_reports + 2)[-1].status
        assert {status.hardware_id for status in statuses} == {f'{ros.NAMESPACE}/cutter'}
        values = {k: v for status in statuses for k, v in ros.values_of(status).items()}
        assert values['Clock'].startswith('simulated')
        assert '[DEBUG]' in process.log
        assert process.stop(signal.SIGINT)[0] == 0


@pytest.mark.parametrize('text', ['false', 'False', '0'])
def test_nothing_else_starts_unless_asked_for(actions, text):
    ((_, node),) = actions(f'rviz:={text}', f'use_sim_time:={text}', f'respawn:={text}')
    assert node['parameters'] == []


def test_launch_ends_with_a_node_that_fails_unless_it_is_respawned(actions, tmp_path):
    ros = pytest.importorskip('ros_helpers', reason='ROS is not installed')
    ((_, node),) = actions('params:={grid.r_max: -1.0}')
    with ros.Process(*command_of(node), folder=tmp_path) as process:
        code = process.popen.wait(ros.PATIENCE)
    event = SimpleNamespace(returncode=code, process_name='node-1')
    with pytest.raises(RuntimeError, match='node-1 ended with exit code 2'):
        node['on_exit'](event, SimpleNamespace(is_shutdown=False))
    for event.returncode, is_shutdown in ((2, True), (0, False)):
        ended = node['on_exit'](event, SimpleNamespace(is_shutdown=is_shutdown))
        assert type(ended).__name__ == 'Shutdown'
    ((_, node),) = actions('respawn:=True', 'respawn_delay:=2')
    assert (node['respawn'], node['respawn_delay'], node['on_exit']) == (True, 2.0, None)


@pytest.mark.parametrize('word', [*WRONG, 'use_sim_time:=yes'])
def test_a_wrong_argument_starts_nothing_and_fails_when_launch_can_end_the_rest(actions, word):
    ((kind, timer),) = actions(word)
    assert kind == 'TimerAction'
    (failure,) = timer['actions']
    with pytest.raises(RuntimeError, match=re.escape(word)):
        failure.options['function'](None)


def test_rviz_follows_the_topics_and_a_bag_gives_the_time(actions):
    (actions.index / 'rviz2').touch()
    words = 'rviz:=True', 'bag:=drive', 'ground:=/free', 'namespace:=front', 'name:=cutter'
    (_, node), (_, rviz), (kind, bag) = actions(*words)
    assert kind == 'ExecuteProcess' and bag['cmd'][:4] == ['ros2', 'bag', 'play', 'drive']
    assert '--clock' in bag['cmd']
    assert node['parameters'] == rviz['parameters'] == [{'use_sim_time': True}]
    plain, optional = '/ground_segmentation_node', dict(constants(FILE))['OPTIONAL']
    assert rviz['remappings'] == [
        ('/ground', '/free'), ('/obstacles', '/front/obstacles'),
        *((f'{plain}/{name}', f'/front/cutter/{name}') for name in optional),
    ]  # fmt: skip


@pytest.mark.parametrize('bag', ['', 'drive'])
def test_two_sensors_have_arguments_of_their_own_and_one_bag(actions, bag):
    description = load_script('launch/two_sensors.launch.py').generate_launch_description()
    *declared, nodes = description.args[0]
    assert {one.args[0]: one.options['default_value'] for one in declared[:2]} == {
        'front_topic': '/lidar_front/points', 'front_params': '{sensor.height: 1.2}'
    }  # fmt: skip
    context = SimpleNamespace(launch_configurations={'bag': bag} if bag else {})
    front, rear = (
        dict(group.args[0][0].options['launch_arguments'])
        for group in nodes.options['function'](context)
    )
    assert (front['namespace'], front['topic'].args) == ('front', ('front_topic',))
    # The first takes bag:= as it is given; the second has its time and does not play it again.
    assert front.keys() == {'namespace', 'topic', 'params'}
    time = {'bag': '', 'use_sim_time': 'true'} if bag else {}
    assert {name: rear[name] for name in rear.keys() - front.keys()} == time
