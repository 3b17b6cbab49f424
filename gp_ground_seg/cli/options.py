"""Shared by the commands: options, kinds of values, progress over frames."""

from __future__ import annotations

import argparse
import sys
import textwrap
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from tqdm import tqdm

from gp_ground_seg.core.errors import LOGGER, ConfigError, DataError, in_thousands
from gp_ground_seg.core.jit import has_to_compile
from gp_ground_seg.core.parameters.config import PRESETS, Config, find_preset
from gp_ground_seg.core.parameters.schema import load_yaml
from gp_ground_seg.data.cloud_files import KITTI_COLUMNS, MIN_COLUMNS
from gp_ground_seg.data.inputs import Inputs, list_inputs
from gp_ground_seg.lab.cluster import Runner, open_runner

DEFAULT_PRESET = 'default'
COMPILING_PAYS = 300  # scans
WIDTH = 79  # of the texts of help
LINE_PERIOD = 30.0  # time between lines of progress where there is no terminal [s]
BAR = '{desc} |{bar}| {n_fmt} of {total_fmt} frames done, {remaining} left'
Subparsers: TypeAlias = 'argparse._SubParsersAction[argparse.ArgumentParser]'
Option = tuple[str, str, dict[str, Any]]
"""Names of an option, its help, and what else `add_argument` takes."""
FLAG = {'action': 'store_true'}
FORCE = ('--force', 'replace existing output', FLAG)
MARKDOWN = ('--markdown', 'print the tables as Markdown', FLAG)
QUIET = ('--quiet', 'no progress bar, no notes', FLAG)
TO_JSON = ('--json', 'write every number to this file as well', {'metavar': 'FILE'})


