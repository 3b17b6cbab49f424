"""Start and end of ROS processes: arguments that are wrong, signals at any time."""

import os
import re
import signal
import subprocess
import sys

import cli_runner
import pytest
import ros_helpers as ros
from bag_samples import write_ros2_bag
from cli_runner import children, is_running, stat_words
from conftest import REPOSITORY
from ros_helpers import IN_NAMESPACE, MODULE, NAMESPACE, Process, wait_for

from gp_ground_seg.core.jit import HAVE_NUMBA
from gp_ground_seg.ros.arguments import unused_files
from gp_ground_seg.ros.session import ROS_WHEELS, ros_session, stop_on_signals

FIXED = (*IN_NAMESPACE, '-p', 'learning.mode:=fixed')
SOON = 4.0
"""Time of the cloud at hand, and what a machine that does other things adds to it [s]."""


def run_python(*words):
    return subprocess.run([sys.executable, *words], capture_output=True, text=True, timeout=60)


# What is wrong at the start is one line with a hint and exit code 2, never a traceback.

HEAD = '/**:\n  ros__parameters:\n'
FILES = {
    'range': (HEAD + '    label: {ground_tolerance: 9.0}\n', 'must be a number in [0.001, 5] m'),
    'rule': (HEAD + '    grid: {r_min: 50.0, r_max: 20.0}\n', 'must be below grid.r_max = 20'),
    'huge': (HEAD + '    grid: {n_segments: 999999999999999999999}\n', 'must be an integer'),
    'sim_time': (HEAD + '    use_sim_time: "yes"\n', 'must be true or false'),
    'null': (HEAD + '    grid:\n', 'No value at line 3'),
    'mixed': (HEAD + '    grid: {n_bins: [1, 2.5]}\n', 'should be of same type'),
    'bare': ('label: {ground_tolerance: 0.1}\n', 'config dump --config FILE > ros.yaml'),
    'no groups': ('/**:\n  a:\n    grid: {n_bins: 50}\n', 'gp-ground-seg config dump writes'),
    'text': ('just words\n', 'no ros__parameters'),
    'syntax': (HEAD + '  label: [ {a\n', 'not valid YAML'),
    'tab': ('/**:\n\tros__parameters:\n', 'not valid YAML'),
    'twice': (HEAD + '    grid: {n_bins: 40}\n    grid: {n_bins: 50}\n', 'grid: given twice'),
    'binary': (b'\xff\xfe\x00\x80', 'utf-8'),
}
QOS = 'qos_overrides./points.subscription'
WORDS = {
    'no such file': ('--params-file nowhere.yaml', 'error: nowhere.yaml: No such file'),
    'folder': ('--params-file .', 'error: .: Is a directory'),
    'no file': ('--params-file', 'No file path provided'),
    'no value': ('-p label.ground_tolerance', "rule: '-p label.ground_tolerance'"),
    'remap': ('-r points', "parse remap rule: '-r points'"),
    'topic': ('-r points:=/1;2', "'-r points:=/1;2'"),
    'name': ('-r __node:=1st', '__node:=1st'),
    'namespace': ('-r __ns:=front', '__ns:=front'),
    'argument': ('--nonsense', "UnknownROSArgsError: ['--nonsense']"),
    'log level': ('--log-level loud', 'does not use a valid severity level'),
    'reliability': (f'-p {QOS}.reliability:=maybe', 'policy `reliability`: `maybe`'),
    'depth': (f'-p {QOS}.depth:=-3', 'depth = -3: must be an integer in [1, 10000]'),
    'box': (
        '-p input.crop_box:=[1.0,0.0,0.0,1.0,0.0,1.0]',
        'must be none or six numbers in [-100',
    ),
    'empty list': ('-p input.crop_box:=[]', 'null or an empty list'),
}


@pytest.mark.parametrize('name', FILES)
def test_bad_file(tmp_path, capfd, name):
    text, hint = FILES[name]
    path = tmp_path / 'b\x1b[2Ja\nd.yaml'
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    line = ros.start_error(capfd, '--params-file', str(path))
    assert hint in line and line.isprintable()
    assert r'b\x1b[2Ja\nd.yaml' in line or name in ('huge', 'sim_time', 'null', 'mixed')


