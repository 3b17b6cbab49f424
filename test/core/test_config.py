"""The contract of the configuration: what is accepted, what is refused, and how it is said."""

import contextlib
import copy
import dataclasses
import math
import pickle
import re
from array import array

import numpy as np
import pytest
from config_samples import accepted_values, configs
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg import Config, ConfigError, GroundSegError
from gp_ground_seg.cli.options import parse_setting
from gp_ground_seg.core.parameters.config import find_spec, parameter_specs
from gp_ground_seg.core.parameters.schema import numbers_of

SPECS = parameter_specs()
NUMBERS = [spec for spec in SPECS if spec.type in (int, float)]


def by_name(spec):
    return spec.name


def is_of_declared_type(spec, value):
    no_number = {float: 'auto' if spec.auto else None, tuple: 'none'}
    return type(value) is spec.type or value == no_number.get(spec.type, 0)


@pytest.fixture
def from_text(tmp_path):
    """Configuration read from a file of this text."""

    def read(text):
        path = tmp_path / 'parameters.yaml'
        path.write_text(text, encoding='utf-8')
        return Config.from_yaml(path)

    return read


@pytest.mark.parametrize('spec', SPECS, ids=by_name)
def test_declarations_are_complete(spec):
    assert re.fullmatch(r'[a-z_]+\.[a-z_]+', spec.name)
    assert re.fullmatch('.+', spec.description)
    if spec.type in (int, float):
        assert -math.inf < spec.minimum < spec.maximum < math.inf
        assert spec.choices == ()
    elif spec.type is tuple:
        assert spec.minimum < spec.maximum
    else:
        assert spec.type is bool or spec.choices or spec.name.startswith('frame.')
    default = spec.check(spec.default)
    assert default == spec.default
    assert is_of_declared_type(spec, default)


@pytest.mark.parametrize('spec', NUMBERS, ids=by_name)
def test_numbers_refuse_what_is_none_or_out_of_range(spec):
    words = ['1', 'Auto', 'none', *([] if spec.auto else ['auto'])]
    for value in (math.nan, math.inf, -math.inf, True, False, None, [1], *words):
        with pytest.raises(ConfigError, match=re.escape(f'{spec.name} = {value!r}: must be ')):
            spec.check(value)
    for end, outside in ((spec.minimum, -1), (spec.maximum, 1)):
        end = spec.type(end)
        assert spec.check(end) == end
        beyond = end + outside if spec.type is int else math.nextafter(end, outside * math.inf)
        with pytest.raises(ConfigError) as caught:
            spec.check(beyond)
        message = str(caught.value)
        assert message.startswith(f'{spec.name} = {beyond!r}: must be ')
        assert f'[{spec.minimum:g}, {spec.maximum:g}]' in message
        assert message.endswith(spec.unit)
    with pytest.raises(ConfigError):
        spec.check(10**400)  # beyond what a float can hold
    if spec.auto:
        assert spec.check('auto') == 'auto'
        assert spec.accepted.startswith('auto or a number in [')
    if spec.type is int:
        with pytest.raises(ConfigError, match='an integer'):
            spec.check(float(spec.default))
    else:
        whole = math.ceil(spec.minimum)
        assert whole > spec.maximum or type(spec.check(whole)) is float
        assert type(spec.check(np.float64(spec.minimum))) is float


BOX = -1.0, 0.5, -0.4, 0.4, -0.5, 1.0


def test_a_box_is_six_numbers_or_none():
    spec = find_spec('input.crop_box')
    mixed = '[-1, 0.5, -0.4, 0.4, -0.5, 1]'  # as ros2 param set sends it
    for value in (BOX, list(BOX), np.array(BOX), array('d', BOX), mixed):
        assert spec.check(value) == BOX
    assert spec.check([-1, 1, -2, 2, -3, 3]) == (-1.0, 1.0, -2.0, 2.0, -3.0, 3.0)
    assert spec.check('none') == spec.check([]) == spec.default == 'none'
    swapped = 0.5, -1.0, *BOX[2:]
    for value in (BOX[:5], (*BOX, 1.0), swapped, (*BOX[:5], math.nan), (*BOX[:5], 101.0),
                  (*BOX[:5], True), (*BOX[:5], '1'), 'None', '[1', 1.0, None, True):  # fmt: skip
        with pytest.raises(ConfigError, match=r'^input\.crop_box = .*: must be none or six num'):
            spec.check(value)


def test_groups_given_whole_are_checked_and_converted():
    groups = {field.name: field.default for field in dataclasses.fields(Config)}
    label = dataclasses.replace(groups['label'], ground_tolerance=1)
    assert type(Config(label=label).label.ground_tolerance) is float
    assert label.ground_tolerance == 1
    with pytest.raises(ConfigError, match=r'label\.ground_tolerance'):
        Config(label=dataclasses.replace(groups['label'], ground_tolerance='wide'))


