"""Start and end of ROS processes: arguments that are wrong, signals at any time."""

import importlib.util
import os
import signal
import subprocess
import sys

import cli_runner
import pytest
import rclpy
import ros_helpers as ros
from bag_samples import write_ros2_bag
from cli_runner import children, cpu_seconds, is_running
from conftest import run_python
from ros_helpers import IN_NAMESPACE, MODULE, NAMESPACE, PATIENCE, Process, wait_for

from gp_ground_seg.core.jit import HAVE_NUMBA
from gp_ground_seg.core.parameters.schema import read_yaml, sections_of
from gp_ground_seg.ros.arguments import unused_files
from gp_ground_seg.ros.node import main
from gp_ground_seg.ros.session import ROS_WHEELS, ros_session, stop_on_signals

FIXED = (*IN_NAMESPACE, *ros.given({'learning.mode': 'fixed'}))
QOS = 'qos_overrides./points.subscription'
HEAD = '/**:\n  ros__parameters:\n'

# What is wrong at the start is one line with a hint and exit code 2, never a traceback.

FILES = {
    **{HEAD + f'    {text}\n': said for text, said in {
        'label: {ground_tolerance: 9.0}': 'd.yaml: label.ground_tolerance = 9.0: must be',
        'grid: {r_min: 50.0, r_max: 20.0}': 'd.yaml: grid.r_min = 50: must be below',
        'grid: {n_segments: 999999999999999999999}': 'must be an integer',
        'use_sim_time: "yes"': 'must be true or false',
        'grid:': 'No value at line 3',
        'grid: {n_bins: [1, 2.5]}': 'd.yaml: grid.n_bins = [1, 2.5]: must have one type',
        'input.crop_box: [-1, 0.3, 0.0]': 'd.yaml: input.crop_box = [-1, 0.3, 0.0]: must h',
        'input: {crop_box: []}': 'd.yaml: input.crop_box = []: ROS does not read an empty',
        'grid: {n_bins: 1_80}': "d.yaml: grid.n_bins = '1_80': must be an integer",
        'sensor.height: !!float "1.0"': "d.yaml: sensor.height = '1.0': must be auto",
        'surface.look_aside: 1': 'd.yaml: surface.look_aside = 1: must be true or false',
        'grid: {n_bins: 40}\n    grid: {n_bins: 50}': 'd.yaml: grid: given twice',
    }.items()},
    '/1a:\n  ros__parameters: {}\n': 'node name must not start with a number',
    'a b:\n  ros__parameters: {}\n': 'node name must not contain characters other than alphanum',
    'a/:\n  ros__parameters: {sensor.height: 1.0}\n': 'node name must not be empty',
    'label: {ground_tolerance: 0.1}\n': 'd.yaml: no ros__parameters, which the node needs',
    '/**:\n  a:\n    grid: {n_bins: 50}\n': 'd.yaml: no ros__parameters',
    'just words\n': 'd.yaml: no ros__parameters',
    HEAD + '  label: [ {a\n': 'd.yaml: not valid YAML',
    '/**:\n\tros__parameters:\n': 'd.yaml: not valid YAML',
    '\xff\xfe\0\x80': 'd.yaml: not a text file',
}  # fmt: skip
NO_RULES = (
    'points:=/1;2', '__node:=1st', '__node:=', '__node:=a/b', '__ns:=front', '__ns:=/1a',
    'points:=lidar/', 'points:=~front', 'points:=/1lidar', 'points:=/a//b', 'points:=/front-left',
    'points=/a',
)  # fmt: skip
WORDS = {
    '--params-file nowhere.yaml': 'error: nowhere.yaml: No such file',
    '--params-file .': 'error: .: Is a directory',
    '--params-file': 'No file path provided',
    '-p label.ground_tolerance': "rule: '-p label.ground_tolerance'",
    '-r points': "parse remap rule: '-r points'",
    **{f'-r {rule}': f"'-r {rule}'. .*: must be OLD:=NEW, of topics such as" for rule in NO_RULES},
    '-r __ns:=/front/': 'invalid node namespace: .*: must be OLD:=NEW',
    '-p sensor.height:1': "'-p sensor.height:1'.*: must be NAME:=VALUE, as in sensor.height:=1.2",
    '--nonsense': "UnknownROSArgsError: ['--nonsense']",
    '--log-level loud': 'valid severity level: must be debug, info, warn, error or fatal',
    f'-p {QOS}.reliability:=maybe': 'policy `reliability`: `maybe`',
    f'-p {QOS}.depth:=-3': 'depth = -3: must be an integer in [1, 10000]',
    '-p input.crop_box:=[1.0,0.0,0.0,1.0,0.0,1.0]': 'must be none or six numbers in [-100',
    '-p input.crop_box:=[]': 'error: input.crop_box = []: ROS does not read an empty list; write',
    '-p x:=[]': 'error: x = []: ROS does not read an empty list; write none',
    '-p sensor.height:=': "'-p sensor.height:='.*: must be NAME:=VALUE",
    '-p sensor.height:=1,5': "error: sensor.height = '1,5': must be auto or a number in",
    '-p label.rule:=rough': "error: label.rule = 'rough': must be one of roughness, tolerance",
    '-p use_sim_time:=1': 'must be true or false',
    **{f'ROS_DOMAIN_ID={v}': f'= {v}: must be an integer in [0, 232]' for v in ('999', 'a', '-1')},
    'RCUTILS_COLORIZED_OUTPUT=yes': 'OUTPUT = yes: must be an integer in [0, 1]',
    'RCUTILS_LOGGING_USE_STDOUT=true': 'STDOUT = true: must be an integer in [0, 1]',
    'RCUTILS_LOGGING_BUFFERED_STREAM=2': 'STREAM = 2: must be an integer in [0, 1]',
}
if importlib.util.find_spec('tf2_ros') is None:
    WORDS['-p frame.level:=tf'] = (
        'frame.level = tf: needs tf2_ros, which cannot be imported: sudo apt install '
        'ros-jazzy-tf2-ros-py'
    )


