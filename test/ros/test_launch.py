"""The launch file: with launch_ros, where ROS is installed from apt; else with a stand-in."""

import importlib
import re
import subprocess
import sys
from unittest.mock import MagicMock

import pytest
from conftest import REPOSITORY, load_script

pytestmark = pytest.mark.usefixtures('compiled_code')

MODULES = (
    'ament_index_python.packages', 'launch', 'launch.actions', 'launch.conditions',
    'launch.substitutions', 'launch_ros.actions',
)  # fmt: skip
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


def test_the_page_the_file_and_the_node_have_the_same_names(monkeypatch):
    pytest.importorskip('ros_helpers', reason='ROS is not installed')
    outputs = importlib.import_module('gp_ground_seg.ros.outputs').OUTPUTS
    for module in MODULES:
        monkeypatch.setitem(sys.modules, module, MagicMock())
    sys.modules[MODULES[0]].get_package_share_directory = lambda _: REPOSITORY
    script = load_script(f'launch/{FILE}')
    script.generate_launch_description()
    rviz, node = (call.kwargs for call in script.Node.call_args_list)

    shown = re.findall(r'^\| `(\w+)` \| (?:`([^`]*)`)? ?\| ', PAGE, re.MULTILINE)
    default = str(script.CONFIG / 'default.yaml')
    declared = [(name, value.replace(default, '')) for name, value, _ in script.ARGUMENTS]
    assert shown == declared
    used = re.findall(r"given\['(\w+)'\]", (REPOSITORY / 'launch' / FILE).read_text())
    assert set(used) == set(dict(shown))
    in_viewer = [o.topic for o in outputs if hasattr(o.message_type, 'header')]
    names = {topic.replace('~', node['name']) for topic in in_viewer}
    assert dict(rviz['remappings']) == {f'/{name}': name for name in names}
    assert [topic for topic, _ in node['remappings']] == ['points']
    assert node['on_exit'] is script.Shutdown.return_value
