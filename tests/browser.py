"""A browser without a window and without a network, for tests; they skip where none is installed."""

import base64
import json
import shutil
import subprocess
import time
import urllib.request

import cv2
import numpy as np
import pytest
from websockets.sync.client import connect

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
QUIET = ("--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-quic", "--no-first-run")
# WebGL without a graphics card.
DRAWN_BY_SOFTWARE = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
# Seconds for a page to do what a test waits for: a busy machine draws a frame in some seconds.
PATIENCE = 120


def _alone(folder):
    """The command of a browser that has no window, no network and no past."""
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        pytest.skip(f"no browser: install one of {', '.join(BROWSERS)}")
    alone = ["--headless", "--no-sandbox", f"--user-data-dir={folder / 'profile'}", "--host-resolver-rules=MAP * ~NOTFOUND"]
    return [program, *alone, *QUIET, "--hide-scrollbars"]


@pytest.fixture
def browser(tmp_path):
    """`browser(path, "--screenshot=...")`: standard output and error of a browser that opens the page."""

    def call(path, *options):
        command = [*_alone(tmp_path), "--disable-gpu", "--enable-logging=stderr", "--virtual-time-budget=5000", *options, path.as_uri()]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout, done.stderr

    return call


class Tab:
    """An open page that a test plays with, by the DevTools protocol.

    Attributes:
        events: what the page reported: console messages, exceptions and requests.
    """

    def __init__(self, address):
        self.socket, self.calls, self.events = connect(address, max_size=None), 0, []

    def call(self, method, **parameters):
        self.calls += 1
        self.socket.send(json.dumps({"id": self.calls, "method": method, "params": parameters}))
        while (message := json.loads(self.socket.recv(timeout=PATIENCE))).get("id") != self.calls:
            self.events.append(message)
        assert "error" not in message, message
        return message["result"]

    def value(self, script):
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def until(self, script):
        """Wait until a script gives something, and return that."""
        end = time.monotonic() + PATIENCE
        while not (found := self.value(script)):
            assert time.monotonic() < end, f"never true: {script}"
            time.sleep(0.1)
        return found

    def click(self, x, y):
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def press(self, code, key):
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, code=code, key=key)

    def picture(self):
        content = base64.b64decode(self.call("Page.captureScreenshot")["data"])
        return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)

    def still(self):
        """The picture as soon as it no longer changes."""
        before, end = self.picture(), time.monotonic() + PATIENCE
        while True:
            time.sleep(1)
            after = self.picture()
            if np.array_equal(before, after):
                return after
            assert time.monotonic() < end, "the picture never stands still"
            before = after

    def faults(self):
        """Errors that the page reported, and addresses that it asked for outside of itself."""
        said = [each["params"] for each in self.events if each["method"] == "Runtime.consoleAPICalled"]
        found = [str(each["args"]) for each in said if each["type"] in ("error", "assert")]
        found += [str(each["params"]) for each in self.events if each["method"] in ("Runtime.exceptionThrown", "Log.entryAdded")]
        asked = [each["params"]["request"]["url"] for each in self.events if each["method"] == "Network.requestWillBeSent"]
        return found + [url for url in asked if not url.startswith(("file:", "data:", "blob:"))]


@pytest.fixture
def tab(tmp_path):
    """`tab(path)`: a page, opened in a browser that draws WebGL by software."""
    opened = []

    def call(path, size=(1000, 700)):
        port = tmp_path / "profile" / "DevToolsActivePort"
        options = ["--remote-debugging-port=0", f"--window-size={size[0]},{size[1]}", "about:blank"]
        program = subprocess.Popen([*_alone(tmp_path), *DRAWN_BY_SOFTWARE, *options], stderr=subprocess.DEVNULL)
        opened.append((program, None))
        end = time.monotonic() + PATIENCE
        while not (port.is_file() and "/" in port.read_text(encoding="utf-8")):
            assert program.poll() is None and time.monotonic() < end, "the browser does not start"
            time.sleep(0.1)
        number = port.read_text(encoding="utf-8").split()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{number}/json") as answer:
            address = next(each["webSocketDebuggerUrl"] for each in json.load(answer) if each["type"] == "page")
        page = Tab(address)
        opened[-1] = program, page
        for domain in ("Page", "Runtime", "Log", "Network"):
            page.call(f"{domain}.enable")
        page.call("Page.navigate", url=path.as_uri())
        return page

    yield call
    for program, page in opened:
        if page is not None:
            page.socket.close()
        program.terminate()
        program.wait()
