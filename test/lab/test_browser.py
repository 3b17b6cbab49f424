"""The page of `tune` in a real browser: it draws, sliders move labels, no error is logged."""

import io
import re
import shutil

import numpy as np
import pytest
from cli_runner import until_ctrl_c
from conftest import REPOSITORY
from matplotlib.image import imread

from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.lab.tuner import LEGENDS, palette, tunable

pytest.importorskip('viser', reason='viser is not installed')
webdriver = pytest.importorskip('selenium.webdriver', reason='selenium is not installed')
DRIVER = shutil.which('chromedriver')
pytestmark = [
    pytest.mark.usefixtures('compiled_code'),
    pytest.mark.skipif(DRIVER is None, reason='chromedriver is not installed'),
    pytest.mark.slow,
]
NUMBERS = [spec.name for spec in tunable() if spec.type in (int, float)]
SCREENSHOTS = REPOSITORY / 'build' / 'screenshots'
PATIENCE = 120.0
"""Time to wait for what has to happen [s]; only a failure takes that long."""
# WebGL by SwiftShader, on the CPU: there is no GPU, and no sandbox for root.
FLAGS = (
    '--headless=new', '--no-sandbox', '--window-size=1400,1000', '--use-angle=swiftshader',
    '--enable-unsafe-swiftshader',
)  # fmt: skip


class Page:
    """A page of the browser that `driver` of Selenium controls."""

    def __init__(self, driver):
        self.driver = driver

    @property
    def text(self):
        """Text of the page."""
        return self.driver.execute_script('return document.body.innerText')

    def errors(self):
        """Return the errors in the console since the last call."""
        log = self.driver.get_log('browser')
        return [entry['message'] for entry in log if entry['level'] == 'SEVERE']

    def wait_for(self, condition, awaited):
        """Return the first value of `condition` that is true."""
        from selenium.webdriver.support.wait import WebDriverWait

        wait = WebDriverWait(self.driver, PATIENCE, 0.1)
        return wait.until(lambda _: condition(), f'no {awaited}')

    def screenshot(self, name):
        """Picture of the page, (height, width, 3), from 0 to 255; kept as a file too."""
        data = self.driver.get_screenshot_as_png()
        SCREENSHOTS.mkdir(parents=True, exist_ok=True)
        (SCREENSHOTS / name).write_bytes(data)
        return (255.0 * np.asarray(imread(io.BytesIO(data), format='png'))).round()[..., :3]


@pytest.fixture
def page():
    options = webdriver.ChromeOptions()
    for flag in FLAGS:
        options.add_argument(flag)
    options.set_capability('goog:loggingPrefs', {'browser': 'ALL'})
    with webdriver.Chrome(options, webdriver.ChromeService(DRIVER)) as driver:
        yield Page(driver)


def count(picture):
    """Pixels of a picture that have a colour of the legends of class and changes, by its name."""
    return {
        name: int((np.abs(picture - colour).max(axis=-1) <= 2).sum())
        for legend in ('class', 'changes')
        for name, colour in zip(LEGENDS[legend], palette(legend).astype(float), strict=True)
    }


def wait_for_colours(page, name, condition):
    """Numbers of pixels by colour once they fulfil a condition: drawing takes a while."""

    def look():
        found = count(page.screenshot(name))
        return found if condition(found) else None

    return page.wait_for(look, f'{name} as it should be')


@pytest.fixture(scope='module')
def tune(sequence, tmp_path_factory):
    """Address of the page, and the file that it writes."""
    output = tmp_path_factory.mktemp('output') / 'tuned.yaml'
    with until_ctrl_c('tune', sequence, '--output', output) as process:
        yield process.stdout.readline().strip(), output


def test_a_slider_changes_labels_and_colours_and_a_button_writes_them(tune, page):
    address, output = tune
    page.driver.get(address)
    page.wait_for(lambda: re.search(r'^0 changed', page.text, re.MULTILINE), 'first labels')
    before = wait_for_colours(page, 'tune.png', lambda n: min(n['ground'], n['obstacle']) > 1000)
    assert re.search(r'IoU\s+9\d\.\d\d %', page.text)

    names = re.findall(r'^([\w.]+)(?: \[[^\]]+\])?$', page.text, re.MULTILINE)
    numbers = [name for name in names if name in ('frame', *NUMBERS)]
    sliders = page.driver.find_elements('css selector', '.mantine-Slider-thumb')
    slider = sliders[numbers.index('label.ground_tolerance')]
    webdriver.ActionChains(page.driver).drag_and_drop_by_offset(slider, 60, 0).perform()
    page.wait_for(lambda: re.search(r'^[1-9][\d ]* changed', page.text, re.MULTILINE), 'change')
    n_ground, n_before = re.search(r'ground\t([\d ]+)\t([\d ]+)', page.text).groups()
    assert int(n_ground.replace(' ', '')) > int(n_before.replace(' ', ''))
    wait_for_colours(
        page, 'tune_moved.png', lambda n: n['now ground'] > before['now ground'] + 100
    )

    page.driver.find_element('xpath', '//button[contains(., "tuned.yaml")]').click()
    page.wait_for(lambda: f'written to {output}' in page.text, 'file')
    written = Config.from_yaml(output)
    value = written.label.ground_tolerance
    assert value > Config().label.ground_tolerance
    assert written == Config().replace(**{'label.ground_tolerance': value})
    assert page.errors() == []


SCRIPT = """<iframe srcdoc="<img src=x onerror='parent.ran=1'>">"""


def test_names_and_headers_of_files_are_no_script(page, tmp_path):
    (tmp_path / SCRIPT).mkdir()
    scan = tmp_path / SCRIPT / 'a.npy'
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({SCRIPT}), }}".ljust(200)
    scan.write_bytes(b'\x93NUMPY\x01\x00\xc8\x00' + header.encode())
    with until_ctrl_c('tune', scan, '--output', tmp_path / 'tuned.yaml') as process:
        page.driver.get(process.stdout.readline().strip())
        page.wait_for(lambda: SCRIPT in page.text, 'name')
        # A frame would have loaded before the page shows what comes later.
        page.screenshot('script.png')
        assert page.driver.find_elements('css selector', 'iframe') == []
        assert page.driver.execute_script('return window.ran') is None
        assert page.errors() == []
