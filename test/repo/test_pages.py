"""The pages hold: samples of their tables and the numbers of their pictures, computed again."""

import os
import re
import shlex
import subprocess
import sys

import pytest
import yaml
from cli_runner import run
from conftest import REPOSITORY, find_kitti, load_script
from evaluation_samples import write_streets

from gp_ground_seg import GroundSegmenter, __version__
from gp_ground_seg.cli import demo
from gp_ground_seg.cli.main import COMMANDS, build_parser
from gp_ground_seg.core.jit import JIT_ENABLED
from gp_ground_seg.lab.plotting import plot_scan_view
from gp_ground_seg.lab.scoring.metrics import true_labels

figures = load_script('docs/figures.py')
generate = load_script('docs/generate.py')

FIGURES = [
    figure
    for page in figures.PAGES
    for figure in figures.find_figures(page, (REPOSITORY / page).read_text(encoding='utf-8'))
]
ANEW = 'make figures KITTI=PATH'
NUMBER = re.compile(r'[-+]?\d+(?:\.\d+)?(?:e[-+]\d+)?')
TIMES = ('time', 't Z', 'ms')
"""Beginnings of the titles of columns that depend on the machine."""
compiled = pytest.mark.skipif(not JIT_ENABLED, reason='takes minutes without compiled code')


SAMPLED = [figure for figure in FIGURES if figure.sample]
PLOTTED = [figure for figure in FIGURES if figure.command.startswith('plot ')]


def root_for(figure):
    if figure.needs_kitti and find_kitti() is None:
        pytest.skip('no labelled KITTI frames: set GP_GROUND_SEG_KITTI to their folder')
    return str(find_kitti())


def same(shown, found):
    """Whether two cells say the same, numbers to within one in the last digit shown."""
    if NUMBER.sub('#', shown) != NUMBER.sub('#', found):
        return False
    pairs = zip(NUMBER.findall(shown), NUMBER.findall(found), strict=True)
    return all(abs(float(a) - float(b)) <= 1.01 * last_digit(a) for a, b in pairs)


def last_digit(word):
    mantissa, _, exponent = word.partition('e')
    return 10.0 ** (int(exponent or 0) - len(mantissa.partition('.')[2]))


def differences(shown, found):
    """Cells of two lists of Markdown rows that differ, times left out."""
    assert len(shown) == len(found)
    rows = [[cell.strip() for cell in row.split('|')[1:-1]] for row in shown]
    anew = [[cell.strip() for cell in row.split('|')[1:-1]] for row in found]
    rules = [set(''.join(row)) <= set('-:') for row in rows]
    for k, (cells, others) in enumerate(zip(rows, anew, strict=True)):
        if k + 1 < len(rows) and rules[k + 1]:
            titles = cells
        assert len(cells) == len(others)
        for title, cell, other in zip(titles, cells, others, strict=True):
            if (cells is titles or not title.startswith(TIMES)) and not same(cell, other):
                yield f'{title} of {cells[0]}: {cell} is {other}'


def test_every_figure_is_as_it_was_written():
    assert len(FIGURES) >= 15
    for figure in FIGURES:
        where = f'{figure.page}: {figure.command}'
        assert figure.body, f'{where}: not made yet, {ANEW}'
        assert figure.digest == figures.digest(figure.body), f'{where}: changed by hand, {ANEW}'
        assert 'commit ' in figure.body, where


NO_FIGURES = {
    'images/hill.png',  # a figure of README.md
    'images/tune.png',  # a screenshot, of what test_browser.py looks at
}


def test_every_table_with_numbers_of_ours_and_every_picture_is_a_figure():
    """What stands outside of figures is text, or a table without numbers to compute."""
    for page in figures.PAGES:
        text = (REPOSITORY / page).read_text(encoding='utf-8')
        rest = figures.FIGURE.sub('', text)
        images = re.findall(r'^!\[.*\]\((.*)\)$', rest, re.MULTILINE)
        assert set(images) <= NO_FIGURES, page
        assert '--: |' not in rest, f'{page}: a table of numbers without its command'


@compiled
@pytest.mark.parametrize('figure', SAMPLED, ids=lambda figure: f'{figure.page}: {figure.command}')
def test_samples_of_tables_come_out_again(figure, capfd):
    root = root_for(figure)
    shown = figures.read_samples()[figure.sample]
    assert run(*figures.words_of(figure.sample, root)) == 0
    found = figures.rows_of(figures.kept(figure, capfd.readouterr().out.strip()))
    wrong = list(differences(shown, found))
    assert not wrong, f'{figure.page}, {figure.command}: {"; ".join(wrong[:5])}. {ANEW}'


