"""What is wrong at the start is one line with a hint and exit code 2, never a traceback."""

import re
import signal
import subprocess
import sys

import pytest
from conftest import REPOSITORY

pytest.importorskip('rclpy', reason='ROS is not installed')

from ros_helpers import MODULE, NAMESPACE, Process, isolated_context, start_error

HEAD = '/**:\n  ros__parameters:\n'
FILES = {
    'range': (HEAD + '    label: {ground_tolerance: 9.0}\n', 'must be a number in [0.001, 5] m'),
    'type': (HEAD + '    label: {ground_tolerance: high}\n', "ground_tolerance = 'high': must be"),
    'integer': (HEAD + '    label: {ground_tolerance: 1}\n', 'with a decimal point as in 1.0'),
    'list': (HEAD + '    grid: {n_segments: [1, 2]}\n', 'must be an integer in [4, 2048]'),
    'nan': (HEAD + '    grid: {r_min: .nan}\n', 'grid.r_min = nan: must be'),
    'rule': (HEAD + '    grid: {r_min: 50.0, r_max: 20.0}\n', 'must be below grid.r_max = 20'),
    'choice': (HEAD + '    runtime: {backend: cuda}\n', 'must be one of auto, numba, numpy'),
    'huge': (HEAD + '    grid: {n_segments: 999999999999999999999}\n', 'must be an integer'),
    'sim_time': (HEAD + '    use_sim_time: "yes"\n', 'must be true or false'),
    'null': (HEAD + '    grid:\n', 'No value at line 3'),
    'mixed': (HEAD + '    grid: {n_bins: [1, 2.5]}\n', 'should be of same type'),
    'bare': ('label: {ground_tolerance: 0.1}\n', 'before ros__parameters at line 1'),
    'not_nested': ('/**:\n  label: {ground_tolerance: 0.1}\n', 'before ros__parameters'),
    'text': ('just words\n', 'no ros__parameters'),
    'syntax': (HEAD + '  label: [ {a\n', 'params file'),
    'tab': ('/**:\n\tros__parameters:\n', 'event near line 1'),
    'twice': (HEAD + '    grid: {n_bins: 40}\n    grid: {n_bins: 50}\n', 'grid: given twice'),
    'binary': (b'\xff\xfe\x00\x80', 'utf-8'),
}
QOS = 'qos_overrides./points.subscription'
WORDS = {
    'no such file': ('--params-file nowhere.yaml', 'nowhere.yaml'),
    'folder': ('--params-file .', "--params-file .'"),
    'no file': ('--params-file', 'No file path provided'),
    'no value': ('-p label.ground_tolerance', "'-p label.ground_tolerance"),
    'empty value': ('-p label.ground_tolerance:=', "'-p label.ground_tolerance"),
    'type': ('-p label.ground_tolerance:=low', "ground_tolerance = 'low': must be a number"),
    'range': ('-p grid.n_segments:=3', 'grid.n_segments = 3: must be an integer in [4, 2048]'),
    'sim time': ('-p use_sim_time:=maybe', "use_sim_time = 'maybe': must be true or false"),
    'remap': ('-r points', "'-r points'"),
    'topic': ('-r points:=/1;2', "'-r points:=/1;2'"),
    'name': ('-r __node:=1st', '__node:=1st'),
    'namespace': ('-r __ns:=front', '__ns:=front'),
    'argument': ('--nonsense', "UnknownROSArgsError: ['--nonsense']"),
    'log level': ('--log-level loud', 'does not use a valid severity level'),
    'reliability': (
        f'-p {QOS}.reliability:=maybe',
        "= 'maybe': must be one of reliable",
    ),
    'depth': (f'-p {QOS}.depth:=-3', 'depth = -3: must be an integer in [1, 10000]'),
    'depth 0': (f'-p {QOS}.depth:=0', 'depth = 0: must be'),
    'depth type': (f'-p {QOS}.depth:=many', "depth = 'many': must be"),
}


@pytest.mark.parametrize('name', FILES)
def test_bad_file(tmp_path, capfd, name):
    text, hint = FILES[name]
    path = tmp_path / 'bad.yaml'
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    assert hint in start_error(capfd, '--params-file', str(path))


