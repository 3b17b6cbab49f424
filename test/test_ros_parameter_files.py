"""What ``ros2 param dump`` and ``load`` do, through the services of a real node."""

import os

import pytest
import yaml
from config_samples import configs
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip('rclpy', reason='ROS is not installed')

from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters
from rclpy.parameter import parameter_value_to_python
from ros_helpers import bench, isolated_context, parameter_message, spinning, street, to_message

from gp_ground_seg import Config
from gp_ground_seg.parameters.config import parameter_specs
from gp_ground_seg.parameters.export import file_problems
from gp_ground_seg.parameters.presets import PRESETS
from gp_ground_seg.ros.node import GroundSegmentationNode

OWN = [spec.name for spec in parameter_specs()]


@pytest.fixture(scope='module')
def shared_bench():
    with bench() as b:
        yield b


def dump(b):
    """The document that ``ros2 param dump`` writes: all parameters, sorted, nested."""
    names = sorted(
        b.call(ListParameters, 'list_parameters', ListParameters.Request()).result.names
    )
    request = GetParameters.Request(names=names)
    values = b.call(GetParameters, 'get_parameters', request).values
    tree = {}
    for name, value in zip(names, values, strict=True):
        *groups, leaf = name.split('.')
        branch = tree
        for group in groups:
            branch = branch.setdefault(group, {})
        branch[leaf] = parameter_value_to_python(value)
    return {b.node.get_fully_qualified_name(): {'ros__parameters': tree}}


def load(b, values):
    """Results of sending all values at once, in their order, as ``ros2 param load`` does."""
    messages = [parameter_message(name, value) for name, value in values.items()]
    request = SetParameters.Request(parameters=messages)
    return b.call(SetParameters, 'set_parameters', request).results


@settings(max_examples=40, deadline=None)
@given(config=configs(), order=st.permutations(OWN))
def test_any_configuration_can_be_loaded_over_any_other_in_any_order(shared_bench, config, order):
    # Hundreds of threads made and ended for nothing; TF may not be installed.
    plain = {'runtime.n_threads': 1, 'runtime.backend': 'auto', 'frame.level': 'sensor'}
    config = config.replace(**plain)
    values = {name: config[name] for name in order}
    assert all(result.successful for result in load(shared_bench, values))
    assert shared_bench.node.config == config


def test_what_is_dumped_is_what_runs_and_can_be_given_at_start(shared_bench, tmp_path):
    b = shared_bench
    config = PRESETS['vlp16'].config
    assert all(result.successful for result in load(b, config.flat()))
    document = dump(b)
    path = tmp_path / 'dumped.yaml'
    path.write_text(yaml.safe_dump(document))
    # Our own tools read it, use_sim_time, qos_overrides and all.
    assert file_problems(path) == []
    assert Config.from_yaml(path) == config
    (node_name,) = document
    namespace, _, name = node_name.rpartition('/')
    with isolated_context() as context:
        node = GroundSegmentationNode(
            context=context,
            namespace=namespace,
            cli_args=['--ros-args', '-r', f'__node:={name}', '--params-file', str(path)],
        )
        with spinning(context, node):
            assert node.config == config
    assert all(result.successful for result in load(b, Config().flat()))
    assert b.node.config == Config()


def test_one_bad_value_of_a_file_is_refused_and_the_others_taken(shared_bench):
    b = shared_bench
    start = {**Config().flat(), 'grid.r_max': 30.0}
    assert all(result.successful for result in load(b, start))
    # r_min can only come after r_max, which stands behind it.
    asked = {'grid.r_min': 40.0, 'label.ground_tolerance': 9.0, 'grid.r_max': 50.0}
    results = load(b, asked)
    assert [result.successful for result in results] == [True, False, True]
    assert 'label.ground_tolerance = 9.0: must be' in results[1].reason
    assert b.node.config == Config().replace(**{'grid.r_min': 40.0, 'grid.r_max': 50.0})
    assert all(result.successful for result in load(b, Config().flat()))


def test_a_change_at_once_costs_no_cloud(shared_bench):
    b = shared_bench
    message = to_message(street(2000))
    before = len(b.ground.messages)
    for name in ('vlp16', 'paper', 'default'):
        config = PRESETS[name].config
        b.publisher.publish(message)
        assert all(result.successful for result in load(b, config.flat()))
        assert b.node.config == config
    b.ground.wait(before + 3)


@pytest.mark.parametrize('name', PRESETS)
def test_node_starts_with_every_shipped_file(name):
    path = os.path.join(os.path.dirname(__file__), '..', 'config', f'{name}.yaml')
    with isolated_context() as context:
        node = GroundSegmentationNode(
            context=context, cli_args=['--ros-args', '--params-file', path, '-r', '__ns:=/any']
        )
        with spinning(context, node):
            assert node.config == PRESETS[name].config
