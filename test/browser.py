"""A headless Chromium, driven by its DevTools protocol."""

import base64
import contextlib
import itertools
import json
import shutil
import subprocess
import time
import urllib.request

from conftest import REPOSITORY

CHROMIUM = shutil.which('chromium') or shutil.which('chromium-browser')
SCREENSHOTS = REPOSITORY / 'build' / 'screenshots'
PATIENCE = 120.0
"""Time to wait for what has to happen [s]; only a failure takes that long."""
# WebGL by SwiftShader, on the CPU: there is no GPU, and no sandbox for root.
FLAGS = (
    '--headless=new', '--no-sandbox', '--remote-debugging-port=0', '--window-size=1400,1000',
    '--use-angle=swiftshader', '--enable-unsafe-swiftshader', 'about:blank',
)  # fmt: skip


class Page:
    """A page of the browser; `messages` are those of its console."""

    def __init__(self, connection):
        self._connection, self._numbers = connection, itertools.count(1)
        self.messages, self._is_loaded = [], False
        for domain in ('Page', 'Runtime', 'Log'):
            self.call(f'{domain}.enable')

    def call(self, method, **parameters):
        """Result of a command of the protocol; what comes before it is kept."""
        number = next(self._numbers)
        self._connection.send(json.dumps({'id': number, 'method': method, 'params': parameters}))
        while True:
            found = json.loads(self._connection.recv(timeout=PATIENCE))
            if found.get('id') == number:
                assert 'error' not in found, f'{method}: {found["error"]}'
                return found['result']
            self._keep(found)

    def _keep(self, event):
        given = event['params']
        if event['method'] == 'Runtime.consoleAPICalled' and given['type'] != 'debug':
            words = [str(word.get('value', word.get('description'))) for word in given['args']]
            self.messages.append((given['type'], ' '.join(words)))
        elif event['method'] == 'Runtime.exceptionThrown':
            self.messages.append(('error', json.dumps(given['exceptionDetails'])))
        elif event['method'] == 'Log.entryAdded':
            self.messages.append((given['entry']['level'], given['entry']['text']))
        elif event['method'] == 'Page.loadEventFired':
            self._is_loaded = True

    @property
    def errors(self):
        """What went wrong, by the console."""
        return [text for level, text in self.messages if level in ('error', 'assert')]

    def run(self, script):
        """Value of JavaScript."""
        found = self.call('Runtime.evaluate', expression=script, returnByValue=True)
        assert 'exceptionDetails' not in found, found
        return found['result'].get('value')

    @property
    def text(self):
        """What is written on the page."""
        return self.run('document.body ? document.body.innerText : ""')

    def open(self, address):
        self._is_loaded = False
        self.call('Page.navigate', url=address)
        self.wait_for(lambda: self._is_loaded, f'page {address}')

    def wait_for(self, condition, what):
        """Return the first value of `condition` that is true."""
        end = time.monotonic() + PATIENCE
        while not (value := condition()):
            assert time.monotonic() < end, f'no {what}; {self.messages}'
            with contextlib.suppress(TimeoutError):
                self._keep(json.loads(self._connection.recv(timeout=0.1)))
        return value

    def screenshot(self, name):
        """Picture of the page, (height, width, 3), kept as a file too."""
        import io

        import numpy as np
        from matplotlib.image import imread

        data = base64.b64decode(self.call('Page.captureScreenshot')['data'])
        SCREENSHOTS.mkdir(parents=True, exist_ok=True)
        (SCREENSHOTS / name).write_bytes(data)
        return (255.0 * np.asarray(imread(io.BytesIO(data), format='png'))).round()[..., :3]

    def place(self, selector, number=0):
        """Middle of an element, in pixels."""
        box = (
            f'document.querySelectorAll({json.dumps(selector)})[{number}].getBoundingClientRect()'
        )
        rect = self.run(f'(() => {{ const b = {box}; return [b.x, b.y, b.width, b.height] }})()')
        return rect[0] + 0.5 * rect[2], rect[1] + 0.5 * rect[3]

    def drag(self, start, end):
        """Press the mouse at a place, move it to another and let go; a click where they agree."""
        steps = (('mouseMoved', start), ('mousePressed', start), ('mouseMoved', end))
        for kind, (x, y) in (*steps, ('mouseReleased', end)):
            self.call(
                'Input.dispatchMouseEvent', type=kind, x=x, y=y, button='left',
                buttons=0 if kind == 'mouseReleased' else 1, clickCount=1,
            )  # fmt: skip

    def click(self, words):
        """Click the button with these words on it."""
        buttons = "[...document.querySelectorAll('button')]"
        number = self.run(f'{buttons}.findIndex(b => b.innerText.includes({json.dumps(words)}))')
        self.drag(*[self.place('button', number)] * 2)


@contextlib.contextmanager
def open_browser(folder):
    """Start a browser whose profile is in `folder`, and yield a page of it."""
    from websockets.sync.client import connect

    words = [CHROMIUM, f'--user-data-dir={folder}', *FLAGS]
    port_file = folder / 'DevToolsActivePort'
    with (
        open(folder / 'stderr.txt', 'w') as log,
        subprocess.Popen(words, stderr=log) as process,
    ):
        try:
            end = time.monotonic() + PATIENCE
            while not (port_file.exists() and port_file.read_text().count('\n')):
                assert process.poll() is None and time.monotonic() < end, 'Chromium does not start'
                time.sleep(0.05)
            port = port_file.read_text().split()[0]
            with urllib.request.urlopen(f'http://127.0.0.1:{port}/json') as answer:
                pages = json.load(answer)
            (address,) = (p['webSocketDebuggerUrl'] for p in pages if p['type'] == 'page')
            # No pings: a page that draws without a GPU is busy for long.
            options = {'max_size': None, 'ping_interval': None, 'max_queue': None}
            with connect(address, **options) as connection:
                yield Page(connection)
        finally:
            process.kill()
