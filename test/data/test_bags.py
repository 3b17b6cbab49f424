"""Bags: every kind in, rosbag2 out, whole or not at all."""

import sys

import bag_samples as samples
import pytest
from rosbags.highlevel import AnyReader

from gp_ground_seg.core.errors import DataError, MissingDependencyError
from gp_ground_seg.data import bags
from gp_ground_seg.data.inputs import holds_bag

NAMES = 'drive', 'drive.mcap', 'drive.db3'


@pytest.mark.parametrize('name', NAMES)
def test_messages_come_back_bit_for_bit(tmp_path, name):
    path = tmp_path / name
    written = samples.write_ros2_bag(path, silent=('/silent',))
    assert holds_bag(path)
    with bags.BagReader(path) as bag:
        clouds = dict.fromkeys(('/points', '/silent'), bags.POINT_CLOUD2)
        assert bag.topics == {**clouds, '/note': 'std_msgs/msg/String'}
        assert bag.n_messages('/points') == 3
        # A topic that was never published on does not make the choice unclear.
        assert bag.pick_point_cloud_topic() == '/points'
        with pytest.raises(DataError, match='no message on /silent'):
            bag.pick_point_cloud_topic('/silent')
        assert list(bag.messages()) == written
        assert list(bag.messages(['/note'])) == written[::2]
    if path.is_dir():
        assert {one.name for one in path.rglob('*')} == {'drive.mcap', 'metadata.yaml'}
        assert bags.is_bag_folder(path)
        assert 'partial' not in (path / 'metadata.yaml').read_text()
    # AnyReader compares the stored hash of each type with that of the stored definition.
    with AnyReader([path]) as bag:
        assert bag.message_count == 6
        (connection,) = [c for c in bag.connections if c.topic == '/points']
        assert connection.ext.offered_qos_profiles == []  # ros2 bag play offers it reliably
        *_, raw = next(bag.messages([connection]))
        assert bag.deserialize(raw, bags.POINT_CLOUD2).header.frame_id == 'velo_link'


def test_clouds_of_ros1(tmp_path):
    """A definition of another topic that cannot be parsed does not matter."""
    path = tmp_path / 'drive.bag'
    samples.write_ros1_bag(path)
    path.write_bytes(path.read_bytes().replace(b'float64 value', b'float64 **** '))
    with bags.BagReader(path) as bag:
        topic = bag.pick_point_cloud_topic()
        assert list(bag.messages([topic])) == [
            (topic, samples.START + k * samples.PERIOD, bags.encode_cloud(samples.cloud(k)))
            for k in range(3)
        ]
        assert bag.topics['/odd'] == 'my_msgs/msg/Odd, ros1'
        assert bag.n_messages('/text') == 6  # of two publishers


def test_the_topic_is_chosen_and_what_a_folder_lacks_is_noticed(tmp_path):
    path = tmp_path / 'two'
    samples.write_ros2_bag(path, topics=('/front', '/rear'))
    with bags.BagReader(path) as bag:
        with pytest.raises(DataError, match='choose one with --topic: /front, /rear'):
            bag.pick_point_cloud_topic()
        assert bag.pick_point_cloud_topic('/rear') == '/rear'
        with pytest.raises(DataError, match=r'no topic /left; topics here: /front \('):
            list(bag.messages(['/left']))
        with pytest.raises(DataError, match=r'topic /note; .*, /note \(std_msgs/msg/String\)'):
            bag.pick_point_cloud_topic('/note')
    (path / 'metadata.yaml').unlink()
    with pytest.raises(DataError, match=r'no metadata\.yaml in it\).*one by one: two\.mcap$'):
        samples.read_messages(path)
    samples.write_ros2_bag(tmp_path / 'a.db3')
    (tmp_path / 'a.db3-wal').write_bytes(b'left by a crash')
    with pytest.raises(DataError, match=r'was not closed, some of it is in a\.db3-wal'):
        samples.read_messages(tmp_path / 'a.db3')


def test_errors_of_the_caller_pass_unchanged(tmp_path):
    samples.write_ros2_bag(tmp_path / 'drive.mcap')
    with bags.BagReader(tmp_path / 'drive.mcap') as bag:
        messages = bag.messages()
        next(messages)
        with pytest.raises(KeyError, match='mine'):
            messages.throw(KeyError('mine'))


@pytest.mark.parametrize('name', ['home', 'file', 'folder.mcap'])
def test_what_is_no_bag_is_never_replaced(tmp_path, name):
    """Also where it appears while the bag is written."""
    bag = bags.new_bag(tmp_path / name, {}, force=True)
    bag.__enter__()
    for folder in ('home', 'folder.mcap'):
        (tmp_path / folder).mkdir()
    for file in ('home/thesis.tex', 'home/metadata.yaml', 'file'):
        (tmp_path / file).write_text('years of work')
    files = {*tmp_path.rglob('[!.]*')} - {*tmp_path.glob('.*/**/*')}
    with pytest.raises(DataError, match='not replaced'):
        bag.__exit__(None, None, None)
    with pytest.raises(DataError, match='not replaced'):
        bags.new_bag(tmp_path / name, {}, force=True).__enter__()
    assert {*tmp_path.rglob('*')} == files
    assert (tmp_path / 'file').read_text() == 'years of work'


@pytest.mark.parametrize(
    'call', [bags.BagReader, lambda path: bags.new_bag(path, {}).__enter__(), bags.decode_cloud]
)
def test_without_rosbags_the_error_says_what_to_install(monkeypatch, call):
    bags.jazzy_types.cache_clear()
    monkeypatch.setitem(sys.modules, 'rosbags', None)
    monkeypatch.delitem(sys.modules, 'rosbags.highlevel')
    with pytest.raises(MissingDependencyError, match='pip install rosbags'):
        call('drive.mcap')
