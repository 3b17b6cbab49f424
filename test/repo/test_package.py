"""The package as a whole: versions, layers, dependencies."""

import ast
import os
import re
import shlex
import subprocess
import sys
import sysconfig
import xml.etree.ElementTree as ElementTree

import pytest
from conftest import REPOSITORY
from test_layout import PACKAGE, parse

import gp_ground_seg
from gp_ground_seg.core.errors import install_hint
from gp_ground_seg.ros.session import ROS_WHEELS


@pytest.fixture
def package():
    return ElementTree.parse(REPOSITORY / 'package.xml').getroot()


ROS = (
    'rclpy ament_index_python bond builtin_interfaces diagnostic_msgs geometry_msgs nav_msgs '
    'rcl_interfaces rosgraph_msgs sensor_msgs sensor_msgs_py std_msgs tf2_ros visualization_msgs'
)


def imports(tree):
    """Names of the imported modules, with the name imported from each appended."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f'{node.module}.{alias.name}' for alias in node.names)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == 'require':
            yield ast.literal_eval(node.args[0])


def test_package_xml_is_that_of_this_package(package):
    assert package.get('format') == '3'
    assert package.findtext('export/build_type') == 'ament_python'
    depends = {element.text for element in package.iter('exec_depend')}
    trees = parse(REPOSITORY / PACKAGE).values()
    imported = {name.split('.')[0] for tree in trees for name in imports(tree)}
    assert imported & set(ROS.split()) <= depends
    files = [ast.parse(path.read_text()) for path in REPOSITORY.glob('launch/*.launch.py')]
    launched = {name.split('.')[0] for tree in files for name in imports(tree)}
    assert {'launch', 'launch_ros'} <= launched & depends
    assert launched <= depends | {'pathlib', 're', 'yaml', PACKAGE}


def test_one_version(package):
    """Of the newest section of the changelog as well, unless that is of the next release."""
    version = gp_ground_seg.__version__
    assert package.findtext('version') == version
    setup = (REPOSITORY / 'setup.py').read_text(encoding='utf-8')
    assert re.findall(r"version='(.*)',", setup) == [version]
    changelog = (REPOSITORY / 'CHANGELOG.rst').read_text(encoding='utf-8')
    newest, rule = re.search(r'^(.+)\n(-+)$', changelog, re.MULTILINE).groups()
    assert len(newest) == len(rule)
    assert newest == 'Forthcoming' or re.fullmatch(rf'{version} \(\d{{4}}-\d\d-\d\d\)', newest)


def test_the_address_of_the_repository_is_the_same_everywhere(package):
    """A placeholder in one form: who publishes the package replaces it in four files."""
    address = package.findtext("url[@type='repository']")
    assert address.startswith('https://')
    for name, line in (
        ('setup.py', f"url='{address}',"),
        ('CITATION.cff', f'repository-code: {address}\n'),
        ('README.md', f'git clone {address}.git && cd gp_ground_seg\n'),
    ):
        assert (REPOSITORY / name).read_text(encoding='utf-8').count(line) == 1, name


@pytest.mark.filterwarnings('ignore:nodes.Node.traverse')  # docutils, of catkin_pkg
def test_the_tools_of_ros_read_the_changelog():
    """catkin's, which bloom uses as well; what colcon reads is in `test_colcon.py`."""
    changelogs = pytest.importorskip('catkin_pkg.changelog', reason='catkin_pkg is not installed')
    changelog = changelogs.get_changelog_from_path(str(REPOSITORY / 'CHANGELOG.rst'))
    sections = {version: entries for version, _, entries in changelog.foreach_version()}
    assert len(sections.get('forthcoming') or sections[gp_ground_seg.__version__]) > 0


def test_public_names_are_listed_and_no_other_is_there():
    assert dir(gp_ground_seg) == sorted(gp_ground_seg.__all__)
    with pytest.raises(AttributeError, match="no attribute 'Nothing'"):
        gp_ground_seg.Nothing  # noqa: B018


def test_what_others_can_change_is_named_by_its_digest():
    """Tags of actions and images are moved; the container does not run as root."""
    workflow = (REPOSITORY / '.github/workflows/test.yml').read_text(encoding='utf-8')
    actions = re.findall(r'uses: (\S+)', workflow)
    assert actions and all(re.search('@[0-9a-f]{40}$', action) for action in actions)
    dockerfile = (REPOSITORY / 'Dockerfile').read_text(encoding='utf-8')
    (image,) = re.findall('^FROM (.*)$', dockerfile, re.MULTILINE)
    assert re.search('@sha256:[0-9a-f]{64}$', image)
    devcontainer = (REPOSITORY / '.devcontainer/devcontainer.json').read_text(encoding='utf-8')
    assert image in workflow and image in devcontainer
    assert dockerfile.index('USER 1000') < dockerfile.index('ENTRYPOINT')


def test_what_hints_name_is_what_our_extras_install():
    """Names of other packages on PyPI, so that a hint works wherever ours comes from."""
    named = set(shlex.split(ROS_WHEELS))
    for tree in parse(REPOSITORY / PACKAGE).values():
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
            is_hint = ast.unparse(call.func) in ('require', 'install_hint')
            if is_hint and isinstance(call.args[-1], ast.Constant):
                named |= {*shlex.split(call.args[-1].value)}
    assert {'rosbags', 'numba', 'ros-jazzy-rclpy[fastrtps]'} <= named
    setup = (REPOSITORY / 'setup.py').read_text(encoding='utf-8')
    assert not {name for name in named if not re.search(rf"'{re.escape(name)}[<>=[;']", setup)}


def test_a_hint_says_where_pip_works(tmp_path, monkeypatch):
    """Debian and Ubuntu mark their Python as theirs (PEP 668); a virtual environment is not."""
    monkeypatch.setattr(sysconfig, 'get_path', lambda _name: str(tmp_path))
    monkeypatch.setattr(sys, 'prefix', sys.base_prefix)
    here = f'{sys.executable} -m pip install rosbags'
    assert install_hint('rosbags') == here
    (tmp_path / 'EXTERNALLY-MANAGED').touch()
    there = 'pip install rosbags, in a virtual environment: see docs/install.md'
    assert install_hint('rosbags') == there
    monkeypatch.setattr(sys, 'prefix', '/elsewhere')
    assert install_hint('rosbags') == here


def test_the_script_for_a_workspace_refuses_in_one_line(tmp_path):
    (tmp_path / 'src').mkdir()
    script = REPOSITORY / 'scripts' / 'setup_workspace.sh'
    for word, complaint in (
        ('.', 'no ROS 2: source /opt/ros/jazzy/setup.bash'),
        ('src', 'src has no src: name the workspace, or start this in it'),
        ('elsewhere', 'elsewhere: no such folder'),
    ):
        done = subprocess.run(
            [script, word], cwd=tmp_path, env={'PATH': os.environ['PATH']},
            capture_output=True, text=True,
        )  # fmt: skip
        (line,) = done.stderr.splitlines()
        assert done.returncode == 2 and line.startswith('setup_workspace.sh: error: ')
        assert line.endswith(complaint)
    assert [path.name for path in tmp_path.rglob('*')] == ['src']
