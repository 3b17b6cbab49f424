"""Random valid configurations and values."""

from hypothesis import strategies as st

from gp_ground_seg.config import Config, parameter_specs
from gp_ground_seg.errors import ConfigError


def accepted_values(spec):
    """Strategy of all values a parameter accepts on its own."""
    if spec.choices:
        return st.sampled_from(spec.choices)
    if spec.type is bool:
        return st.booleans()
    if spec.type is int:
        return st.integers(int(spec.minimum), int(spec.maximum))
    return st.floats(spec.minimum, spec.maximum)


@st.composite
def configs(draw):
    """Any valid configuration: random values in random order, those against a rule left out."""
    config = Config()
    for spec in draw(st.permutations(parameter_specs())):
        try:
            config = config.replace(**{spec.name: draw(accepted_values(spec))})
        except ConfigError:
            continue
    return config
