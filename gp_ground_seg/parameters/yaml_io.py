"""Parameter files: YAML in the form of ROS, or of bare groups."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from gp_ground_seg.errors import ConfigError

ROS_NODE_KEY = '/**'
ROS_PARAMETERS_KEY = 'ros__parameters'
OF_EVERY_NODE = ('use_sim_time', 'start_type_description_service')
"""Parameters that every ROS node has."""


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, without two of its surprises (see `load_yaml`)."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Refuse a key that is there twice; the last would win silently."""
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        for key in keys:
            if key != '<<' and keys.count(key) > 1:
                raise ConfigError(f'{key}: given twice, from line {node.start_mark.line + 1} on')
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    'tag:yaml.org,2002:float',
    re.compile(r'^[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$'),
    list('-+.0123456789'),
)


def load_yaml(text: str) -> object:
    """Read YAML, with 1e-3 a number as in ROS; a key given twice raises ConfigError."""
    document: object = yaml.load(text, Loader=_Loader)
    return document


@dataclass(frozen=True)
class ParameterFile:
    """Values of a parameter file by dotted names, unchecked."""

    values: dict[str, object]
    is_ros: bool  # whether it is in the form of ROS, where types are strict


def read_parameters(path: str | Path) -> ParameterFile:
    """Read a parameter file; ConfigError if it cannot be read or parsed, or gives a name twice."""
    try:
        document = load_yaml(Path(path).read_text(encoding='utf-8'))
        values: dict[str, object] = {}
        for name, value in _flatten(_unwrap_ros(document)):
            if name in values:
                raise ConfigError(f'{name}: given twice')
            values[name] = value
        return ParameterFile(values, isinstance(document, Mapping) and _is_ros(document))
    except OSError as error:
        raise ConfigError(error.strerror or str(error)) from error
    except UnicodeDecodeError as error:
        raise ConfigError('not a text file') from error
    except ConfigError:
        raise
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        # A ValueError comes from what looks like a date and is none, as in 2011-99-99.
        raise ConfigError(f'not valid YAML: {" ".join(str(error).split())}') from error


def _unwrap_ros(document: object) -> Mapping[str, object]:
    """Parameters of a ROS parameter file, or of a file of bare groups."""
    if document is None:
        return {}
    if not isinstance(document, Mapping):
        raise ConfigError('must be a mapping of parameter groups')
    if not _is_ros(document):
        return document
    if len(document) != 1:
        raise ConfigError(f'parameters of {len(document)} nodes; keep one, keyed {ROS_NODE_KEY}')
    (node,) = document.values()
    if not isinstance(node, Mapping) or not isinstance(node.get(ROS_PARAMETERS_KEY), Mapping):
        raise ConfigError(f'no mapping {ROS_PARAMETERS_KEY} below the node name')
    parameters: Mapping[str, object] = node[ROS_PARAMETERS_KEY]
    # Names that every ROS node has are no parameters of the segmentation.
    return {
        key: value
        for key, value in parameters.items()
        if key not in OF_EVERY_NODE and not str(key).startswith('qos_overrides')
    }


def _is_ros(document: Mapping[str, object]) -> bool:
    return any(str(key).startswith('/') or _is_ros_node(document[key]) for key in document)


def _is_ros_node(value: object) -> bool:
    return isinstance(value, Mapping) and ROS_PARAMETERS_KEY in value


def _flatten(tree: Mapping[str, object], prefix: str = '') -> Iterator[tuple[str, object]]:
    for key, value in tree.items():
        name = f'{prefix}{key}'
        if isinstance(value, Mapping):
            yield from _flatten(value, f'{name}.')
        else:
            yield name, value
