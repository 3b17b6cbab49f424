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
from config_samples import configs
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg import Config, ConfigError, GroundSegmenter
from gp_ground_seg.cli.options import parse_setting
from gp_ground_seg.core.parameters.config import config_of, parameter_specs
from gp_ground_seg.core.parameters.schema import flatten, numbers_of

SPECS = parameter_specs()
NUMBERS = [spec for spec in SPECS if spec.type in (int, float)]


def by_name(spec):
    return spec.name


def is_of_declared_type(spec, value):
    no_number = {float: 'auto' if spec.auto else None, tuple: 'none'}
    return type(value) is spec.type or value == no_number.get(spec.type, 0)


@pytest.mark.parametrize('spec', SPECS, ids=by_name)
def test_declarations_are_complete_and_what_is_in_range_is_kept(spec):
    assert re.fullmatch(r'[a-z_]+\.[a-z_]+', spec.name) and re.fullmatch('.+', spec.description)
    default = spec.check(spec.default)
    assert default == spec.default and is_of_declared_type(spec, default)
    good = [*spec.choices, *['auto'] * spec.auto]
    if spec.type in (int, float):
        assert -math.inf < spec.minimum < spec.maximum < math.inf
        good += [spec.type(spec.minimum), spec.type(spec.maximum)]
        good += [n for n in [math.ceil(spec.minimum)] if n <= spec.maximum]
    else:
        assert spec.type in (bool, tuple) or spec.choices or spec.name.startswith('frame.')
    for value in good:
        assert spec.check(value) == value and is_of_declared_type(spec, spec.check(value))


@pytest.mark.parametrize('spec', NUMBERS, ids=by_name)
def test_numbers_refuse_what_is_none_or_out_of_range(spec):
    words = ['1', 'Auto', 'none', *([] if spec.auto else ['auto'])]
    is_int = spec.type is int
    below, above = (
        end + aside if is_int else math.nextafter(end, aside * math.inf)
        for end, aside in ((spec.minimum, -1), (spec.maximum, 1))
    )
    for value in (math.nan, math.inf, -math.inf, True, None, [1], below, above, *words,
                  *[float(spec.minimum)] * is_int):  # fmt: skip
        with pytest.raises(ConfigError) as caught:
            spec.check(value)
        said = str(caught.value)
        assert said.startswith(f'{spec.name} = {value!r}: must be ')
        assert said.endswith(f'[{spec.minimum:g}, {spec.maximum:g}] {spec.unit}'.rstrip())
        assert ('an integer' in said, 'auto or' in said) == (is_int, spec.auto)
    with pytest.raises(ConfigError):
        spec.check(10**400)  # beyond what a float can hold


BOX = -1.0, 0.5, -0.4, 0.4, -0.5, 1.0


def test_a_box_is_six_numbers_or_none():
    spec = Config.find_spec('input.crop_box')
    mixed = '[-1, 0.5, -0.4, 0.4, -0.5, 1]'  # as ros2 param set sends it
    for value in (BOX, list(BOX), np.array(BOX), array('d', BOX), mixed):
        assert spec.check(value) == BOX
    assert spec.check([-1, 1, -2, 2, -3, 3]) == (-1.0, 1.0, -2.0, 2.0, -3.0, 3.0)
    assert spec.check('none') == spec.check([]) == spec.default == 'none'


WORD, CHOICE, SWITCH, CROP = 'frame.base', 'label.rule', 'surface.look_aside', 'input.crop_box'
NO_WORDS = '', 'two words', 'ümlaut', 'a\n', '/base', 1, True, None
LIMITS = [
    ('grid.r_min', 'grid.r_max', 20.0, 30.0),
    ('length_scale.min', 'length_scale.max', 20.0, 60.0),
    ('label.obstacle_min_height', 'label.obstacle_max_height', 3.0, 4.0),
    ('output.min_height', 'output.max_height', 1.0, 2.0),
]
REFUSED = [
    *(({WORD: word}, '= .*: must be a name that does not begin with /$') for word in NO_WORDS),
    *(({CHOICE: word}, ': must be one of roughness, tol') for word in (*NO_WORDS, 'Roughness')),
    *(({SWITCH: value}, ': must be true or false') for value in (1, 'true', None)),
    *(
        ({CROP: box}, r'^input\.crop_box = .*: must be none or six num')
        for box in (BOX[:5], (*BOX, 1.0), (0.5, -1.0, *BOX[2:]), (*BOX[:5], math.nan),
                    (*BOX[:5], 101.0), (*BOX[:5], True), (*BOX[:5], '1'),
                    'None', '[1', 1.0, None, True)
    ),
    ({'label.ground_tolerence': 1.0}, r'unknown parameter .*label\.ground_tolerance\?'),
    ({'ground_tolerance': 1.0}, r'unknown parameter .*label\.ground_tolerance\?'),
    ({'Sensor.height': 1.0}, r'unknown parameter .*sensor\.height\?'),
    ({'grid.rmax': 1.0}, r'unknown parameter .*grid\.r_max\?'),
    ({'qqqqqq': 1.0}, "^unknown parameter 'qqqqqq'$"),
    ({'sensr': {}}, r'unknown parameter .*sensor\.'),
    ({'label': 0.2}, r"'label' is a group of parameters: label\.rule"),
    ({'grid.r_min': np.nextafter(50, 0), 'grid.r_max': 50.0}, r'first bin .* at least 0\.001 m'),
    ({'grid.n_bins': 1024, 'grid.bin_growth': 3.0}, r'grid\.bin_growth = 3 .* 1\.1e-07 m'),
    *(
        ({lower: wrong, upper: low}, f'^{lower} = {wrong:g}: must be below {upper} = {low:g}$')
        for lower, upper, low, high in LIMITS
        for wrong in (low, high)
    ),
]  # fmt: skip


