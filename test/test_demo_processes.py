"""What a demo leaves running or lying about, and whose answers it scores."""

import signal
import subprocess
import sys
import time

import numpy as np
from bag_samples import cloud, write_ros2_bag
from cli_runner import children, is_running, start
from ros_helpers import PATIENCE

from gp_ground_seg.data.point_cloud2 import decode_cloud, encode_cloud
from gp_ground_seg.ros.probe import NodeProcess, Probe, probe_session, restamped


def wait_until(condition):
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_kill_ends_the_node_and_removes_the_folder(tmp_path):
    with start('demo', '--frames', 500, cwd=tmp_path) as process:
        wait_until(lambda: children(process.pid))
        nodes = children(process.pid)
        wait_until(lambda: [*tmp_path.rglob('*log')])  # in the folder that is to go
        process.send_signal(signal.SIGKILL)
        process.communicate(timeout=PATIENCE)
    assert process.returncode == -signal.SIGKILL
    wait_until(lambda: not any(is_running(pid) for pid in nodes))
    assert list(tmp_path.iterdir()) == []


INTERRUPTED = """
import pathlib, subprocess, sys
from gp_ground_seg.ros.probe import NodeProcess

class Interrupted(subprocess.Popen):
    def __init__(self, *words, **options):
        super().__init__(*words, **options)
        print(self.pid, flush=True)
        raise KeyboardInterrupt

subprocess.Popen = Interrupted
folder = pathlib.Path(sys.argv[1])
NodeProcess(folder / 'log', unfinished=folder).__enter__()
"""


def test_an_interrupt_right_after_the_start_of_the_node_ends_it(tmp_path):
    (tmp_path / 'unfinished').mkdir()
    words = [sys.executable, '-c', INTERRUPTED, str(tmp_path / 'unfinished')]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert 'KeyboardInterrupt' in done.stderr
    wait_until(lambda: not is_running(int(done.stdout)))
    assert list(tmp_path.iterdir()) == []


def test_a_node_that_an_earlier_run_left_does_not_answer(tmp_path):
    """One on the same ROS domain and the topics that a node has by default."""
    with (
        probe_session('probe') as (session, words),
        NodeProcess(tmp_path / 'log', words) as node,
        NodeProcess(tmp_path / 'stranger') as stranger,
    ):
        probe = Probe(session, lambda *_: None)
        probe.connect(node)
        wait_until(stranger.is_settled)
        # It is there, and gets what is sent to it.
        topics = session.node.get_topic_names_and_types
        wait_until(lambda: '/obstacles' in dict(topics()))
        clouds = restamped([decode_cloud(encode_cloud(cloud()))], 1000)
        trips = probe.one_by_one(next(clouds) for _ in range(20))
        end = time.monotonic() + 2.0
        while time.monotonic() < end:
            session.spin(0.05)
        assert np.isfinite([trip.latency for trip in trips]).all()
        assert probe.n_stray == 0


def test_nothing_is_imported_from_the_current_folder(tmp_path, monkeypatch):
    for name in ('numpy', 'yaml', 'rclpy', 'gp_ground_seg'):
        (tmp_path / f'{name}.py').write_text(
            f'open("ran", "w").close(); raise SystemExit({name!r})'
        )
    monkeypatch.chdir(tmp_path)
    with (
        probe_session('probe') as (_, words),
        NodeProcess(tmp_path / 'log', words),
    ):
        wait_until(lambda: 'listening to' in (tmp_path / 'log').read_text())
    assert not (tmp_path / 'ran').exists()


def test_an_interrupt_counts_where_it_is_ignored_at_the_start(tmp_path):
    """As in the background of a script, of a shell without job control."""
    write_ros2_bag(tmp_path / 'drive.mcap')
    words = [sys.executable, '-m', 'gp_ground_seg', 'play', 'drive.mcap', '--loop', '--no-wait']
    script = f'trap "" INT; exec {" ".join(words)}'
    with subprocess.Popen(
        ['sh', '-c', script], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True,
    ) as process:  # fmt: skip
        # It says what it leaves out when it has opened the bag.
        assert process.stderr.readline().startswith('gp-ground-seg: note: not played: /note')
        process.send_signal(signal.SIGINT)
        try:
            _, said = process.communicate(timeout=20.0)
        finally:
            process.kill()
    assert process.returncode == 130
    assert said.splitlines()[-1] == 'gp-ground-seg: interrupted'
