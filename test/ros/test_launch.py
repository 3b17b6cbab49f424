"""The launch file: with launch_ros, where ROS is installed from apt; else with a stand-in."""

import importlib
import re
import subprocess
import sys
from types import ModuleType

import pytest
from conftest import REPOSITORY, load_script

pytestmark = pytest.mark.usefixtures('compiled_code')

FILE = 'ground_segmentation.launch.py'
PAGE = (REPOSITORY / 'docs' / 'node.md').read_text(encoding='utf-8')
(EXAMPLE,) = re.findall(r'```python\n(from launch import .*?)```', PAGE, re.DOTALL)


@pytest.fixture
def launched():
    """Log of ``ros2 launch``, interrupted once a node has had time to start; CI starts one too."""
    pytest.importorskip('launch_ros', reason='launch_ros is not installed')
    packages = pytest.importorskip('ament_index_python.packages')
    try:
        packages.get_package_prefix('gp_ground_seg')
    except packages.PackageNotFoundError:
        pytest.skip('the workspace is not sourced')

    def launch(*words):
        command = ['timeout', '--signal', 'INT', '20', 'ros2', 'launch', *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        return done.stdout + done.stderr

    return launch


def test_launch_starts_the_two_nodes_of_the_page(launched, tmp_path):
    path = tmp_path / 'two.launch.py'
    path.write_text(EXAMPLE.replace('/etc/robot', str(tmp_path)))
    places = {'front': 1.2, 'rear': 0.6}
    for name, height in places.items():
        text = f'/**: {{ros__parameters: {{sensor: {{height: {height}}}}}}}\n'
        (tmp_path / f'{name}.yaml').write_text(text)
    log = launched(path)
    for name, height in places.items():
        assert f'[{name}.ground_segmentation_node]: listening to /lidar_{name}/points' in log
        assert f'sensor.height: {height} m' in log
    assert '/no/such.yaml' in launched('gp_ground_seg', FILE, 'params_file:=/no/such.yaml')


STAND_IN = {
    'launch': ['LaunchDescription'],
    'launch.actions': ['DeclareLaunchArgument'],
    'launch.conditions': ['IfCondition'],
    'launch.substitutions': ['LaunchConfiguration'],
    'launch_ros.actions': ['Node'],
}


class Recorded:
    def __init__(self, *args, **options):
        self.args, self.options = args, options


def test_the_page_the_file_and_the_node_have_the_same_names(monkeypatch, tmp_path):
    pytest.importorskip('ros_helpers', reason='ROS is not installed')
    outputs = importlib.import_module('gp_ground_seg.ros.outputs').OUTPUTS
    index = tmp_path / 'share' / 'ament_index' / 'resource_index' / 'packages'
    index.mkdir(parents=True)
    (index / 'gp_ground_seg').touch()
    (tmp_path / 'share' / 'gp_ground_seg').symlink_to(REPOSITORY)
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
    for module, names in STAND_IN.items():
        monkeypatch.setitem(sys.modules, module, ModuleType(module))
        for name in names:
            setattr(sys.modules[module], name, type(name, (Recorded,), {}))
    script = load_script(f'launch/{FILE}')

    shown = re.findall(r'^\| `(\w+)` \| (?:`([^`]*)`)? ?\| ', PAGE, re.MULTILINE)
    default = str(script.CONFIG / 'default.yaml')
    declared = [(name, value.replace(default, '')) for name, value, _ in script.ARGUMENTS]
    assert shown == declared
    (actions,) = script.generate_launch_description().args
    used = re.findall(r"given\['(\w+)'\]", (REPOSITORY / 'launch' / FILE).read_text())
    assert set(used) == set(dict(shown))
    rviz, node = (action.options for action in actions[-2:])
    names = [output.topic.replace('~', node['name']) for output in outputs]
    assert rviz['remappings'] == [(f'/{name}', name) for name in names]
    assert [topic for topic, _ in node['remappings']] == ['points']