@compiled
@pytest.mark.parametrize('figure', PLOTTED, ids=lambda figure: figure.options['picture'])
def test_numbers_of_pictures_come_out_again(figure, tmp_path, capsys, monkeypatch):
    root = root_for(figure)
    (tmp_path / 'docs').symlink_to(REPOSITORY / 'docs')
    monkeypatch.chdir(tmp_path)
    assert run(*figures.words_of(figure.command, root)) == 0
    made = figure.options['picture'].partition(' -> ')[0]
    said = figures.caption(capsys.readouterr().out.strip(), made)
    assert f'({said}; commit ' in figure.body, f'{figure.page}: now {said}. {ANEW}'


@compiled
@pytest.mark.parametrize(
    ('script', 'made'),
    [('hill.py', 'hill.png'), pytest.param('drive.py', 'drive.gif', marks=pytest.mark.slow)],
)
def test_numbers_of_the_scripts_come_out_again(script, made, tmp_path):
    (figure,) = (one for one in FIGURES if one.command == f'docs/{script} {made}')
    (tmp_path / 'docs').symlink_to(REPOSITORY / 'docs')
    said = figures.caption(figures.run(figure.command, '', tmp_path), made)
    assert f'({said}; commit ' in figure.body, f'now {said}. {ANEW}'
    assert (tmp_path / made).stat().st_size < 3_000_000


@pytest.mark.slow
@compiled
def test_the_picture_of_the_demo_is_that_of_the_demo(tmp_path):
    """The same scan without the node: the labels that came back are those of the library."""
    (figure,) = (figure for figure in FIGURES if figure.command == 'demo')
    number = int(re.search(r'\(scan (\d+): ', figure.body)[1])
    *_, (points, semantic, _) = (
        scan for _, scan in zip(range(number), demo.simulated_drive(30), strict=False)
    )
    label = GroundSegmenter().segment(points).label
    truth = true_labels(semantic)
    counts = plot_scan_view(points, label, tmp_path / 'a.png', truth=truth)
    assert f'(scan {number}: {counts}; commit ' in figure.body, f'now {counts}. {ANEW}'


LINK = re.compile(r'\]\(([^)\s]+)\)')
DOCUMENTS = [*figures.PAGES, 'CONTRIBUTING.md', 'docs/scans/README.md']


