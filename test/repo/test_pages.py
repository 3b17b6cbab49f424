"""The pages hold: links, commands, samples of their tables and the numbers of their pictures."""

import os
import re
import shlex
import sys

import pytest
import yaml
from cli_runner import run
from conftest import REPOSITORY, find_kitti, load_script, run_shell
from evaluation_samples import write_streets

from gp_ground_seg import __version__
from gp_ground_seg.cli.main import COMMANDS, build_parser
from gp_ground_seg.core.jit import JIT_ENABLED
from gp_ground_seg.lab import table1

figures = load_script('docs/figures.py')

PAGES = [*figures.PAGES, 'CONTRIBUTING.md', 'docs/scans/README.md']
TEXTS = {page: (REPOSITORY / page).read_text(encoding='utf-8') for page in PAGES}
SOURCES = ''.join(p.read_text() for p in REPOSITORY.glob('[glt]*/**/*.py'))
FIGURES = [figure for page in PAGES for figure in figures.find_figures(page, TEXTS[page])]
SAMPLED = [figure for figure in FIGURES if figure.sample]
# That of the demo shows a scan that depends on the time.
PICTURES = [f for f in FIGURES if 'picture' in f.options and f.command != 'demo']
ANEW = 'make figures KITTI=PATH'
compiled = pytest.mark.skipif(not JIT_ENABLED, reason='takes minutes without compiled code')

NOT_MADE_HERE = {
    'images/hill.png',
    'images/street.png',  # figures of README.md
    'images/tune.png',  # a screenshot, of what test_browser.py looks at
}
GENERATED = re.compile(rf'{figures.FIGURE.pattern}|<!-- scores:.*?<!-- scores:end -->', re.DOTALL)
BLOCK = re.compile(r'^```.*?^```', re.DOTALL | re.MULTILINE)
LINK = re.compile(r'\]\(([^)\s]+)\)')
ADDRESS = re.compile(r'https://[\w.-]+\.[a-z]+(/[\w./~%-]*)?(#[\w-]+)?')
OURS = re.compile(
    r'\d ?%|\d ms\b|(IoU|RMSE) \D{,9}\d\.\d'
    r'|[\da-z] times (\w*er|as)\b|(\w+th|half|third) of the time'
)
"""Accuracy and speed, which are in figures, with their command."""
ODD = re.compile(
    r'\b(of which|beside|aside|told|things?|the cloud before|holds? for|go(es)? on|whoever)\b'
)
"""For: such as, next to, given, object, the previous cloud, applies to, continue."""
NOT_OURS = re.compile(
    'slopes? of (10 to 15|8) %|(climb|ramp) of (12|15 to 25) %|15 % steep'  # of scenes
    '|3 % of all|10 % of it|35 % of all cells'  # constants of the method
)


def commands_of(text):
    """Blocks of shell commands of a page."""
    return re.findall(r'^```sh\n(.*?)^```', text, re.MULTILINE | re.DOTALL)


def is_refused(line):
    """Whether the parser of the command in a line does not take it."""
    _, mark, rest = re.split(r'  +#| > | &$| --ros-args', line)[0].partition('gp-ground-seg ')
    # What comes before is `ros2 run`; `pip install` names the package.
    words = shlex.split(rest) if mark and 'pip ' not in line else []
    try:
        return bool(words) and not build_parser(words[0]).parse_args(words).run
    except (Exception, SystemExit):
        return True


def is_broken(page, target):
    """Whether a link leads to no file or heading, or is an address of another form."""
    path, _, anchor = target.partition('#')
    if '//' in target:
        return not ADDRESS.fullmatch(target)
    place = (REPOSITORY / page).parent / path if path else REPOSITORY / page
    if not anchor or not place.exists():
        return not place.exists()
    titles = re.findall(r'^#+ (.*)$', BLOCK.sub('', place.read_text()), re.MULTILINE)
    return anchor not in {re.sub(r'[^\w\- ]', '', t.lower()).replace(' ', '-') for t in titles}


def faults(page, text):
    """What is wrong with a page."""
    for figure in figures.find_figures(page, text):
        if figure.digest != figures.digest(figure.body) or 'commit ' not in figure.body:
            yield f'{figure.command}: not made yet, or changed by hand: {ANEW}'
        shown = re.match('`(.*)` \\(commit ', figure.body)
        if shown and is_refused(shown[1]):
            yield f'{shown[1]}: is refused'
    rest = GENERATED.sub('', text)
    yield from ['a table of numbers without its command'] * ('--: |' in rest)
    images = set(re.findall(r'^!\[.*\]\((.*)\)$', rest, re.MULTILINE)) - NOT_MADE_HERE
    yield from (f'{image}: a picture without its command' for image in images)
    prose = ' '.join(re.sub('`[^`]*`', '', BLOCK.sub('', rest)).split())
    yield from (f'figure in a sentence: {k[0]}' for k in OURS.finditer(NOT_OURS.sub('', prose)))
    yield from (f'odd word: {k[0]}' for k in ODD.finditer(prose))
    yield from (f'{link}: no such place' for link in LINK.findall(text) if is_broken(page, link))
    names = re.findall(r'`(\w+)`', text) if page == 'CONTRIBUTING.md' else []
    yield from (f'{name}: in no source' for name in names if name not in SOURCES)
    lines = ''.join(commands_of(text)).splitlines()
    yield from (f'{line}: is refused' for line in lines if is_refused(line))