@pytest.mark.parametrize('value', ['', 'two words', 'ümlaut', 'a\n', 1, True, None])
def test_words_are_names_or_choices(value):
    name = find_spec('frame.base')
    with pytest.raises(ConfigError, match='must be a name'):
        name.check(value)
    for good in ('base_link', 'robot_1/base.link-2', '7'):
        assert name.check(good) == good
    for spec in (spec for spec in SPECS if spec.choices):
        for wrong in (value, spec.choices[0].upper()):
            with pytest.raises(ConfigError, match='one of ' + ', '.join(spec.choices)):
                spec.check(wrong)
        assert [spec.check(choice) for choice in spec.choices] == list(spec.choices)
    with pytest.raises(ConfigError, match='must be true or false'):
        find_spec('surface.look_aside').check(1 if value is True else value)


@given(st.sampled_from(SPECS), st.data())
def test_check_accepts_what_is_in_range_and_keeps_it(spec, data):
    value = data.draw(accepted_values(spec))
    assert spec.check(value) == value
    assert spec.check(spec.check(value)) == value


@pytest.mark.parametrize(
    ('name', 'hint'),
    [
        ('label.ground_tolerence', 'label.ground_tolerance'),
        ('ground_tolerance', 'label.ground_tolerance'),
        ('Sensor.height', 'sensor.height'),
        ('grid.rmax', 'grid.r_max'),
    ],
)
def test_unknown_names_come_with_the_nearest(name, hint):
    with pytest.raises(ConfigError, match=rf'unknown parameter .*{hint}\?'):
        Config().replace(**{name: 1.0})
    with pytest.raises(ConfigError, match=hint):
        Config()[name]
    with pytest.raises(ConfigError, match=r"^unknown parameter 'qqqqqq'$"):
        find_spec('qqqqqq')
    with pytest.raises(ConfigError, match=r"'label' is a group of parameters: label\.rule"):
        Config().replace(label=0.2)


@pytest.mark.parametrize(
    ('changes', 'said'),
    [
        ({'grid.r_max': 500.0, 'faces.cell_size': 0.05}, r'faces\.cell_size .* 3\.6 GB.* 2 GB'),
        (
            {'grid.r_min': np.nextafter(50.0, 0.0), 'grid.r_max': 50.0},
            r'first bin .* at least 0\.001 m',
        ),
        ({'grid.n_bins': 1024, 'grid.bin_growth': 3.0}, r'grid\.bin_growth = 3 .* 1\.1e-07 m'),
        *(
            ({lower: wrong, upper: low}, f'^{lower} = {wrong:g}: must be below {upper} = {low:g}$')
            for lower, upper, low, high in (
                ('grid.r_min', 'grid.r_max', 20.0, 30.0),
                ('length_scale.min', 'length_scale.max', 20.0, 60.0),
                ('label.obstacle_min_height', 'label.obstacle_max_height', 3.0, 4.0),
                ('output.min_height', 'output.max_height', 1.0, 2.0),
            )
            for wrong in (low, high)
        ),
    ],
)
def test_values_that_contradict_each_other_are_refused(changes, said):
    with pytest.raises(ConfigError, match=said):
        Config().replace(**changes)


@settings(max_examples=15)
@given(configs(), configs())
def test_forms_agree_and_no_change_but_in_a_copy(config, other):
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.label.ground_tolerance = 1.0
    config.flat()['label.ground_tolerance'] = config.nested()['label']['ground_tolerance'] = 9.0
    flat = config.flat()
    assert config.replace(**other.flat()) == other
    assert config.replace() == config
    assert config.flat() == flat
    assert list(flat) == [spec.name for spec in SPECS]
    assert {f'{g}.{f}': v for g, vs in config.nested().items() for f, v in vs.items()} == flat
    assert all(config[name] == value for name, value in flat.items())
    assert all(is_of_declared_type(find_spec(name), value) for name, value in flat.items())
    assert pickle.loads(pickle.dumps(config)) == copy.deepcopy(config) == config
    assert hash(config) == hash(config.replace())


IN_ROS = '/**:\n  ros__parameters:'
GIVEN = 'label: {ground_tolerance: 0.15}, sensor: {height: 2.0}'
CHANGED = {'label.ground_tolerance': 0.15, 'sensor.height': 2.0}
QOS = 'qos_overrides: {/points: {subscription: {depth: 3}}}'
LAUNCH_ROS = ''.join(f'        - {bound}\n' for bound in BOX)


@pytest.mark.parametrize(
    ('text', 'changes'),
    [
        ('label: {ground_tolerance: 0.15}\nsensor:\n  height: 2\n', CHANGED),
        ('label.ground_tolerance: 0.15\nsensor.height: 2\n', CHANGED),
        (f'{IN_ROS} {{{GIVEN}}}\n', CHANGED),
        (f'{IN_ROS}\n    label.ground_tolerance: 0.15\n    sensor.height: 2\n', CHANGED),
        (f'ground_segmentation_node: {{ros__parameters: {{{GIVEN}}}}}\n', CHANGED),
        (f'/robot/ground_segmentation_node:\n  ros__parameters: {{{GIVEN}}}\n', CHANGED),
        (f'{IN_ROS} {{use_sim_time: true, {QOS}, {GIVEN}}}\n', CHANGED),
        (f'{IN_ROS}\n    input.crop_box: !!python/tuple\n{LAUNCH_ROS}', {'input.crop_box': BOX}),
        *((empty, {}) for empty in ('', '# nothing\n', '{}', f'{IN_ROS} {{}}\n')),
    ],
)
def test_forms_of_files(from_text, text, changes):
    assert from_text(text) == Config().replace(**changes)