@pytest.mark.parametrize('given', [*FILES, *WORDS])
def test_what_is_refused_is_said_in_one_line(tmp_path, monkeypatch, capfd, given):
    if given.startswith('R'):
        monkeypatch.setenv(*given.split('='))
    words = [word for word in given.split() if word[0] != 'R']
    if given in FILES:
        path = tmp_path / 'b\x1b[2Ja\nd.yaml'
        path.write_bytes(given.encode('latin-1'))
        words = ['--params-file', str(path)]
    assert main(['--ros-args', *words]) == 2
    said = capfd.readouterr()
    line = said.err.splitlines()[-1]
    assert said.out == '' and 'Traceback' not in said.err
    assert line.startswith('ground_segmentation_node: error: ')
    parts = {**FILES, **WORDS}[given].split('.*')
    assert all(part in line for part in parts) and line.isprintable() and '.c:' not in line


@pytest.mark.parametrize('words', ['node nonsense', 'node --ros-args -- nonsense'])
def test_words_that_nobody_takes_are_refused(capsys, words):
    with pytest.raises(SystemExit, match='2'):
        sys.exit(cli_runner.run(*words.split()))
    assert 'nonsense' in capsys.readouterr().err


NO_FOLDER = """
import os
import gp_ground_seg.ros.node  # once for all
from gp_ground_seg.cli.main import main
for name in ('HOME', 'ROS_HOME', 'ROS_LOG_DIR'):
    os.environ.pop(name, None)
for given in ({}, {'HOME': '/proc'}, {'ROS_LOG_DIR': '/proc'}):
    if not (process := os.fork()):
        os.environ |= given
        os._exit(main(['node']))
    assert os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == 2
"""


def test_logs_that_have_no_folder():
    out, errors = run_python(NO_FOLDER)
    said = ': set ROS_LOG_DIR to a folder that the node may write to'
    assert [line.endswith(said) for line in (out + errors).splitlines()] == 3 * [True]


NO_ROS = """
import sys
sys.modules['rclpy'] = None
from gp_ground_seg.cli.main import main
for words in (['node'], ['play', sys.argv[1]], ['demo']):
    assert main(words) == 2
"""