@pytest.mark.parametrize('name', WORDS)
def test_bad_words(capfd, name):
    words, hint = WORDS[name]
    line = ros.start_error(capfd, *words.split())
    assert hint in line and '.c:' not in line


@pytest.mark.parametrize(
    ('domain', 'hint'), [('999', 'must be an integer in [0, 232]'), ('a', 'not an integral')]
)
def test_bad_domain(monkeypatch, capfd, domain, hint):
    monkeypatch.setenv('ROS_DOMAIN_ID', domain)
    assert hint in ros.start_error(capfd)


@pytest.mark.parametrize('words', ['node nonsense', 'node --ros-args -- nonsense'])
def test_words_that_nobody_takes_are_refused(capsys, words):
    with ros.isolated(), pytest.raises(SystemExit, match='2'):
        sys.exit(cli_runner.run(*words.split()))
    assert 'nonsense' in capsys.readouterr().err


@pytest.mark.parametrize('given', [{}, {'HOME': '/proc'}, {'ROS_LOG_DIR': '/proc'}])
def test_logs_that_have_no_folder(given, monkeypatch):
    for name in ('HOME', 'ROS_HOME', 'ROS_LOG_DIR'):
        monkeypatch.delenv(name, raising=False)
    for name, folder in given.items():
        monkeypatch.setenv(name, folder)
    done = run_python(*MODULE)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.endswith(': set ROS_LOG_DIR to a folder that the node may write to')


@pytest.mark.parametrize('command', ['the node', 'play', 'demo'])
def test_missing_ros_is_said_in_one_line(tmp_path, command):
    write_ros2_bag(tmp_path / 'drive.mcap', 1)
    words = [command.split()[-1], *[str(tmp_path / 'drive.mcap')] * (command == 'play')]
    run = f'from gp_ground_seg.cli.main import main; sys.exit(main({words}))'
    done = run_python('-c', f"import sys; sys.modules['rclpy'] = None; {run}")
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert f'{command} needs ROS 2, which cannot be imported' in line
    assert f'pip install {ROS_WHEELS}' in line


NAME = f'{NAMESPACE}/front/filter'
KEYS = {
    '/**:\n  P': True,
    '"**":\n  P': True,
    f'{NAME}:\n  P': True,
    f'{NAME[1:]}:\n  P': True,
    f'{NAMESPACE}:\n  front:\n    filter:\n      P': True,
    f'{NAMESPACE}/front:\n  filter:\n    P': True,
    'patchworkpp_node:\n  P': False,
    'ground_segmentation_node:\n  P': False,  # it has another name
    'filter:\n  P': False,  # and is in a namespace
    f'{NAMESPACE}/filter:\n  P': False,
    f'{NAMESPACE}/front:\n  other:\n    P': False,
    '/**/filter:\n  P': True,
    '/**:\n  filter:\n    P': True,
    '/**/front:\n  P': False,
    '/*/*/filter:\n  P': True,
    '/*/front:\n  filter:\n    P': True,
    f'{NAMESPACE}/*:\n  P': False,
    f'{NAMESPACE}/**:\n  P': True,
    '/*/*/*:\n  P': True,
    '"*/filter":\n  P': False,
    '/*:\n  P': False,
    f'{NAME}/**:\n  P': True,
    f'other:\n  P\n{NAME}:\n  P': True,
}


@pytest.mark.parametrize('text', KEYS)
def test_a_file_is_unused_where_rcl_takes_nothing_of_it(tmp_path, text):
    path = tmp_path / 'keys.yaml'
    path.write_text(text.replace('P', 'ros__parameters: {label: {ground_tolerance: 0.3}}'))
    words = '-r', f'__ns:={NAMESPACE}/front', '-r', '__node:=filter', '--params-file', str(path)
    with ros.started_node(*words) as node:
        assert (node.config.label.ground_tolerance == 0.3) == KEYS[text]
        assert len(unused_files(words, node.get_fully_qualified_name())) == (not KEYS[text])


