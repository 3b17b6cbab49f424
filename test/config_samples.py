"""Random valid configurations and values."""

import contextlib

from hypothesis import strategies as st

from gp_ground_seg.core.errors import ConfigError
from gp_ground_seg.core.parameters.config import Config, parameter_specs


def accepted_values(spec):
    """Strategy of all values a parameter accepts on its own."""
    if spec.choices:
        return st.sampled_from(spec.choices)
    if spec.type is str:
        return st.from_regex(r'[A-Za-z0-9_.-][A-Za-z0-9_./-]{0,19}', fullmatch=True)
    if spec.type is bool:
        return st.booleans()
    if spec.type is tuple:
        bound = st.floats(spec.minimum, spec.maximum)
        side = st.tuples(bound, bound).filter(lambda ab: ab[0] < ab[1])
        boxes = st.tuples(side, side, side).map(lambda sides: sides[0] + sides[1] + sides[2])
        return st.one_of(st.just('none'), boxes)
    if spec.type is int:
        return st.integers(int(spec.minimum), int(spec.maximum))
    numbers = st.floats(spec.minimum, spec.maximum)
    return st.one_of(st.just('auto'), numbers) if spec.auto else numbers


@st.composite
def configs(draw):
    """Any valid configuration: random values, taken one by one where they break a rule."""
    specs = parameter_specs()
    if draw(st.booleans()):
        specs = specs[::-1]  # else the first of two that exclude each other always wins
    values = {spec.name: draw(accepted_values(spec)) for spec in specs}
    config = Config()
    try:
        return config.replace(**values)
    except ConfigError:
        for name, value in values.items():
            with contextlib.suppress(ConfigError):
                config = config.replace(**{name: value})
        return config