def test_missing_ros_is_said_in_one_line(tmp_path):
    write_ros2_bag(tmp_path / 'drive.mcap', 1)
    out, errors = run_python(NO_ROS, tmp_path / 'drive.mcap')
    commands = 'the node', 'play', 'the demo'
    for command, line in zip(commands, (out + errors).splitlines(), strict=True):
        assert f'{command} needs ROS 2, which cannot be imported' in line
        assert f'pip install {ROS_WHEELS}' in line


@pytest.mark.parametrize(
    ('name', 'words'),
    [
        ('rmw_cyclonedds_cpp', MODULE),
        ('rmw_connextdds', ('-m', 'gp_ground_seg', 'demo')),
        ('fastrtps', MODULE),
    ],
)
def test_middleware_of_another_installation_is_named(words, name):
    command, given = [sys.executable, *words], {**os.environ, 'RMW_IMPLEMENTATION': name}
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, env=given)
    (line,) = done.stderr.splitlines()
    package = f'ros-jazzy-{name.replace("_", "-")}'
    assert done.returncode == 2 and line.endswith(f'stall {package}')
    assert f'RMW_IMPLEMENTATION = {name}: is not installed here: unset it, or in' in line


NUMBERS = (
    '1', '+1', '-1', '010', '09', '0o17', '0b11', '0x1F', '1_80', '1:30', '1.', '.5', '-.5', '1e3',
    '99999999999999999999', '2026-11-28', 'inf', '.inf', '-.INF', '1,5', 'y',
    '!!str 5', 'Y', 'yes', 'On', 'oN', 'TRUE', 'off', 'N', '"no"', '~', 'null', '=', '<<',
    '[1, 2]', '[1.0, 2e0]', '[y, no]', '[a, "1"]', '|-\n      a', 'fax', '-0x10',
)  # fmt: skip


def test_words_are_read_as_rcl_reads_them(tmp_path):
    path = tmp_path / 'words.yaml'
    lines = [f'    w{k}: {word}\n' for k, word in enumerate(NUMBERS)]
    path.write_text(HEAD + ''.join(lines))
    options = {'automatically_declare_parameters_from_overrides': True}
    with ros.isolated_context() as context:
        words = ['--ros-args', '--params-file', str(path)]
        node = rclpy.create_node('words', context=context, cli_args=words, **options)
        theirs = [node.get_parameter(f'w{k}').value for k in range(len(NUMBERS))]
    ((_, ours),) = sections_of(read_yaml(path))
    for word, value, own in zip(NUMBERS, theirs, ours.values(), strict=True):
        value = [*value] if isinstance(own, list) else value
        assert (value, type(value)) == (own, type(own)), word


AGREED = {
    'front:\n  ground_segmentation_node:\n    ros__parameters: {sensor.height: 1.2}\n': 0,
    HEAD + '    frame.base: 2026-11-28\n': 0,
    HEAD + '    {sensor.height: 1, surface.look_aside: n, input.crop_box: none}\n': 0,
    HEAD + '    use_sim_time: true\nother:\n  ros__parameters: {a: [], b: [1, 2]}\n': 0,
    '/**:\n  ros__parameters: {sensor.height: 1}\nfront/ground_segmentation_node:\n'
    '  ros__parameters: {sensor.height: 2.0}\n': 0,
    **dict.fromkeys(FILES, 2),
}  # fmt: skip


@pytest.mark.parametrize('text', AGREED)
def test_check_and_the_node_agree(tmp_path, capsys, text):
    path = tmp_path / 'my.yaml'
    path.write_bytes(text.encode('latin-1'))
    is_bare = 'ros__' not in text and cli_runner.run('config', 'check', path) == 0
    assert is_bare == ('not in the form of ROS' in capsys.readouterr().out)
    assert is_bare or cli_runner.run('config', 'check', path) == AGREED[text], capsys.readouterr()
    if AGREED[text] == 0:
        words = '-r', '__ns:=/front', '--params-file', str(path)
        with ros.started_node(*words) as node:
            assert unused_files(words, node.get_fully_qualified_name()) == []