def test_unused_files_are_warned_of_with_their_keys(tmp_path):
    words = []
    for name, keys in (('a\x1b[2J', ['b', '/c/d']), ('used', ['/**']), ('many', range(13))):
        path = tmp_path / f'{name}.yaml'
        path.write_text(''.join(f'{key}:\n  ros__parameters: {{}}\n' for key in keys))
        words += ['--params-file', str(path)]
    first, last = unused_files([*words, '--params-file', 'gone.yaml'], '/front/filter')
    assert first.startswith(rf'{tmp_path}/a\x1b[2J.yaml: not used: ')
    assert 'those of b, /c/d, and this node is /front/filter' in first
    assert 'those of 0, 1, ' in last and '9, 3 more, and' in last
    (tmp_path / 'a.yaml').write_text(
        'patchworkpp_node:\n  ros__parameters: {sensor.height: 0.5}\n'
    )
    words = *FIXED, '-p', 'runtime.backend:=numpy', '--params-file', str(tmp_path / 'a.yaml')
    with Process(*words, folder=tmp_path) as node:
        node.wait_until_ready('not used')
        (line,) = [line for line in node.log.splitlines() if 'WARN' in line]
        for text in ('a.yaml', 'patchworkpp_node', f'{NAMESPACE}/ground_segmentation_node'):
            assert text in line


@pytest.mark.slow
def test_a_file_as_the_readme_has_it(tmp_path):
    """The block that writes a file of parameters, line for line, but for where the files are."""
    readme = (REPOSITORY / 'README.md').read_text(encoding='utf-8')
    blocks = re.findall(r'```sh\n(.*?)```', readme, re.DOTALL)
    (block,) = [block for block in blocks if 'config dump' in block]
    *commands, node_command = block.splitlines()
    (tmp_path / 'demo_output').mkdir()  # made by `make demo`
    script = f'gp-ground-seg() {{ {sys.executable} -m gp_ground_seg "$@"; }}; set -e\n'
    command = ['bash', '-c', script + '\n'.join(commands)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert 'my.yaml: good; ' in done.stdout
    assert done.stdout.endswith(', 1 differs from the defaults\n')
    program, *words = node_command.split()
    assert program == 'gp-ground-seg'
    words[words.index('demo_output/my.yaml')] = str(tmp_path / 'demo_output' / 'my.yaml')
    words += ['-p', 'grid.n_bins:=55']
    with Process(*words, folder=tmp_path, start=('-m', 'gp_ground_seg')) as node:
        node.wait_until_ready()
        assert 'listening to /velodyne_points' in node.log
        assert 'sensor.height: 1.2 m  (default auto)' in node.log
        assert 'grid.n_bins: 55  (default 80)' in node.log
        assert_good_end(node, signal.SIGINT)


# Signals to the node: it ends with code 0, after the cloud at hand.


def cpu_seconds(pid):
    words = stat_words(pid)
    return (int(words[11]) + int(words[12])) / os.sysconf('SC_CLK_TCK')


def heeds_sigterm(process):
    """Whether the process has a handler of its own."""
    with open(f'/proc/{process.popen.pid}/status', encoding='ascii') as status:
        caught = next(line for line in status if line.startswith('SigCgt:'))
    return bool(int(caught.split()[1], 16) >> (signal.SIGTERM - 1) & 1)


def assert_good_end(node, number):
    code, duration = node.stop(number)
    assert code == 0, node.log
    assert duration < SOON
    assert 'Traceback' not in node.log
    assert 'ERROR' not in node.log


@pytest.mark.parametrize(
    ('start', 'number'), [(ros.ENTRY_POINT, signal.SIGINT), (MODULE, signal.SIGTERM)]
)
def test_while_importing(tmp_path, start, number):
    with Process(*FIXED, folder=tmp_path, start=start) as node:
        wait_for(lambda: heeds_sigterm(node), 'handler')
        assert_good_end(node, number)
        assert 'listening' not in node.log


@pytest.mark.slow
@pytest.mark.skipif(not HAVE_NUMBA, reason='numba is not installed')
@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGKILL])
def test_while_compiling(tmp_path, number):
    """The compiling process ends too, also with a node that is killed."""
    cache = tmp_path / 'cache'
    cache.mkdir(mode=0o700)
    with Process(*FIXED, folder=tmp_path, NUMBA_CACHE_DIR=str(cache)) as node:
        node.wait_until_ready()
        wait_for(lambda: len(children(node.popen.pid)) == 1, 'compiler')
        (compiler,) = children(node.popen.pid)
        wait_for(lambda: cpu_seconds(compiler) > 2.0, 'work')
        if number == signal.SIGTERM:
            assert_good_end(node, number)
        else:
            node.stop(number)
    wait_for(lambda: not is_running(compiler), 'end of the compiler')