@pytest.mark.parametrize(('changes', 'said'), REFUSED)
def test_what_is_refused_and_what_is_said(changes, said):
    with pytest.raises(ConfigError, match=said):
        Config().replace(**changes)
    for good in ('base_link', 'robot_1/base.link-2', '7'):
        assert Config.find_spec(WORD).check(good) == good


NESTED = {'sensor': {'height': 1.5}, 'grid': {'n_bins': 90, 'r_max': 40}}
IN_GROUPS = [
    lambda groups: Config(**groups),
    lambda groups: Config().replace(**groups),
    config_of,
    lambda groups: config_of({'/**': {'ros__parameters': groups}}),
    lambda groups: GroundSegmenter(groups).config,
]


@pytest.mark.parametrize('make', IN_GROUPS)
def test_groups_may_be_mappings_as_in_a_file(make):
    flat = {'sensor.height': 1.5, 'grid.n_bins': 90, 'grid.r_max': 40.0}
    assert make(NESTED) == Config().replace(**flat)
    assert make({'sensor': {}}) == Config()
    for wrong, said in (
        ({'sensor': {'hight': 1.5}}, 'did you mean sensor.height?'),
        ({'sensor': {'height': 'high'}}, "sensor.height = 'high': must be auto or a number"),
        ({'sensor': 1.5}, 'sensor'),
    ):
        with pytest.raises(ConfigError, match=re.escape(said)):
            make(wrong)


def test_groups_given_whole_are_checked_and_converted():
    label = dataclasses.replace(Config().label, ground_tolerance=1)
    assert type(Config(label=label).label.ground_tolerance) is float
    with pytest.raises(ConfigError, match=r'label\.ground_tolerance'):
        Config(label=dataclasses.replace(label, ground_tolerance='wide'))
    with pytest.raises(ConfigError, match=r'^sensor = LabelConfig.*: must be a mapping'):
        Config(sensor=label)


@settings(max_examples=15)
@given(configs(), configs())
def test_forms_agree_and_no_change_but_in_a_copy(config, other):
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.label.ground_tolerance = 1.0
    config.nested()['label']['ground_tolerance'] = 9.0
    flat = flatten(config.nested())
    assert config.replace(**flatten(other.nested())) == other
    assert config.replace() == config.replace(sensor={}) == config
    assert flatten(config.nested()) == flat
    assert list(flat) == [spec.name for spec in SPECS]
    nested = config.nested()
    for name, value in flat.items():
        group, field = name.split('.')
        assert config[name] == nested[group][field] == value
        assert is_of_declared_type(Config.find_spec(name), value)
    assert pickle.loads(pickle.dumps(config)) == copy.deepcopy(config) == config
    assert hash(config) == hash(config.replace())


IN_ROS = '/**:\n  ros__parameters:'
GIVEN = 'label: {ground_tolerance: 0.15}, sensor: {height: 2.0}'
CHANGED = {'label.ground_tolerance': 0.15, 'sensor.height': 2.0}
QOS = 'qos_overrides: {/points: {subscription: {depth: 3}}}'
LAUNCH_ROS = ''.join(f'        - {bound}\n' for bound in BOX)