NAME = f'{NAMESPACE}/front/filter'
P = '{ros__parameters: {label: {ground_tolerance: 0.3}}}'
USED = (
    '/**', '"**"', NAME, NAME[1:], f'{NAMESPACE}:\n  front:\n    filter',
    f'{NAMESPACE}/front:\n  filter', '/**/filter', '/**:\n  filter', '/*/*/filter',
    '/*/front:\n  filter', f'{NAMESPACE}/**', '/*/*/*', f'{NAME}/**', f'other: {P}\n{NAME}',
)  # fmt: skip
UNUSED = (
    'patchworkpp_node', 'ground_segmentation_node', 'filter', f'{NAMESPACE}/filter',
    f'{NAMESPACE}/front:\n  other', '/**/front', f'{NAMESPACE}/*', '"*/filter"', '/*',
)  # fmt: skip
"""Keys of parameters; in them the node has another name, or another namespace."""


@pytest.mark.parametrize('keys', [*USED, *UNUSED])
def test_a_file_is_unused_where_rcl_takes_nothing_of_it(tmp_path, keys):
    path = tmp_path / 'keys.yaml'
    path.write_text(f'{keys}: {P}\n')
    words = '-r', f'__ns:={NAMESPACE}/front', '-r', '__node:=filter', '--params-file', str(path)
    with ros.started_node(*words) as node:
        assert (node.config.label.ground_tolerance == 0.3) == (keys in USED)
        assert len(unused_files(words, node.get_fully_qualified_name())) == (keys in UNUSED)


def test_unused_files_are_warned_of_with_their_keys(tmp_path):
    words = []
    for name, keys in (('a\x1b[2J', ['b', '/c/d']), ('used', ['/**'])):
        path = tmp_path / f'{name}.yaml'
        path.write_text(''.join(f'{key}:\n  ros__parameters: {{}}\n' for key in keys))
        words += ['--params-file', str(path)]
    with Process(*FIXED, *words, folder=tmp_path) as node:
        node.wait_until_ready('not used')
        (line,) = [line for line in node.log.splitlines() if 'WARN' in line]
    assert rf'{tmp_path}/a\x1b[2J.yaml: not used: ' in line
    assert f'those of b, /c/d, and this node is {NAMESPACE}/ground_segmentation_node' in line
    assert unused_files(['--params-file', 'gone.yaml'], '/front/filter') == []


# Signals to the node: it ends with code 0, after the cloud at hand.


# The import of ROS removes the folder HOLD, and waits until that is there again.
HOLD = """
import os, sys, time
class Importer:
    def find_spec(self, name, *_):
        if name == 'rclpy':
            sys.meta_path.remove(self)
            os.rmdir(os.environ['HOLD'])
            while not os.path.exists(os.environ['HOLD']):
                time.sleep(0.01)
sys.meta_path.insert(0, Importer())
"""


@pytest.mark.parametrize(
    ('start', 'number'), [(ros.ENTRY_POINT, signal.SIGINT), (MODULE, signal.SIGTERM)]
)
def test_while_importing(tmp_path, start, number):
    (hold := tmp_path / 'hold').mkdir()
    (tmp_path / 'sitecustomize.py').write_text(HOLD)
    environment = {'HOLD': str(hold), 'PYTHONPATH': os.pathsep.join([str(tmp_path), *sys.path])}
    with Process(*FIXED, folder=tmp_path, start=start, **environment) as node:
        wait_for(lambda: not hold.exists(), 'import of ROS')
        node.popen.send_signal(number)
        hold.mkdir()
        node.end_well(number)
        assert 'listening' not in node.log


