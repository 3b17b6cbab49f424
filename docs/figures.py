"""Recompute the tables and pictures of README.md and docs/: `make figures`.

A figure of a page stands between two comments. The first holds the command, and below it what
else there is to say; what stands between the two is written here:

    <!-- figure: experiment steps KITTI_ROOT
    sample: --sequences 03 --frame-step 10
    -->
    <!-- end of figure -->

sample: WORDS          further words for a run of seconds; its rows are kept in docs/samples.json,
                       by command, and test/repo/test_pages.py computes them again
keep: TITLE; TITLE     only the tables whose titles begin so
drop: TITLE; TITLE     without the columns of these titles
rows: PATTERN          only the rows in which this regular expression is found
picture: FILE -> PATH  the file that the command makes, and its place in the repository

A command is one of gp-ground-seg, or a Python script: docs/faults.py.

Rows and columns without a number are left out: - is no number, nor is 0 next to it. A page has one
line on the machine, below its last tables; above each figure is its commit.

Pages and pictures are written when all commands have run: each runs on the commit it names.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from gp_ground_seg.lab.scoring.report import describe_environment

REPOSITORY = Path(__file__).resolve().parent.parent
PAGES = (
    'README.md',
    *(f'docs/{path.name}' for path in sorted((REPOSITORY / 'docs').glob('*.md'))),
)
FIGURE = re.compile(
    r'<!-- figure: (?P<head>.*?)\n-->\n(?P<body>.*?)<!-- end of figure ?(?P<digest>\w*) -->',
    re.DOTALL,
)
SAMPLES = REPOSITORY / 'docs' / 'samples.json'
ROOT = 'KITTI_ROOT'
MACHINE = 'machine: '


class Figure(NamedTuple):
    """A figure as its page has it."""

    page: str
    command: str
    options: dict[str, str]
    head: str  # the first comment, without its marks
    body: str
    digest: str

    @property
    def sample(self) -> str | None:
        """The command of the sample."""
        return f'{self.command} {self.options["sample"]}' if 'sample' in self.options else None

    @property
    def needs_kitti(self) -> bool:
        """Whether the command reads labelled frames."""
        return ROOT in self.command


def find_figures(page: str, text: str) -> list[Figure]:
    """Figures of a page."""
    figures = []
    for match in FIGURE.finditer(text):
        command, *lines = match['head'].splitlines()
        options = dict(line.split(': ', 1) for line in lines)
        figures.append(
            Figure(page, command.strip(), options, match['head'], match['body'], match['digest'])
        )
    return figures


def replaced(page: str, figure: Figure, body: str) -> str:
    """Text of a page with another body of a figure."""
    begin = f'<!-- figure: {figure.head}\n-->\n'
    before, _, after = page.partition(f'{begin}{figure.body}<!-- end of figure')
    end = f'<!-- end of figure {digest(body)} -->'
    return before + begin + body + end + after.partition('-->')[2]


def digest(body: str) -> str:
    """Digest that shows whether a body was changed by hand."""
    return hashlib.sha256(body.encode()).hexdigest()[:8]


def typed(command: str) -> str:
    """Command as a reader types it."""
    return f'{"python" if words_of(command, "")[0].endswith(".py") else "gp-ground-seg"} {command}'


def words_of(command: str, kitti: str) -> list[str]:
    """Words of a command as they are run."""
    words = [word.replace(ROOT, kitti) for word in shlex.split(command)]
    return [*words, '--markdown'] if words[0] in ('evaluate', 'experiment') else words


def run(command: str, kitti: str, folder: Path) -> str:
    """Run a command in a folder, and return what it prints."""
    words = words_of(command, kitti)
    program = [] if words[0].endswith('.py') else ['-m', 'gp_ground_seg']
    words = [sys.executable, *program, *words]
    done = subprocess.run(words, cwd=folder, stdout=subprocess.PIPE, text=True, check=True)
    return done.stdout.strip()


def rows_of(output: str) -> list[str]:
    """Rows of the Markdown tables in an output, with those of the titles."""
    return [line for line in output.splitlines() if line.startswith('| ')]


def kept(figure: Figure, output: str) -> str:
    """Return the tables of an output that a figure keeps, and the lines on the machine."""
    parts = output.split('\n\n')
    if 'keep' in figure.options:
        titles = tuple(figure.options['keep'].split('; '))
        tables = [part for a, b in pairwise(parts) if a.startswith(titles) for part in (a, b)]
        parts = [*tables, *(part for part in parts if part.startswith(MACHINE))]
    dropped, wanted = figure.options.get('drop', '').split('; '), figure.options.get('rows', '')
    return '\n\n'.join(
        trimmed(part, dropped, wanted) if part.startswith('| ') else part for part in parts
    )


def trimmed(table: str, dropped: Sequence[str] = (), wanted: str = '') -> str:
    """Return a table without some columns and rows, and without those that have no number."""
    above, lines = table.splitlines()[:2], table.splitlines()[2:]
    # pandas pads the cells; a page has them one blank apart.
    cells = [[cell.strip() for cell in line.split('|')[1:-1]] for line in (*above, *lines)]
    titles, marks, *rows = cells
    rows = [row for row in rows if re.search(wanted, f'| {" | ".join(row)} |')]
    rule = ['--:' if mark.endswith(':') else '---' for mark in marks]
    numbers = [k for k, mark in enumerate(rule) if mark.endswith(':')]
    rows = [row for row in rows if '-' not in row or {row[k] for k in numbers} - {'-', '0'}]
    empty = {k for k in numbers if all(row[k] == '-' for row in rows)}
    left = [k for k, title in enumerate(titles) if title not in dropped and k not in empty]
    cells = ([row[k] for k in left] for row in (titles, rule, *rows))
    return '\n'.join(f'| {" | ".join(line)} |' for line in cells)


def body_of(figure: Figure, output: str, commit: str, *, is_last: bool = True) -> str:
    """Write what stands between the comments; the last tables of a page say the machine."""
    if 'picture' in figure.options:
        # The image, with the words it had, and the line that names the file.
        made = figure.options['picture'].partition(' -> ')[0]
        (image,) = re.findall(r'^!\[.*\)$', figure.body, re.MULTILINE)
        (said,) = [line for line in output.splitlines() if made in line]
        return f'{image}\n\n({caption(said, made)})\n<!-- commit {commit} -->\n'
    output = kept(figure, output)
    if '| ---' not in output:
        output = f'```text\n{output}\n```'
    if not is_last:
        output = output.partition(f'\n\n{MACHINE}')[0]
    return f'`{typed(figure.command)}` (commit {commit})\n\n{output}\n\n'


def read_samples() -> dict[str, list[str]]:
    """Read the Markdown rows of each sample, by its command."""
    samples: dict[str, list[str]] = json.loads(SAMPLES.read_text(encoding='utf-8'))
    return samples


def write_samples(samples: dict[str, list[str]]) -> None:
    """Write the rows of the samples."""
    text = json.dumps(samples, indent=1, ensure_ascii=False, sort_keys=True)
    SAMPLES.write_text(f'{text}\n', encoding='utf-8')


def caption(said: str, made: str) -> str:
    """Numbers that a command says of its picture."""
    return said.replace(f', written to {made}', '').replace(f'picture  {made}  ', '')


def run_all(commands: list[str], kitti: str, folder: Path) -> dict[str, str]:
    """Run commands in a folder, and return what each prints; those that fail are left out."""
    outputs: dict[str, str] = {}
    started = time.monotonic()
    for k, command in enumerate(commands, 1):
        seconds = time.monotonic() - started
        print(f'[{k}/{len(commands)}, {seconds:.0f} s] {typed(command)}', flush=True)
        try:
            outputs[command] = run(command, kitti, folder)
        except subprocess.CalledProcessError as error:
            print(f'FAILED with exit code {error.returncode}; its figures stay as they are')
        except KeyboardInterrupt:
            print('interrupted: what is done is written')
            break
    return outputs


def main() -> int:
    """Run the commands, then write pages, samples and pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('kitti', metavar=ROOT, help='labelled frames, SemanticKITTI layout')
    parser.add_argument(
        'part', nargs='*', help='only pages and commands with one of these in them'
    )
    arguments = parser.parse_args()
    kitti = str(Path(arguments.kitti).resolve())
    if not (Path(kitti) / 'sequences').is_dir():
        parser.error(f'{arguments.kitti}: holds no sequences/; say make figures KITTI=PATH')
    texts = {page: (REPOSITORY / page).read_text(encoding='utf-8') for page in PAGES}
    every = [figure for page, text in texts.items() for figure in find_figures(page, text)]
    last_tables = {f.page: f.command for f in every if 'picture' not in f.options}
    chosen = arguments.part or ['']
    figures = [f for f in every if any(part in f'{f.page} {f.command}' for part in chosen)]
    commands = [c for figure in figures for c in (figure.command, figure.sample) if c is not None]
    commit = (describe_environment()['commit'] or 'unknown')[:12]
    samples = read_samples()
    samples = {f.sample: samples[f.sample] for f in every if f.sample in samples}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / 'docs').symlink_to(REPOSITORY / 'docs')
        outputs = run_all(list(dict.fromkeys(commands)), kitti, folder)
        done = [f for f in figures if {f.command, f.sample} - {None} <= outputs.keys()]
        for figure in done:
            is_last = figure.command == last_tables.get(figure.page)
            body = body_of(figure, outputs[figure.command], commit, is_last=is_last)
            texts[figure.page] = replaced(texts[figure.page], figure, body)
            if figure.sample is not None:
                samples[figure.sample] = rows_of(kept(figure, outputs[figure.sample]))
            if 'picture' in figure.options:
                made, _, place = figure.options['picture'].partition(' -> ')
                shutil.copyfile(folder / made, REPOSITORY / place)
    write_samples(samples)
    for page, text in texts.items():
        (REPOSITORY / page).write_text(text, encoding='utf-8')
    print(f'{len(done)} of {len(figures)} figures written')
    return 0 if len(done) == len(figures) else 1


if __name__ == '__main__':
    sys.exit(main())