@pytest.mark.parametrize('name', WORDS)
def test_bad_words(capfd, name):
    words, hint = WORDS[name]
    assert hint in start_error(capfd, *words.split())


@pytest.mark.parametrize(
    ('domain', 'hint'), [('999', 'must be an integer in [0, 232]'), ('a', 'not an integral')]
)
def test_bad_domain(monkeypatch, capfd, domain, hint):
    monkeypatch.setenv('ROS_DOMAIN_ID', domain)
    assert hint in start_error(capfd)


def test_log_level_and_parameter_file_of_one_node(tmp_path):
    """Two nodes side by side read one file, each its own part; the second is told to be quiet."""
    path = tmp_path / 'both.yaml'
    path.write_text(
        f'/**:\n  ros__parameters:\n    learning: {{mode: fixed}}\n'
        f'{NAMESPACE}/front:\n  ros__parameters:\n    label: {{ground_tolerance: 0.3}}\n'
        f'{NAMESPACE}/rear:\n  ros__parameters:\n    label: {{ground_tolerance: 0.4}}\n'
    )
    common = ('--ros-args', '-r', f'__ns:={NAMESPACE}', '--params-file', str(path))
    front = (*common, '-r', '__node:=front', '-r', 'points:=front/points')
    rear = (*common, '-r', '__node:=rear', '--log-level', 'warn', '-p', 'grid.nbins:=5')
    with (
        Process(*front, folder=tmp_path) as one,
        Process(*rear, folder=tmp_path, start=MODULE) as other,
        isolated_context() as context,
    ):
        one.wait_until_ready()
        assert 'label.ground_tolerance: 0.3 m' in one.log
        assert f'listening to {NAMESPACE}/front/points' in one.log
        assert_parameters(context, {'front': 0.3, 'rear': 0.4})
        # Quiet but for what is wrong, and that names what was meant.
        (line,) = other.log.splitlines()
        assert 'grid.nbins' in line
        assert 'did you mean grid.n_bins?' in line


def test_a_preset_as_the_readme_has_it(tmp_path):
    """The block that makes a copy of a preset, line for line, but for where the files are."""
    readme = (REPOSITORY / 'README.md').read_text(encoding='utf-8')
    blocks = re.findall(r'```sh\n(.*?)```', readme, re.DOTALL)
    (block,) = [block for block in blocks if 'config dump --preset' in block]
    *commands, node_command = block.splitlines()
    script = f'gp-ground-seg() {{ {sys.executable} -m gp_ground_seg "$@"; }}; set -e\n'
    done = subprocess.run(
        ['bash', '-c', script + '\n'.join(commands)],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert 'my.yaml: good; ' in done.stdout
    program, *words = node_command.split()
    assert program == 'gp-ground-seg'
    words[words.index('my.yaml')] = str(tmp_path / 'my.yaml')
    words += ['-p', 'grid.n_bins:=55']
    with Process(*words, folder=tmp_path, start=('-m', 'gp_ground_seg')) as node:
        node.wait_until_ready()
        assert 'listening to /velodyne_points' in node.log
        assert 'grid.n_segments: 120  (default 180)' in node.log
        assert 'grid.n_bins: 55  (default 80)' in node.log
        assert node.stop(signal.SIGINT)[0] == 0


def assert_parameters(context, tolerances):
    from rcl_interfaces.srv import GetParameters
    from rclpy.node import Node
    from ros_helpers import spinning, wait_for

    probe = Node('probe', context=context, namespace=NAMESPACE)
    with spinning(context, probe):
        for name, tolerance in tolerances.items():
            client = probe.create_client(GetParameters, f'{name}/get_parameters')
            wait_for(client.service_is_ready, f'service of {name}')
            future = client.call_async(
                GetParameters.Request(names=['label.ground_tolerance', 'learning.mode'])
            )
            wait_for(future.done, f'answer of {name}')
            values = future.result().values
            assert values[0].double_value == tolerance
            assert values[1].string_value == 'fixed'
