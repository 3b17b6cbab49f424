"""Shared by the commands: options, kinds of values, notes, progress over frames."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml
from tqdm import tqdm

from gp_ground_seg.data.atomic_output import leftovers
from gp_ground_seg.errors import ConfigError
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.parameters.presets import PRESETS, find_preset
from gp_ground_seg.parameters.schema import load_yaml

DEFAULT_PRESET = 'default'


def new_parser(
    subparsers: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    description: str,
    examples: str,
    purpose: str = '',
) -> argparse.ArgumentParser:
    """Return the parser of a command; its texts keep their line breaks."""
    return subparsers.add_parser(
        name,
        help=purpose,
        description=description,
        epilog=f'examples:\n{examples}',
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def positive(word: str) -> int:
    """Whole number, at least 1."""
    number = int(word) if word.isdecimal() else 0
    if number < 1:
        raise argparse.ArgumentTypeError(f'{word!r}: must be a whole number, at least 1')
    return number


def some_of(known: Iterable[str]) -> Callable[[str], list[str]]:
    """Return the type of a comma-separated list of `known` names, each at most once."""
    names = list(known)

    def parse(text: str) -> list[str]:
        words = [word for word in text.split(',') if word]
        unknown = [word for word in words if word not in names]
        if unknown or not words or len(set(words)) < len(words):
            raise argparse.ArgumentTypeError(
                f'{text!r}: must be some of {",".join(names)}, each once'
            )
        return words

    return parse


def add_config_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--preset NAME``, ``--config FILE`` and ``--set NAME=VALUE``."""
    presets = f'parameters of a sensor: {", ".join(PRESETS)} (default: {DEFAULT_PRESET})'
    parser.add_argument('--preset', metavar='NAME', default=DEFAULT_PRESET, help=presets)
    parser.add_argument('--config', metavar='FILE', help='parameter file (YAML), over the preset')
    parser.add_argument(
        '--set', metavar='NAME=VALUE', action='append', default=[], dest='settings',
        help='one parameter, as in --set label.ground_tolerance=0.15 (may be repeated)',
    )  # fmt: skip


def config_from_options(arguments: argparse.Namespace) -> Config:
    """Return the preset, changed by the file, changed by the settings."""
    config = find_preset(arguments.preset).config
    if arguments.config:
        config = Config.from_yaml(arguments.config, config)
    return config.replace(**dict(parse_setting(setting) for setting in arguments.settings))


def parse_setting(setting: str) -> tuple[str, Any]:
    """Split ``NAME=VALUE``; the parameter's own checks come with `Config.replace`."""
    name, separator, text = setting.partition('=')
    if not separator:
        raise ConfigError(f'--set {setting}: must be NAME=VALUE')
    try:
        return name.strip(), load_yaml(text)
    except yaml.YAMLError as error:
        raise ConfigError(f'--set {setting}: {text!r} is not a value') from error


def note(message: str) -> None:
    """Print a line on standard error that is neither result nor error."""
    print(f'gp-ground-seg: note: {message}', file=sys.stderr)


class _NoteHandler(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        note(record.getMessage())


@contextmanager
def library_notes(level: int = logging.INFO) -> Iterator[None]:
    """Print what the library logs, such as that it compiles, as notes within the block."""
    logger = logging.getLogger('gp_ground_seg')
    handler, before = _NoteHandler(), logger.level
    logger.addHandler(handler)
    logger.setLevel(level)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


def note_leftovers(target: Path) -> None:
    """Name unfinished output that earlier runs left beside `target`."""
    for path in leftovers(target):
        note(f'{path} is the unfinished output of another run; delete it if that one was killed')


def count(number: int, noun: str) -> str:
    """Return number and noun, as in ``1 frame``, ``2 frames``."""
    return f'{number} {noun}' if number == 1 else f'{number} {noun}s'


def progress_bar(total: int, *, quiet: bool, title: str) -> tqdm[Any]:
    """Return a progress bar over frames on standard error, silent where that is no terminal."""
    disable = True if quiet else None  # None: where it is no terminal.
    return tqdm(
        total=total, desc=title, unit='frame', file=sys.stderr, disable=disable, leave=False
    )