@pytest.mark.slow
@pytest.mark.skipif(not HAVE_NUMBA, reason='numba is not installed')
def test_while_compiling_what_no_folder_can_keep(tmp_path):
    """The node compiles in a thread then, for a minute, which nobody waits for."""
    cache = tmp_path / 'cache'
    cache.mkdir()
    cache.chmod(0o777)
    with Process(*FIXED, folder=tmp_path, NUMBA_CACHE_DIR=str(cache)) as node:
        node.wait_until_ready('others can write')
        before = cpu_seconds(node.popen.pid)
        wait_for(lambda: cpu_seconds(node.popen.pid) > before + 2.0, 'work')
        assert_good_end(node, signal.SIGTERM)


def test_under_load(tmp_path):
    """The cloud at hand is the last one; signals that follow do not break the end."""
    message = ros.to_message(ros.street(20_000))
    slow = {'runtime.backend': 'numpy', 'grid.n_segments': 360, 'learning.segment_step': 1}
    with ros.linked_process(tmp_path, *ros.given(slow)) as (node, link):
        for _ in range(6):
            link.publisher.publish(message)
        link.ground.wait(1)
        # A terminal and a launch file both send one.
        for _ in range(2):
            node.popen.send_signal(signal.SIGINT)
        assert_good_end(node, signal.SIGTERM)
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
            assert player.stop(signal.SIGINT)[0] == 130
            assert player.log.splitlines()[-1] == 'gp-ground-seg: interrupted'
        assert_good_end(node, signal.SIGINT)


@pytest.fixture
def alone():
    with ros.isolated():
        yield


STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@pytest.fixture
def handlers():
    """The handlers in use, which are there again after the test."""
    before = {number: signal.getsignal(number) for number in STOPS}
    yield before
    for number, handler in before.items():
        signal.signal(number, handler)


def test_without_a_signal_all_is_as_before_and_an_error_is_an_error(handlers, alone):
    is_passed_on = pytest.raises(RuntimeError, match='mine, False')
    with is_passed_on, stop_on_signals(), stop_on_signals() as stop, ros_session('any'):
        raise RuntimeError(f'mine, {stop.made}')
    assert {number: signal.getsignal(number) for number in STOPS} == handlers


def wait_for_signal(number, wait):
    with ros_session('any') as session:
        for _ in range(2):
            os.kill(os.getpid(), number)  # the second changes nothing
        if wait:
            getattr(session, wait)(*[0.001] * (wait != 'check'))
            pytest.fail('not interrupted')


@pytest.mark.parametrize('number', STOPS)
@pytest.mark.parametrize('wait', ['sleep', 'spin', 'check', 'at the end of the block'])
@pytest.mark.usefixtures('alone', 'heeded_hangup', 'handlers')
def test_a_signal_interrupts_the_next_wait(wait, number):
    with pytest.raises(KeyboardInterrupt):
        wait_for_signal(number, '' if ' ' in wait else wait)


@pytest.mark.usefixtures('alone', 'handlers')
def test_a_hangup_that_is_ignored_stays_so():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with ros_session('any') as session:
        os.kill(os.getpid(), signal.SIGHUP)
        session.sleep(0.001)