@pytest.mark.parametrize('number', ['1e-1', '1E-1', '.1', '.1e0', '1.0e-1', '10e-2', '+0.1'])
def test_numbers_are_read_as_ros_reads_them(from_text, number):
    assert from_text(f'label: {{ground_tolerance: {number}}}').label.ground_tolerance == 0.1


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('label: {ground_tolerence: 1.0}', 'did you mean label.ground_tolerance?'),
        ('label: {ground_tolerance: "0.1"}', "label.ground_tolerance = '0.1': must be a number"),
        ('label: {ground_tolerance: 99.0}', 'must be a number in [0.001, 5] m'),
        ('grid: {n_segments: 90.0}', 'must be an integer in [4, 2048]'),
        ('grid: {n_bins: ' + '1' * 100_000 + '}', 'line 1: a number of 100000 digits'),
        ('grid: {n_bins: 0x' + 'f' * 200_000 + '}', 'line 1: a number of 200002 digits'),
        ('grid: {n_bins: !!int x}', 'not valid YAML: invalid literal'),
        ('grid: {n_bins: 2011-02-03}', 'grid.n_bins = datetime.date(2011, 2, 3): must be an int'),
        ('grid: ' + '[' * 3000, 'not valid YAML: maximum recursion depth'),
        ('\n'.join(f'a{k}: 1' for k in range(2000)), 'more than 500 values'),
        ('/**: {ros__parameters: {}, a: 1}', 'values beside ros__parameters, which ROS refuses'),
        ('grid: &a {n_bins: 9}\nlabel: *a', 'line 2: aliases (*name) are not accepted'),
        ('label:\n  # ground_tolerance: 0.1\n', "'label' is a group of parameters"),
        ('label: {ground_tolerance: {deep: 1.0}}', 'unknown parameter'),
        ('1: 2', "unknown parameter '1'"),
        ('label: {ground_tolerance: 0.1, ground_tolerance: 0.2}', 'ground_tolerance: given twice'),
        ('label: {ground_tolerance: 0.1}\nlabel: {ground_tolerance: 0.1}', 'label: given twice'),
        ('label: {ground_tolerance: 0.1}\nlabel.ground_tolerance: 0.1', 'given twice'),
        ('- label', 'must be a mapping'),
        ('a: [', 'not valid YAML'),
        ('label: {ground_tolerance: 2011-99-99}', 'not valid YAML'),
        ('/**: {label: {ground_tolerance: 0.1}}', 'ros__parameters'),
        ('/a: {ros__parameters: {}}\n/b: {ros__parameters: {}}\n', 'parameters of 2 nodes'),
        ('/**: {ros__parameters: {use_sim_tme: true}}', 'unknown parameter'),
    ],
)
def test_files_that_are_refused(from_text, tmp_path, text, message):
    with pytest.raises(ConfigError) as caught:
        from_text(text)
    said = str(caught.value)
    assert said.startswith(f'{tmp_path / "parameters.yaml"}: ')
    assert message in said
    assert '\n' not in said


def test_files_that_cannot_be_read(tmp_path):
    for path, content in (('missing.yaml', None), ('', None), ('binary.yaml', b'\xff\xfe\x00')):
        if content:
            (tmp_path / path).write_bytes(content)
        with pytest.raises(ConfigError) as caught:
            Config.from_yaml(tmp_path / path)
        assert str(caught.value).startswith(f'{tmp_path / path}: ')
    assert issubclass(ConfigError, GroundSegError)


YAML_ALPHABET = st.sampled_from('{}[]:,-&*!#"\'\n\t ab0.e~%@|>?<=/_\u00e9\0')


@given(st.one_of(st.text(max_size=60), st.text(YAML_ALPHABET, max_size=30)))
def test_any_text_is_read_or_refused(tmp_path_factory, text):
    path = tmp_path_factory.mktemp('yaml') / 'a.yaml'
    path.write_text(text, encoding='utf-8', errors='replace')
    said = f'{path}: '
    with contextlib.suppress(ConfigError):
        parse_setting(f'grid.n_bins={text}')
    try:
        assert Config.from_yaml(path) == Config()
    except ConfigError as error:
        said = str(error)
    assert said.startswith(f'{path}: ')
    assert '\n' not in said


def test_compiled_code_reads_numbers_and_never_words():
    numbers = numbers_of(Config().label)
    assert numbers.ground_tolerance == Config().label.ground_tolerance
    assert pickle.loads(pickle.dumps(numbers)) == numbers and not hasattr(numbers, 'rule')
