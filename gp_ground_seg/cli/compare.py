"""``compare``: two configurations on the same frames."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

from gp_ground_seg.cli import options
from gp_ground_seg.cli.evaluate import OF_FRAMES, frames_from_options, staged_options
from gp_ground_seg.cli.segment import find_scans
from gp_ground_seg.data.atomic_output import staged_files
from gp_ground_seg.data.semantic_kitti import read_points
from gp_ground_seg.errors import ConfigError, DataError
from gp_ground_seg.evaluation import comparison, report
from gp_ground_seg.evaluation.evaluate import KnownScan, OurMethod, load_kitti, score_methods
from gp_ground_seg.evaluation.report import Column, Table, percent
from gp_ground_seg.plotting.scan import plot_two_labels

DESCRIPTION = """\
Run two configurations alternately on the same frames, and say in what they differ: IoU,
precision, recall, objects lost, error of the height and how often it is within one and two
standard deviations, time; each difference with a bootstrap interval over the sequences, or over
blocks of frames of a single one. A tie: the interval holds 0. With -o the frames in which most
points have two labels are drawn.

A and B are parameter files or names of presets. Frames without labels, as of any folder of
scans, tell the points that have two labels, and the time.
"""
EXAMPLES = """\
  gp-ground-seg compare default paper KITTI_ROOT
  gp-ground-seg compare default my.yaml KITTI_ROOT --sequences 00,08 -o pictures
  gp-ground-seg compare old.yaml new.yaml scans --json differences.json    scans/*.bin, no labels
"""

NAMES = ('A', 'B')


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = options.new_parser(subparsers, 'compare', DESCRIPTION, EXAMPLES)
    root = 'folder in SemanticKITTI layout, a scan, or a folder of scans'
    options.add(
        parser,
        *((name.lower(), 'parameter file or preset', {'metavar': name}) for name in NAMES),
        ('root', root, {'metavar': 'ROOT'}),
        *OF_FRAMES,
        ('--frames', 'list, and draw, so many frames that differ most (default: %(default)s)',
         {**options.NUMBER, 'default': 3}),
        ('-o --output', 'draw these frames into this folder (PNG)', {'metavar': 'FOLDER'}),
        options.MARKDOWN,
        options.TO_JSON,
        options.FORCE,
    )  # fmt: skip
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Compare, write the files, print the tables."""
    given = arguments.a, arguments.b
    configs = [options.named_config(name) for name in given]
    changed = options.changed_lines(*configs)
    if not changed:
        raise ConfigError(f'{given[0]}, {given[1]}: the same parameters, nothing to compare')
    items, load = _items(arguments)
    pictures = [f'differs_{k + 1}.png' for k in range(min(arguments.frames, len(items)))]
    with staged_options(arguments, 'json') as parts, ExitStack() as stack:
        folder = None
        if arguments.output is not None:
            staged = staged_files(arguments.output, pictures, force=arguments.force)
            folder = stack.enter_context(staged)
        methods = [
            stack.enter_context(closing(OurMethod(config, name)))
            for config, name in zip(configs, NAMES, strict=True)
        ]
        seen = comparison.DisagreementWatch(*methods, len(pictures))
        bar = options.progress('compare')
        scores = score_methods(items, load, methods, progress=bar, watch=seen.watch)
        differences = comparison.find_differences(*scores)
        tables = {
            'measures': comparison.difference_table(differences, scores[0], NAMES),
            'labels': comparison.disagreement_table(seen.scans, NAMES),
            'frames': _frame_table(seen.kept),
        }
        for name, (found, scan, labels) in zip(pictures if folder else [], seen.kept):
            title = f'{found.sequence}/{found.index}: {found.share:.2%} of the points differ'
            truth = next(iter(scan.truths.values()), None)
            assert folder is not None
            plot_two_labels(scan.points, labels, folder / name, truth, title)
        environment = report.describe_environment()
        if 'json' in parts:
            document = {
                'configs': dict(zip(given, (c.nested() for c in configs), strict=True)),
                'environment': environment,
                **{name: table.json() for name, table in tables.items()},
                'measures': [one.json() for one in differences],
                'scans': [scan._asdict() for scan in seen.scans],
            }
            report.write_json(document, parts['json'])
    print(f'A: {given[0]}, B: {given[1]}', *changed, '', sep='\n')
    lines = [report.machine_line(environment, scores[0].scans[-1].fit)]
    print(report.written(tables.values(), lines, markdown=arguments.markdown))
    if arguments.output is not None:
        print(f'drawn: {", ".join(pictures)} in {arguments.output}')
    return 0


def _items(
    arguments: argparse.Namespace,
) -> tuple[Sequence[Any], Callable[[Any], KnownScan]]:
    """Return labelled frames, or scans, and what reads one of them."""
    root, layout = Path(arguments.root), options.scan_layout(arguments)
    if any(root.glob('sequences/*/velodyne')):
        return frames_from_options(arguments), load_kitti
    if arguments.sequences is not None:
        raise DataError(f'--sequences: {root} has no sequences/*/velodyne below it')
    group = root.resolve().stem
    scans = find_scans(root)[:: arguments.frame_step or 1]
    return scans, lambda path: KnownScan(group, path.stem, read_points(path, layout), {})


def _frame_table(kept: Sequence[Any]) -> Table:
    columns = [Column('sequence'), Column('frame'), Column('points', '_d')]
    rows = [[found.sequence, found.index, found.n_points, found.share] for found, *_ in kept]
    columns.append(percent('differ', 'share_different'))
    return Table(columns, rows, 'Frames that differ most  [% of their points]')