@pytest.mark.slow
@pytest.mark.skipif(not HAVE_NUMBA, reason='numba is not installed')
@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGKILL])
@pytest.mark.parametrize('mode', [0o700, 0o777])
def test_while_compiling(tmp_path, mode, number):
    """The compiling process ends too, also with a node that is killed.

    In a folder that others can write to nothing is kept: the node compiles in a thread then, for
    a minute, which nobody waits for.
    """
    cache = tmp_path / 'cache'
    cache.mkdir()
    cache.chmod(mode)
    with Process(*FIXED, folder=tmp_path, NUMBA_CACHE_DIR=str(cache)) as node:
        node.wait_until_ready()
        worker = node.popen.pid
        if mode == 0o700:
            wait_for(lambda: children(node.popen.pid), 'compiler')
            (worker,) = children(node.popen.pid)
        else:
            node.wait_until_ready('others can write')
        before = cpu_seconds(worker)
        wait_for(lambda: cpu_seconds(worker) > before + 2.0, 'work')
        if number == signal.SIGKILL:
            node.popen.kill()
        else:
            node.end_well(number)
    wait_for(lambda: not is_running(worker), 'end of the compiler')


def test_under_load(tmp_path):
    """The cloud at hand is the last one; signals that follow do not break the end."""
    message = ros.to_message(ros.street(20_000))
    slow = {'runtime.backend': 'numpy', 'grid.n_segments': 360, 'learning.segment_step': 1}
    with ros.linked_process(tmp_path, slow) as (node, link):
        for _ in range(6):
            link.publisher.publish(message)
        link.ground.wait(1)
        # A terminal and a launch file both send one.
        for _ in range(2):
            node.popen.send_signal(signal.SIGINT)
        node.end_well(signal.SIGTERM)
        assert len(link.ground.messages) < 6


IGNORING = ['/bin/sh', '-c', 'trap "" INT; exec "$@"', 'sh', sys.executable, '-m', 'gp_ground_seg']
"""As a shell without job control starts what ends with ``&``."""


@pytest.mark.slow
def test_sigint_that_was_ignored_at_the_start_ends_the_player_and_the_node(tmp_path):
    bag = tmp_path / 'drive.mcap'
    write_ros2_bag(bag, 3)
    to_node = ('--ros-args', '-r', f'/points:={NAMESPACE}/points')
    player = [*IGNORING, 'play', str(bag), '--loop', *to_node]
    node = [*IGNORING, 'node', *FIXED, '-p', 'runtime.backend:=numpy']
    with Process(folder=tmp_path, command=node) as node, ros.linked(sends=None) as link:
        with Process(folder=tmp_path, command=player) as player:
            link.ground.wait(4)
            assert player.stop(signal.SIGINT) == 130
            assert player.log.splitlines()[-1] == 'gp-ground-seg: interrupted'
        node.end_well(signal.SIGINT)


STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@pytest.fixture
def handlers():
    """Handlers as in a terminal, also under nohup; those in use are there again after the test."""
    before = {number: signal.getsignal(number) for number in STOPS}
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield {**before, signal.SIGHUP: signal.SIG_DFL}
    for number, handler in before.items():
        signal.signal(number, handler)


def test_without_a_signal_all_is_as_before_and_an_error_is_an_error(handlers):
    is_passed_on = pytest.raises(RuntimeError, match='mine, False')
    with is_passed_on, stop_on_signals(), stop_on_signals() as stop, ros_session('any'):
        raise RuntimeError(f'mine, {stop.made}')
    assert {number: signal.getsignal(number) for number in STOPS} == handlers


WAITS = {
    'sleep': lambda session: session.sleep(0.001),
    'spin': lambda session: session.spin(0.001),
    'check': lambda session: session.check(),
    'the end of the block': lambda _session: None,
}


def wait_for_signal(wait, number):
    with ros_session('any') as session:
        for _ in range(2):
            os.kill(os.getpid(), number)  # the second changes nothing
        WAITS[wait](session)
        assert wait == 'the end of the block'


@pytest.mark.parametrize('number', STOPS)
@pytest.mark.parametrize('wait', WAITS)
@pytest.mark.usefixtures('handlers')
def test_a_signal_interrupts_the_next_wait(wait, number):
    with pytest.raises(KeyboardInterrupt):
        wait_for_signal(wait, number)


@pytest.mark.usefixtures('handlers')
def test_a_hangup_that_is_ignored_stays_so():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with ros_session('any') as session:
        os.kill(os.getpid(), signal.SIGHUP)
        session.sleep(0.001)
