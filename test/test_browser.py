"""Pages in a real browser: they draw, sliders move labels, the console has no error."""

import os
import re

import numpy as np
import pytest

viser = pytest.importorskip('viser', reason='viser is not installed')

from browser import CHROMIUM, open_browser  # noqa: E402
from cli_runner import run, until_ctrl_c  # noqa: E402

from gp_ground_seg.core.parameters.config import Config  # noqa: E402
from gp_ground_seg.lab.viewers.scene import LEGENDS, palette  # noqa: E402

pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason='Chromium is not installed'),
    pytest.mark.slow,
]
SHADED = 40  # difference of a shaded colour, from 0 to 255


@pytest.fixture
def page(tmp_path_factory):
    with open_browser(tmp_path_factory.mktemp('profile')) as page:
        yield page


def count(picture, tolerance=2):
    """Pixels of a picture that have a colour of the legends of class and changes, by its name."""
    return {
        name: int((np.abs(picture - colour).max(axis=-1) <= tolerance).sum())
        for legend in ('class', 'changes')
        for name, colour in zip(LEGENDS[legend], palette(legend).astype(float), strict=True)
    }


def wait_for_colours(page, name, condition):
    """Numbers of pixels by colour once they fulfil a condition: drawing takes a while."""

    def look():
        found = count(page.screenshot(name))
        return found if condition(found) else None

    return page.wait_for(look, f'{name} as it should be')


def test_page_of_a_scan_opens_from_disk_and_draws_its_points(sequence, page, tmp_path):
    path = tmp_path / 'scan.html'
    assert run('view', sequence, '--frame', 1, '--html', path, '--quiet') == 0
    page.open(path.as_uri())
    wait_for_colours(page, 'view.png', lambda n: min(n['ground'], n['obstacle']) > 1000)
    text = page.text
    assert '000001.bin' in text and 'p_ground' in text and 'errors' in text
    assert page.errors == []


@pytest.mark.skipif(
    'GP_GROUND_SEG_WEB_VIEWER' not in os.environ,
    reason='takes minutes without a GPU: make browser-test',
)
def test_the_web_viewer_draws_the_scan(sequence, page):
    pytest.importorskip('rerun', reason='rerun is not installed')
    with until_ctrl_c('view', sequence, '--web', '--port', 9590) as process:
        page.open(f'{process.stdout.readline().strip()}&renderer=webgl')
        # Rerun shades its points: the middle of an obstacle is darker than in the legend.
        page.wait_for(
            lambda: count(page.screenshot('web.png'), SHADED)['obstacle'] > 1000, 'obstacles'
        )
    # It asks for fonts and news, which there may be no network for.
    ours = [text for text in page.errors if 'fetch' not in text and 'load resource' not in text]
    assert ours == []


@pytest.fixture(scope='module')
def tune(sequence, tmp_path_factory):
    """Address of the page, and the file that it writes."""
    output = tmp_path_factory.mktemp('output') / 'tuned.yaml'
    with until_ctrl_c('tune', sequence, '--output', output) as process:
        yield process.stdout.readline().strip(), output


def test_a_slider_changes_labels_and_colours_and_a_button_writes_them(tune, page):
    address, output = tune
    page.open(address)
    page.wait_for(lambda: re.search(r'^0 changed', page.text, re.MULTILINE), 'first labels')
    before = wait_for_colours(page, 'tune.png', lambda n: min(n['ground'], n['obstacle']) > 1000)
    assert re.search(r'IoU\s+9\d\.\d\d %', page.text)

    names = re.findall(r'^([\w.]+) = ', page.text, re.MULTILINE)
    thumb = page.place('.multi-slider-thumb', names.index('label.ground_tolerance'))
    page.drag(thumb, (thumb[0] + 60.0, thumb[1]))
    page.wait_for(lambda: re.search(r'^[1-9][\d,]* changed', page.text, re.MULTILINE), 'change')
    n_ground, n_before = re.search(r'ground\s+([\d,]+)\s+([\d,]+)', page.text).groups()
    assert int(n_ground.replace(',', '')) > int(n_before.replace(',', ''))
    (value,) = re.findall(r'label.ground_tolerance = ([\d.]+) m', page.text)
    wait_for_colours(
        page, 'tune_moved.png', lambda n: n['now ground'] > before['now ground'] + 100
    )

    page.click('tuned.yaml')
    page.wait_for(lambda: f'written to {output}' in page.text, 'file')
    assert Config.from_yaml(output) == Config().replace(**{'label.ground_tolerance': float(value)})
    assert page.errors == []
