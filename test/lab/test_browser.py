"""The page of `tune` in a real browser: it draws, sliders move labels, no error is logged."""

import io
import re
import shutil

import numpy as np
import pytest
from cli_runner import PATIENCE, until_ctrl_c
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
SCREENSHOTS = REPOSITORY / 'build' / 'screenshots'
# WebGL by SwiftShader, on the CPU: there is no GPU, and no sandbox for root.
FLAGS = (
    '--headless=new', '--no-sandbox', '--window-size=1400,1000', '--use-angle=swiftshader',
    '--enable-unsafe-swiftshader',
)  # fmt: skip


@pytest.fixture
def browser():
    options = webdriver.ChromeOptions()
    for flag in FLAGS:
        options.add_argument(flag)
    options.set_capability('goog:loggingPrefs', {'browser': 'ALL'})
    with webdriver.Chrome(options, webdriver.ChromeService(DRIVER)) as driver:
        yield driver


def errors(browser):
    return [entry for entry in browser.get_log('browser') if entry['level'] == 'SEVERE']


def wait_for(browser, condition):
    """Return the first value of `condition`, given the text of the page, that is true."""
    from selenium.webdriver.support.wait import WebDriverWait

    text = 'return document.body ? document.body.innerText : ""'  # none yet while it loads
    return WebDriverWait(browser, PATIENCE, 0.1).until(
        lambda driver: condition(driver.execute_script(text))
    )


def count_colours(browser, name):
    """Pixels that have a colour of the legends of class and changes, by its name."""
    data = browser.get_screenshot_as_png()
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    (SCREENSHOTS / name).write_bytes(data)
    picture = (255.0 * np.asarray(imread(io.BytesIO(data), format='png'))).round()[..., :3]
    return {
        name: int((np.abs(picture - colour).max(axis=-1) <= 2).sum())
        for legend in ('class', 'changes')
        for name, colour in zip(LEGENDS[legend], palette(legend).astype(float), strict=True)
    }


def test_a_slider_changes_labels_and_colours_and_a_button_writes_them(browser, sequence, tmp_path):
    output = tmp_path / 'tuned.yaml'

    def is_drawn(_text):
        found = count_colours(browser, 'tune.png')
        return found if min(found['ground'], found['obstacle']) > 1000 else None

    def has_changed(_text):
        found = count_colours(browser, 'tune_moved.png')
        return found['now ground'] > before['now ground'] + 100

    with until_ctrl_c('tune', sequence, '--output', output) as process:
        browser.get(process.stdout.readline().strip())
        wait_for(browser, lambda text: re.search(r'^0 changed', text, re.MULTILINE))
        before = wait_for(browser, is_drawn)
        text = wait_for(browser, lambda text: text)
        assert re.search(r'IoU\s+9\d\.\d\d %', text)

        names = re.findall(r'^([\w.]+)(?: \[[^\]]+\])?$', text, re.MULTILINE)
        numbers = ['frame', *(spec.name for spec in tunable() if spec.type in (int, float))]
        index = [name for name in names if name in numbers].index('label.ground_tolerance')
        slider = browser.find_elements('css selector', '.mantine-Slider-thumb')[index]
        webdriver.ActionChains(browser).drag_and_drop_by_offset(slider, 120, 0).perform()
        wait_for(browser, lambda text: re.search(r'^[1-9][\d ]* changed', text, re.MULTILINE))
        wait_for(browser, has_changed)
        shown = wait_for(browser, lambda text: re.search(r'ground\t([\d ]+)\t([\d ]+)', text))
        n_ground, n_before = (int(number.replace(' ', '')) for number in shown.groups())
        assert n_ground > n_before

        browser.find_element('xpath', '//button[contains(., "tuned.yaml")]').click()
        wait_for(browser, lambda text: f'written to {output}' in text)
        assert errors(browser) == []
    written = Config.from_yaml(output)
    value = written.label.ground_tolerance
    assert value > Config().label.ground_tolerance
    assert written == Config().replace(**{'label.ground_tolerance': value})


SCRIPT = """<iframe srcdoc="<img src=x onerror='parent.ran=1'>">"""


def test_names_and_headers_of_files_are_no_script(browser, tmp_path):
    (tmp_path / SCRIPT).mkdir()
    scan = tmp_path / SCRIPT / 'a.npy'
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({SCRIPT}), }}".ljust(200)
    scan.write_bytes(b'\x93NUMPY\x01\x00\xc8\x00' + header.encode())
    with until_ctrl_c('tune', scan, '--output', tmp_path / 'tuned.yaml') as process:
        browser.get(process.stdout.readline().strip())
        wait_for(browser, lambda text: SCRIPT in text)
        # A frame would have loaded before the page shows what comes later.
        browser.get_screenshot_as_png()
        assert browser.find_elements('css selector', 'iframe') == []
        assert browser.execute_script('return window.ran') is None
        assert errors(browser) == []