READ = [
    ('label: {ground_tolerance: 0.15}\nsensor:\n  height: 2\n', CHANGED),
    ('label.ground_tolerance: 0.15\nsensor.height: 2\n', CHANGED),
    (f'{IN_ROS} {{{GIVEN}}}\n', CHANGED),
    (f'{IN_ROS}\n    label.ground_tolerance: 0.15\n    sensor.height: 2\n', CHANGED),
    (f'ground_segmentation_node: {{ros__parameters: {{{GIVEN}}}}}\n', CHANGED),
    (f'/robot/ground_segmentation_node:\n  ros__parameters: {{{GIVEN}}}\n', CHANGED),
    (f'{IN_ROS} {{use_sim_time: true, {QOS}, {GIVEN}}}\n', CHANGED),
    (f'{IN_ROS}\n    input.crop_box: !!python/tuple\n{LAUNCH_ROS}', {'input.crop_box': BOX}),
    *((empty, {}) for empty in ('', '# nothing\n', '{}', f'{IN_ROS} {{}}\n')),
    *(
        (f'observation: {{slope_std: {number}}}', {'observation.slope_std': 0.1})
        for number in ['1e-1', '1E-1', '.1', '.1e0', '10e-2', '+0.1', '0x1.999999999999ap-4']
    ),
    *((f'grid.n_bins: {n}', {'grid.n_bins': 64}) for n in ('0x40', '0100', '+64', '!!float 64')),
    *((f'sensor.height: {n}', {'sensor.height': 0.5}) for n in ('0x1p-1', '0X.8', '!!int 0.5')),
    *((f'sensor.height: {word}', {'sensor.height': 'auto'}) for word in ('"auto"', '!!str auto')),
    *((f'surface.look_aside: {word}', {'surface.look_aside': False}) for word in ('n', 'Off')),
    *((f'frame.base: {word}', {'frame.base': word}) for word in ('2026-11-28', '1_80', 'nul')),
    (f'front:\n  ground_segmentation_node: {{ros__parameters: {{{GIVEN}}}}}', CHANGED),
    (
        f'{IN_ROS} {{sensor.height: 1.0}}\nother: {{ros__parameters: {{a: [1, 2]}}}}\n'
        f'front:\n  ground_segmentation_node: {{ros__parameters: {{{GIVEN}}}}}',
        CHANGED,
    ),
]
NO_HEIGHTS = {
    '.inf': 'inf', '-.Inf': '-inf', 'NaN': 'nan', 'yes': 'True', '0x1p9': '512.0', '~': "'~'",
    '!!float "1.0"': "'1.0'", '1,5': "'1,5'", '!!timestamp 2001-01-01': "'2001-01-01'",
}  # fmt: skip
VERDICTS = [
    *READ,
    ('label: {ground_tolerance: "0.1"}', "label.ground_tolerance = '0.1': must be a number"),
    *(
        ('grid: {n_bins: ' + digits + '}', ': must be an integer in [4, 1024]')
        for digits in ('1' * 100_000, '0x' + 'f' * 200)
    ),
    *(
        (f'grid.n_bins: {word}', f"grid.n_bins = '{word}': must be an integer")
        for word in ('1_80', '1:20', '0b1000000', '0o100', '2011-02-03', 'x', '190:20:30')
    ),
    *(
        (f'sensor.height: {word}', f'sensor.height = {value}: must be auto or a number in [-5')
        for word, value in NO_HEIGHTS.items()
    ),
    ('grid.n_bins: 08', 'grid.n_bins = 8.0: must be an integer'),
    ('sensor.height: 0x1p9999', 'not valid YAML: hexadecimal value too large'),
    ('a: 1\n---\nb: 2', 'not valid YAML: expected a single document'),
    ('label:\n\tground_tolerance: 0.1', "'\\t'"),
    (f'{IN_ROS} {{input.crop_box: [-1, 0.3, -0.4, 0.4, -1, 0.2]}}', 'for ROS: write -1.0'),
    (f'{IN_ROS} {{input.crop_box: [0.0, 3, true]}}', 'input.crop_box = [0.0, 3, True]: must ha'),
    (f'{IN_ROS} {{input.crop_box: [[0.0, 3.0]]}}', '[[0.0, 3.0]]: must have one type for ROS'),
    (f'{IN_ROS} {{input.crop_box: []}}', 'input.crop_box = []: ROS does not read an empty'),
    (f'{IN_ROS} {{use_sim_time: 1}}', 'use_sim_time = 1: must be true or false'),
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
    ('? [a]\n: 1', 'not valid YAML'),
    ('/**: {label: {ground_tolerance: 0.1}}', 'ros__parameters'),
    ('/a: {ros__parameters: {}}\n/b: {ros__parameters: {}}\n', 'parameters of node /a, /b; mus'),
    ('/**: {ros__parameters: {use_sim_tme: true}}', 'unknown parameter'),
    ('/other: {ros__parameters: {}}', 'parameters of node /other; must be of /** or'),
    (b'\xff\xfe\x00', 'not a text file'),
    (None, 'No such file'),
]


@pytest.mark.parametrize(('content', 'verdict'), VERDICTS)
def test_what_is_read_of_a_file_or_why_it_is_refused(tmp_path, content, verdict):
    path = tmp_path / 'parameters.yaml'
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    if isinstance(verdict, dict):
        assert Config.from_yaml(path) == Config().replace(**verdict)
        assert GroundSegmenter(path).config == Config.from_yaml(path)
        assert Config.problems_of_file(path) == []
        return
    with pytest.raises(ConfigError) as caught:
        Config.from_yaml(path)
    said = str(caught.value)
    assert said.startswith(f'{path}: ') and verdict in said and '\n' not in said


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