def anchors(path):
    """Anchors of the headings of a page, as GitHub and MyST make them."""
    text = re.sub(r'^```.*?^```', '', path.read_text(encoding='utf-8'), flags=re.M | re.S)
    titles = re.findall(r'^#+ (.*)$', text, re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', title.lower()).replace(' ', '-') for title in titles}


def broken_links(page, text):
    """Links of a page to files and headings that are not there, and addresses of another form."""
    for target in LINK.findall(text):
        path, _, anchor = target.partition('#')
        place = (REPOSITORY / page).parent / path if path else REPOSITORY / page
        if '//' in target:
            if not re.fullmatch(r'https://[\w.-]+\.[a-z]+(/[\w./~%-]*)?(#[\w-]+)?', target):
                yield target
        elif not place.exists() or (anchor and anchor not in anchors(place)):
            yield target


@pytest.mark.parametrize('page', DOCUMENTS)
def test_links_lead_somewhere(page):
    text = (REPOSITORY / page).read_text(encoding='utf-8')
    assert list(broken_links(page, text)) == []


def test_links_that_lead_nowhere():
    good = 'docs/node.md#time-and-tf', 'docs/images/street.png', 'https://arxiv.org/abs/2112.05847'
    bad = ['docs/no.md', 'docs/node.md#no', '#no', 'https://arxiv', 'http://arxiv.org/']
    text = ' '.join(f'[a]({target})' for target in (*good, *bad))
    assert list(broken_links('README.md', text)) == bad


def test_the_citation_is_of_this_version():
    citation = yaml.safe_load((REPOSITORY / 'CITATION.cff').read_text(encoding='utf-8'))
    assert citation['version'] == __version__
    assert 'arXiv:2112.05847' in str(citation['preferred-citation']['identifiers'])


def test_readme_is_short():
    """At most 1,000 words, and 60 numbers in what is read: no commands, versions, commits."""
    text = (REPOSITORY / 'README.md').read_text(encoding='utf-8')
    assert len(text.split()) <= 1000
    marks = '<!--.*?-->', '```.*?```', '`.*?`', r'\]\(.*?\)'
    for part in (*marks, r'commit \w+', r'(ROS|Ubuntu|SA) \S+', r'Python \S+ to \S+'):
        text = re.sub(part, '', text, flags=re.DOTALL)
    # Thousands are set apart by a blank.
    assert len(re.findall(r'(?<![\w-])\d[\d.]*(?: \d{3}\b)*', text)) <= 60


def test_rows_and_columns_without_a_number_are_left_out():
    table = """\
| a | n | x | y |
| --- | --: | --: | --: |
| one | 3 | 1.5 | - |
| two | 0 | - | - |
| three | 0 | 0.0 | - |"""
    three = '| one | 3 | 1.5 |\n| three | 0 | 0.0 |'
    assert figures.trimmed(table) == f'| a | n | x |\n| --- | --: | --: |\n{three}'
    assert figures.trimmed(table, ['n'], 'one|two') == '| a | x |\n| --- | --: |\n| one | 1.5 |'


def test_the_page_of_the_commands_has_all_of_them():
    """docs/cli.md gets the help of every command when the pages are built."""
    text = (REPOSITORY / 'docs' / 'cli.md').read_text(encoding='utf-8')
    words = [found.split()[0] for found in re.findall(r'^<!-- help: (.*) -->$', text, re.M)]
    assert set(words) == set(COMMANDS)


def commands_of(page):
    """Blocks of shell commands of a page."""
    text = (REPOSITORY / page).read_text(encoding='utf-8')
    return re.findall(r'^```sh\n(.*?)^```', text, re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize('page', figures.PAGES)
def test_commands_of_the_pages_are_taken_by_their_parsers(page):
    for line in ''.join(commands_of(page)).splitlines():
        _, mark, rest = re.split(r'  +#| > | &$| --ros-args', line)[0].partition('gp-ground-seg ')
        # What comes before is `ros2 run`; `pip install` names the package.
        if mark and 'pip ' not in line:
            words = shlex.split(rest)
            assert build_parser(words[0]).parse_args(words).run, line


IN_TUTORIAL = [block for block in commands_of('docs/tutorial_kitti.md') if 'KITTI' in block]


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
    path = f'{tmp_path}:{os.environ["PATH"]}'
    done = subprocess.run(
        ['bash', '-e', '-c', f'{block}\nwait\n'], cwd=tmp_path, check=False, timeout=300,
        env={**os.environ, **isolation, 'PATH': path}, text=True, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    assert 'Traceback' not in done.stdout, done.stdout


PAGE = """\
# A page
<!-- figure: experiment scenes --sensors vlp-16 --scenes flat --seeds 1 --no-peer
sample: --scenes kerb
-->
stale
<!-- end of figure 12345678 -->
And text.
"""


def test_a_command_is_run_in_a_folder_of_its_own(tmp_path):
    (tmp_path / 'a.yaml').write_text('grid: {n_bins: 41}\n')
    assert 'a.yaml' in figures.run('config check a.yaml', '', tmp_path)
    assert figures.words_of('evaluate KITTI_ROOT', '/a b') == ['evaluate', '/a b', '--markdown']


def test_only_the_tables_that_a_figure_keeps():
    (figure,) = figures.find_figures('a.md', PAGE.replace('sample:', 'keep: B; C\nsample:'))
    a, b, c = (f'| {name} |\n| --- |\n| 1 |' for name in 'abc')
    parts = ['A is', a, 'a note', 'B is', b, 'C', c, 'machine: x', 'result']
    assert figures.kept(figure, '\n\n'.join(parts)) == '\n\n'.join(parts[3:-1])


def test_a_figure_is_replaced_and_nothing_else():
    (figure,) = figures.find_figures('docs/a.md', PAGE)
    assert (figure.body, figure.digest, figure.needs_kitti) == ('stale\n', '12345678', False)
    output = (
        '| sensor | scene | IoU |\n| --- | --- | --: |\n| vlp-16 | flat | 98.5 |\n\nmachine: x'
    )
    body = figures.body_of(figure, output, 'abc')
    text = figures.replaced(PAGE, figure, body)
    assert text.startswith('# A page\n<!-- figure: ') and text.endswith(' -->\nAnd text.\n')
    (again,) = figures.find_figures('docs/a.md', text)
    assert (again.command, again.options) == (figure.command, figure.options)
    assert again.digest == figures.digest(again.body)
    assert '| vlp-16 | flat | ' in again.body and 'machine: ' in again.body


def test_samples_that_differ():
    rows = figures.rows_of('a title\n\n| scene | IoU |\n| --- | --: |\n| flat | 98.5 |\n')
    assert len(rows) == 3
    assert list(differences(rows, rows)) == []
    wrong = [*rows[:2], '| flat | 18.5 |']
    assert list(differences(wrong, rows)) == ['IoU of flat: 18.5 is 98.5']
    assert set(figures.read_samples()) == {figure.sample for figure in SAMPLED}


@pytest.mark.parametrize(
    ('shown', 'found', 'is_same'),
    [
        ('97.50', '97.51', True),
        ('97.50', '97.52', False),
        ('+0.10 to +0.30', '+0.10 to +0.30 tie', False),
        ('1.2e-05', '1.3e-05', True),
        ('1.2e-05', '1.4e-05', False),
        ('kerb', 'flat', False),
    ],
)
def test_cells(shown, found, is_same):
    assert same(shown, found) is is_same