@pytest.mark.parametrize('page', PAGES)
def test_nothing_is_wrong_with_a_page(page):
    assert list(faults(page, TEXTS[page])) == []
    assert len(FIGURES) >= 14


def test_readme_is_short_the_citation_of_this_version_and_no_command_left_out():
    assert len(TEXTS['README.md'].split()) <= 950
    citation = yaml.safe_load((REPOSITORY / 'CITATION.cff').read_text(encoding='utf-8'))
    assert citation['version'] == __version__
    assert 'arXiv:2112.05847' in str(citation['preferred-citation']['identifiers'])
    # docs/cli.md gets the help of every command when the pages are built.
    words = re.findall(r'^<!-- help: (\w\S*).* -->$', TEXTS['docs/cli.md'], re.MULTILINE)
    assert set(words) == set(COMMANDS)


NUMBER = re.compile(r'[-+]?\d+(?:\.(\d+))?(?:e([-+]\d+))?')
TIMES = ('time', 't Z', 'ms')
"""Beginnings of the titles of columns that depend on the machine."""


def same(shown, found):
    """Whether two cells say the same, numbers to within one in the last digit shown."""
    pairs = zip(NUMBER.finditer(shown), NUMBER.finditer(found), strict=False)
    return NUMBER.sub('#', shown) == NUMBER.sub('#', found) and all(
        abs(float(a[0]) - float(b[0])) <= 1.01 * 10.0 ** (int(a[2] or 0) - len(a[1] or ''))
        for a, b in pairs
    )


def differences(shown, found):
    """Cells of two lists of Markdown rows that differ, times left out."""
    rows, anew = ([row[2:-2].split(' | ') for row in one] for one in (shown, found))
    for k, (cells, others) in enumerate(zip(rows, anew, strict=True)):
        if set(''.join(rows[min(k + 1, len(rows) - 1)])) <= set('-:'):
            titles = cells
        for title, cell, other in zip(titles, cells, others, strict=True):
            if (cells is titles or not title.startswith(TIMES)) and not same(cell, other):
                yield f'{title} of {cells[0]}: {cell} is {other}'


def root_for(figure):
    if figure.needs_kitti and find_kitti() is None:
        pytest.skip('no labelled KITTI frames: set GP_GROUND_SEG_KITTI to their folder')
    return str(find_kitti())


@compiled
@pytest.mark.parametrize('figure', SAMPLED, ids=lambda figure: f'{figure.page}: {figure.command}')
def test_samples_of_tables_come_out_again(figure, capfd, monkeypatch):
    monkeypatch.setattr(table1, 'N_REPEATS', 1)  # of what is timed
    assert run(*figures.words_of(figure.sample, root_for(figure))) == 0
    found = figures.rows_of(figures.kept(figure, capfd.readouterr().out.strip()))
    wrong = list(differences(figures.read_samples()[figure.sample], found))
    assert not wrong, f'{figure.page}, {figure.command}: {"; ".join(wrong[:5])}. {ANEW}'


@compiled
@pytest.mark.slow
@pytest.mark.parametrize('figure', PICTURES, ids=lambda figure: figure.command)
def test_numbers_of_pictures_come_out_again(figure, tmp_path):
    (tmp_path / 'docs').symlink_to(REPOSITORY / 'docs')
    made = figure.options['picture'].partition(' -> ')[0]
    printed = figures.run(figure.command, root_for(figure), tmp_path).splitlines()
    said = figures.caption(next(line for line in printed if made in line), made)
    assert f'({said})\n' in figure.body, f'{figure.page}: now {said}. {ANEW}'
    assert (tmp_path / made).stat().st_size < 3_000_000


IN_TUTORIAL = [b for b in commands_of(TEXTS['docs/tutorial_kitti.md']) if 'KITTI' in b]


@compiled
@pytest.mark.slow
@pytest.mark.parametrize('block', IN_TUTORIAL, ids=lambda block: block.split()[1])
def test_commands_of_the_tutorial_run_as_they_stand(block, tmp_path):
    root = write_streets(tmp_path / 'KITTI', s00=2)
    (root / 'sequences/00/times.txt').write_text('0.0\n0.1\n')
    isolation = {}
    if ' node ' in block:
        isolation = pytest.importorskip('ros_helpers', reason='ROS is not installed').ISOLATION
    program = tmp_path / 'gp-ground-seg'
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m gp_ground_seg "$@"\n')
    program.chmod(0o755)
    environment = {**os.environ, **isolation, 'PATH': f'{tmp_path}:{os.environ["PATH"]}'}
    run_shell(f'{block}\nwait\n', tmp_path, environment)


def test_each_table_has_its_sample_and_no_other_is_kept():
    assert set(figures.read_samples()) == {figure.sample for figure in SAMPLED}
