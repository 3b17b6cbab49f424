"""The scripts of examples/, as a researcher or a robot engineer runs them."""

import re
import signal
import sys

import numpy as np
import pytest
from conftest import REPOSITORY, hilly_scan, load_script
from evaluation_samples import write_streets

from gp_ground_seg import Config, ConfigError, GroundSegmenter

pytestmark = pytest.mark.usefixtures('compiled_code')


def test_labels_are_scored_by_presets(tmp_path, capsys):
    load_script('examples/score_my_labels.py').main(write_streets(tmp_path, s00=1, s08=1), '00')
    paper, default = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r'paper: ground IoU \d+\.\d\d%', paper)
    assert float(default.split()[-1][:-1]) > 85.0


def test_a_folder_without_its_ground(tmp_path, capsys):
    source, target = tmp_path / 'in', tmp_path / 'out'
    source.mkdir()
    xyz = hilly_scan(3000).astype(np.float32)
    np.save(source / 'a.npy', xyz)
    load_script('examples/remove_ground.py').main(source, target)
    result = GroundSegmenter().segment(xyz)
    rows = np.load(target / 'a.npy')
    np.testing.assert_array_equal(rows[:, :3], xyz[~result.is_ground])
    assert f'a {result!r}' in capsys.readouterr().out


def test_the_figure_of_a_segment_and_another_kernel(tmp_path, capsys):
    scan, picture = tmp_path / 'a.npy', tmp_path / 'a.png'
    np.save(scan, hilly_scan().astype(np.float32))
    load_script('examples/paper_figure.py').main(scan, '90', picture, 'default')
    assert re.fullmatch(r'segment 90: \d+ inliers, \d+ pseudo-inputs\n', capsys.readouterr().out)
    assert picture.stat().st_size > 10_000
    other = load_script('examples/other_kernel.py')
    other.LEAST = 20
    other.main(scan)
    apart = re.search(r'surfaces (\d\.\d+) m apart; deviation \d\.', capsys.readouterr().out)
    assert 0.0 < float(apart[1]) < 0.5


def test_a_subscriber_hears_the_nearest_obstacle(tmp_path):
    pytest.importorskip('rclpy', reason='ROS is not installed')
    import ros_helpers as ros
    from rclpy.node import Node
    from sensor_msgs.msg import PointCloud2

    points = ros.street(50)
    points['x'], points['y'] = 9.0, 0.0
    points['x'][7], points['y'][7] = 0.0, 3.0
    command = [sys.executable, str(REPOSITORY / 'examples' / 'nearest_obstacle.py')]
    with (
        ros.Process(
            folder=tmp_path, command=[*command, '--ros-args', '-r', '__ns:=/ex']
        ) as example,
        ros.isolated_context() as context,
    ):
        node = Node('sender', context=context, namespace='/ex')
        publisher = node.create_publisher(PointCloud2, 'obstacles', 5)
        ros.wait_for(publisher.get_subscription_count, 'subscription')
        publisher.publish(ros.to_message(points))
        ros.wait_for(lambda: 'away' in example.log, 'line on an obstacle')
        assert '3.00 m away, 90 degrees to the left' in example.log
        assert example.stop(signal.SIGINT) == 0


def test_parameters_by_whatever_names_them(tmp_path):
    path = tmp_path / 'mine.yaml'
    path.write_text('sensor: {height: 1.73}\n')
    expected = Config().replace(**{'sensor.height': 1.73})
    for words, values in (((expected,), {}), ((str(path),), {}), ((), {'sensor_height': 1.73})):
        assert GroundSegmenter(*words, **values).config == expected
    mixed = GroundSegmenter('paper', sensor_height=2.0).config
    assert mixed == Config.preset('paper').replace(**{'sensor.height': 2.0})
    for words, values, says in (
        (('papr',), {}, 'did you mean paper?'),
        ((), {'sensor_heigth': 1.0}, 'sensor_heigth; did you mean sensor_height?'),
        ((), {'sensor_height': 99.0}, 'sensor.height'),
        (('nowhere.yaml',), {}, 'nowhere.yaml'),
    ):
        with pytest.raises(ConfigError, match=re.escape(says)):
            GroundSegmenter(*words, **values)