def command(
    subparsers: Subparsers,
    name: str,
    description: str,
    examples: str,
    *options: Option | list[Option],
    purpose: str = '',
    **defaults: Any,
) -> argparse.ArgumentParser:
    """Declare a command; paragraphs are filled, examples keep their line breaks.

    Of options in a list only one may be given. `defaults` are values of the parsed arguments.
    """
    paragraphs = (textwrap.fill(part, WIDTH) for part in description.split('\n\n'))
    parser = subparsers.add_parser(
        name,
        help=purpose,
        description='\n\n'.join(paragraphs),
        epilog=f'examples:\n{examples}',
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(**defaults)
    for entry in options:
        group = parser if isinstance(entry, tuple) else parser.add_mutually_exclusive_group()
        for names, text, more in [entry] if isinstance(entry, tuple) else entry:
            group.add_argument(*names.split(), help=text, **more)
    return parser


def value(read: Callable[[str], Any], accepts: Callable[[Any], Any], wanted: str) -> Any:
    """Return the type of an option: what `read` makes of its text, if that is accepted."""

    def parse(text: str) -> Any:
        with suppress(ValueError):
            if accepts(found := read(text)):
                return found
        raise argparse.ArgumentTypeError(f'{text!r}: must be {wanted}')

    return parse


def whole(least: int) -> dict[str, Any]:
    """Return what `add_argument` takes of a whole number."""
    wanted = f'a whole number, at least {least}'
    read = value(lambda t: int(t) if t.isdecimal() else -1, lambda n: n >= least, wanted)
    return {'metavar': 'N', 'type': read}


def some_of(known: Iterable[str]) -> Any:
    """Return the type of a comma-separated list of `known` names, each at most once."""
    names = list(known)
    wanted = f'some of {",".join(names)}, each once'
    return value(lambda t: t.split(','), lambda w: len({*w} & {*names}) == len(w), wanted)


NUMBER = whole(1)
COLUMNS: Option = (
    '--columns', f'numbers per point of a .bin scan, x y z first (default: {KITTI_COLUMNS})',
    whole(MIN_COLUMNS),
)  # fmt: skip
"""Option of every command that reads ``.bin`` scans."""
CLOUDS: tuple[Option, ...] = (
    ('--topic', 'PointCloud2 topic of a bag (default: the only one)', {'metavar': 'T'}),
    COLUMNS,
)
"""Options of every command that reads clouds of any format."""
CLUSTER: list[Option] = [
    ('--workers', 'compute in N processes of this machine', NUMBER),
    ('--scheduler', 'compute on the Dask cluster of this scheduler, as in tcp://HOST:8786',
     {'metavar': 'ADDRESS'}),
]  # fmt: skip
"""Options of `runner`."""
CONFIG: tuple[Option, ...] = (
    ('--preset', f'set of parameters: {", ".join(PRESETS)} (default: {DEFAULT_PRESET})',
     {'metavar': 'NAME', 'default': DEFAULT_PRESET}),
    ('--config', 'parameter file (YAML), over the preset', {'metavar': 'FILE'}),
    ('--set', 'one parameter, as in --set label.ground_tolerance=0.15 (may be repeated)',
     {'metavar': 'NAME=VALUE', 'action': 'append', 'default': [], 'dest': 'settings'}),
)  # fmt: skip
"""Options of `read_config`."""


def list_clouds(arguments: argparse.Namespace, source: Path | None = None) -> Inputs:
    """Return the clouds of the input or another `source`; DataError if ``--frame`` is none."""
    found = list_inputs(source or arguments.input, columns_of(arguments), arguments.topic)
    if found.topic is not None or not any(scan.path.suffix == '.bin' for scan in found):
        refuse(arguments, ['columns'], f'is for .bin scans, which {found.path} is not')
    frame = getattr(arguments, 'frame', None)
    if frame is not None and not 0 <= frame < len(found):
        raise DataError(f'--frame {frame}: must be 0 to {len(found) - 1} here')
    return found


def columns_of(arguments: argparse.Namespace) -> int:
    """Return the numbers of a point in ``.bin`` scans."""
    return int(arguments.columns or KITTI_COLUMNS)


def refuse(arguments: argparse.Namespace, names: Iterable[str], reason: str) -> None:
    """Raise a DataError for the first of some options that is given."""
    for name in names:
        if vars(arguments).get(name) is not None:
            raise DataError(f'--{name.replace("_", "-")}: {reason}')


def runner(arguments: argparse.Namespace, title: str) -> AbstractContextManager[Runner]:
    """Return a runner of blocks of frames by the options `CLUSTER`, with a bar."""
    bar = progress(title, quiet=getattr(arguments, 'quiet', False))
    return open_runner(arguments.workers, arguments.scheduler, bar)


def read_config(arguments: argparse.Namespace) -> Config:
    """Return the preset, changed by the file, changed by the settings."""
    config = find_preset(arguments.preset).config
    if arguments.config:
        config = Config.from_yaml(arguments.config, config)
    return config.replace(**dict(parse_setting(setting) for setting in arguments.settings))


def spare_compiling(config: Config, n_scans: int) -> Config:
    """Return parameters with the backend that is done first, where `config` leaves it open.

    Compiling takes about as long as `COMPILING_PAYS` scans take longer with numpy: 30 s, and 0.1 s
    each.
    """
    if config.runtime.backend != 'auto' or n_scans >= COMPILING_PAYS or not has_to_compile():
        return config
    return config.replace(**{'runtime.backend': 'numpy'})


def note_spared(given: Config, used: Config) -> None:
    """Say how to have compiled code, where `spare_compiling` has done without."""
    if used.runtime != given.runtime:
        LOGGER.info('segmented with numpy; to have compiled code, run gp-ground-seg warm-up once')


def parse_setting(setting: str) -> tuple[str, Any]:
    """Split ``NAME=VALUE``; the parameter's own checks come with `Config.replace`."""
    name, separator, text = setting.partition('=')
    if not separator:
        raise ConfigError(f'--set {setting}: must be NAME=VALUE')
    try:
        return name.strip(), load_yaml(text)
    except ConfigError as error:
        raise ConfigError(f'--set {name}: {error}') from error


def count(number: int, noun: str) -> str:
    """Return number and noun, as in ``1 frame``, ``2 000 frames``."""
    return f'{in_thousands(number)} {noun}{"" if number == 1 else "s"}'


def progress(title: str, *, quiet: bool = False) -> partial[tqdm[Any]]:
    """Progress of items, or of a `total`, on standard error; in a file every half minute."""
    own = {'desc': title, 'file': sys.stderr, 'disable': quiet, 'leave': False, 'bar_format': BAR}
    if not sys.stderr.isatty():
        own |= dict.fromkeys(('mininterval', 'maxinterval', 'delay'), LINE_PERIOD)
    return partial(tqdm, **own)
