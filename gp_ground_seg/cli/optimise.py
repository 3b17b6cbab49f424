"""``optimise``: search parameters on labelled frames, and score them on frames left out."""

from __future__ import annotations

import argparse
import logging
import math
from functools import partial

import yaml

from gp_ground_seg.cli import options
from gp_ground_seg.cli.evaluate import OF_FRAMES, ROOT, frames_from_options
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.parameters.export import is_logarithmic
from gp_ground_seg.core.parameters.schema import ROS_NODE_KEY, ROS_PARAMETERS_KEY, ParameterValue
from gp_ground_seg.lab.experiments import optimise
from gp_ground_seg.lab.experiments.variants import make_report, score_variants
from gp_ground_seg.lab.plotting.search import plot_search
from gp_ground_seg.lab.plotting.style import new_figure
from gp_ground_seg.lab.scoring import comparison
from gp_ground_seg.lab.scoring.evaluate import load_kitti
from gp_ground_seg.lab.scoring.report import (
    changed_parameters,
    describe_environment,
    machine_line,
    written,
)

DESCRIPTION = f"""\
Search parameters on your labelled frames (Optuna, TPE) by IoU in the GroundGrid convention. The
search begins with the given parameters. The best ones are compared with the given ones on frames
that the search has not seen: every second sequence, or the second half of a single one. If the
interval of the difference holds 0 there is nothing to win: the given parameters are as good.

Each parameter is searched in its whole accepted range; by default
{', '.join(optimise.DEFAULT_NAMES)}.
Start a search with --journal again in the same way, and it continues after an interruption.
"""
EXAMPLES = """\
  gp-ground-seg optimise ROOT --trials 100 -o best.yaml --picture search.png
  gp-ground-seg optimise ROOT --journal search.log -o best.yaml      interrupt, start again
  gp-ground-seg optimise ROOT --parameters label.ground_tolerance,growth.max_std --left-out 08
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = options.new_parser(subparsers, 'optimise', DESCRIPTION, EXAMPLES)
    file = {'metavar': 'FILE'}
    options.add(
        parser,
        ROOT,
        *OF_FRAMES,
        ('--left-out', 'sequences to score on (default: every second)', {'metavar': 'LIST'}),
        ('--parameters', 'parameters to search, as in grid.n_bins,label.ground_tolerance',
         {'metavar': 'LIST', 'default': ','.join(optimise.DEFAULT_NAMES)}),
        ('--trials', 'try so many sets of values (default: %(default)s)',
         {**options.NUMBER, 'default': 50}),
        ('--seed', 'of the search (default: %(default)s)',
         {'metavar': 'N', 'type': partial(options.positive, least=0), 'default': 0}),
        ('--journal', 'keep every trial in this file, and continue a search that is in it', file),
        ('-o --output', 'write the values that differ to this parameter file (YAML)', file),
        ('--picture', 'draw the trials: IoU over each parameter (PNG)', file),
        options.MARKDOWN,
        options.TO_JSON,
        options.FORCE,
    )  # fmt: skip
    options.add_cluster(parser)
    options.add_config(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Search, score on the frames left out, write the files, print what came out."""
    base = options.read_config(arguments)
    specs = optimise.searched_specs(arguments.parameters.split(','), base)
    left_out = arguments.left_out.split(',') if arguments.left_out else None
    searched, rest = optimise.split_frames(frames_from_options(arguments), left_out)
    if arguments.picture:
        new_figure(1.0, 1.0)  # Raises at once where matplotlib is missing.
    with (
        options.staged_options(arguments, 'json', 'output', 'picture') as parts,
        options.runner(arguments, 'optimise') as runner,
    ):
        # Of values that are far off the library says much; their IoU says it too.
        with options.library_notes(logging.ERROR):
            n, seed, journal = arguments.trials, arguments.seed, arguments.journal
            trials = optimise.search(base, specs, searched, runner, n, seed, journal)
        given, *_ = known = [trial for trial in trials if not math.isnan(trial.iou)]
        best = max(known, key=lambda trial: trial.iou)
        config = base.replace(**best.choice)
        variants = {'given': base, 'best': config}
        scores = score_variants(rest, load_kitti, variants, runner=runner)
        found = comparison.find_differences(*scores)
        words = (
            f'{_verdict(found[0])}. IoU on the {len(searched)} frames searched: given '
            f'{100.0 * given.iou:.2f} %, best of {len(trials)} trials {100.0 * best.iou:.2f} %; '
            f'{len(rest)} left out, of {", ".join(scores[0].sequences)}'
        )
        table = comparison.difference_table(scores[0], found, [*variants])
        report = make_report({}, scores, base, trials=[trial._asdict() for trial in trials])
        environment = describe_environment('optuna')
        lines = [words, *options.changed_lines(base, config)]
        lines.append(machine_line(environment, report.fit))
        text = written([table], lines, markdown=arguments.markdown)
        if 'json' in parts:
            report.facts['measures'] = [one._asdict() for one in found]
            report.write(parts['json'], environment)
        if 'output' in parts:
            values = yaml.safe_dump({ROS_NODE_KEY: {ROS_PARAMETERS_KEY: _changed(config)}})
            parts['output'].write_text(f'# {words}\n{values}', encoding='utf-8')
        if 'picture' in parts:
            logarithmic = [spec.name for spec in specs if is_logarithmic(spec)]
            plot_search(known, logarithmic, parts['picture'])
    print(text)
    return 0


def _verdict(iou: comparison.Difference) -> str:
    """Say by the frames left out whether there is something to win."""
    if math.isnan(iou.low):
        return 'No verdict: too few frames left out for an interval'
    if iou.low > 0.0:
        return 'Won: the best is better on frames left out'
    if iou.high < 0.0:
        return 'Lost: the best is worse on frames left out, keep the given'
    return 'Nothing to win: the interval of the IoU on frames left out holds 0'


def _changed(config: Config) -> dict[str, dict[str, ParameterValue]]:
    """Return what differs from the defaults, by group."""
    names = changed_parameters(config)
    groups = {
        group: {field: value for field, value in own.items() if f'{group}.{field}' in names}
        for group, own in config.nested().items()
    }
    return {group: own for group, own in groups.items() if own}
