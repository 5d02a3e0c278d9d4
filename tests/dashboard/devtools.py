"""A page in headless Chromium, driven over the DevTools protocol. Needs the standard library only."""

import base64
import contextlib
import json
import os
import pathlib
import shutil
import socket
import struct
import subprocess
import tempfile
import threading
import time
import urllib.request

# Time within which a program prints the address of its page, on a busy machine too.
START_S = 120


@contextlib.contextmanager
def ended_after(process, what, seconds=START_S):
    """Kills a process that has not printed `what` within `seconds`, which ends reading from its pipes."""
    expired = threading.Event()

    def end():
        expired.set()
        process.kill()

    timer = threading.Timer(seconds, end)
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
    if expired.is_set():
        raise AssertionError(f"not within {seconds} s: {process.args[1]} prints {what}")


class Browser:
    """Chromium without a window. A context manager."""

    def __enter__(self):
        self.profile = tempfile.mkdtemp()
        flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
                 "--hide-scrollbars", "--remote-debugging-port=0", f"--user-data-dir={self.profile}"]
        self.process = subprocess.Popen(["chromium", *flags, "about:blank"], stdout=subprocess.DEVNULL,
                                        stderr=subprocess.DEVNULL)
        port_file = pathlib.Path(self.profile, "DevToolsActivePort")
        deadline = time.monotonic() + 60
        while not (port_file.exists() and "\n" in port_file.read_text()):
            if time.monotonic() > deadline or self.process.poll() is not None:
                raise RuntimeError("Chromium does not start")
            time.sleep(0.05)
        self.port = int(port_file.read_text().split()[0])
        return self

    def __exit__(self, *_):
        self.process.terminate()
        self.process.wait()
        shutil.rmtree(self.profile, ignore_errors=True)

    def open(self, url):
        """Opens a page in a tab of its own."""
        request = urllib.request.Request(f"http://127.0.0.1:{self.port}/json/new?about:blank", method="PUT")
        with urllib.request.urlopen(request, timeout=30) as answer:
            target = json.load(answer)
        return Page(target["webSocketDebuggerUrl"], url)


class Page:
    """A tab. `errors` collects exceptions of scripts, failed requests and violations of the content policy."""

    def __init__(self, debugger, url):
        self.errors = []
        self.n_sent = 0
        self.socket = WebSocket(debugger)
        for domain in ["Page", "Runtime", "Log"]:
            self.call(f"{domain}.enable")
        self.call("Page.navigate", url=url)
        self.wait("location.href !== 'about:blank' && document.readyState === 'complete'", f"{url} is loaded")

    def call(self, method, **params):
        self.n_sent += 1
        self.socket.send(json.dumps({"id": self.n_sent, "method": method, "params": params}))
        while True:
            message = json.loads(self.socket.receive())
            self.note(message)
            if message.get("id") == self.n_sent:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error']}")
                return message["result"]

    def note(self, message):
        params = message.get("params", {})
        if message.get("method") == "Runtime.exceptionThrown":
            self.errors.append(params["exceptionDetails"].get("exception", params["exceptionDetails"]))
        if message.get("method") == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.errors.append(params["entry"]["text"] + " " + params["entry"].get("url", ""))

    def value(self, expression):
        """Returns the value of a JavaScript expression, of its promise if it is one."""
        result = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in result:
            raise RuntimeError(f"{expression}: {result['exceptionDetails']}")
        return result["result"].get("value")

    def wait(self, expression, what, seconds=30):
        """Waits until an expression is true, and returns its value."""
        deadline = time.monotonic() + seconds
        while not (value := self.value(expression)):
            if time.monotonic() > deadline:
                raise AssertionError(f"not within {seconds} s: {what}")
            time.sleep(0.1)
        return value

    def show(self):
        """Brings the tab to the front, which hides the others."""
        self.call("Page.bringToFront")

    def resize(self, width, height, dark=False):
        scheme = "dark" if dark else "light"
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 500)
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        time.sleep(0.4)

    def key(self, name, code, text=""):
        for kind in ["keyDown", "keyUp"]:
            self.call("Input.dispatchKeyEvent", type=kind, key=name, code=name, windowsVirtualKeyCode=code, text=text)

    def picture(self, path):
        """Writes a picture of the whole page."""
        size = self.call("Page.getLayoutMetrics")["cssContentSize"]
        clip = {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 1}
        shot = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=True, clip=clip)
        pathlib.Path(path).write_bytes(base64.b64decode(shot["data"]))

    def take_pictures(self, directory, name, pause_s=0.0):
        """Writes pictures in light, in dark and on a phone, unless `directory` is None."""
        if directory:
            directory.mkdir(parents=True, exist_ok=True)
            for label, width, dark in [("light", 1280, False), ("dark", 1280, True), ("phone", 360, False)]:
                self.resize(width, 900, dark)
                time.sleep(pause_s)
                self.picture(directory / f"{name}-{label}.png")
            self.resize(1280, 900)

    def layouts(self, height=800):
        """Yields the width of a phone, a tablet and a laptop, in both colour schemes; nothing may overflow."""
        for width in [360, 768, 1280]:
            for dark in [False, True]:
                self.resize(width, height, dark)
                overflow = self.value("document.documentElement.scrollWidth - document.documentElement.clientWidth")
                assert overflow <= 0, f"{overflow} px too wide at {width} px"
                yield width
        self.resize(1280, 900)

    def check_names(self):
        """Everything that can be operated or is a picture has a name for screen readers, and the page has one title."""
        names = self.value("[...document.querySelectorAll('button, input, select, canvas, svg[role=img]')]"
                           ".filter(it => it.checkVisibility() && !(it.ariaLabel || it.getAttribute('aria-labelledby') || "
                           "it.textContent.trim() || it.labels?.length)).map(it => it.id)")
        assert names == [], f"without a name: {names}"
        assert self.value("document.querySelectorAll('h1').length") == 1


class WebSocket:
    """A client that sends and receives texts."""

    def __init__(self, url):
        host, _, path = url.removeprefix("ws://").partition("/")
        name, _, port = host.partition(":")
        self.stream = socket.create_connection((name, int(port)), timeout=60)
        key = base64.b64encode(os.urandom(16)).decode()
        head = [f"GET /{path} HTTP/1.1", f"Host: {host}", "Upgrade: websocket", "Connection: Upgrade",
                f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Version: 13", "", ""]
        self.stream.sendall("\r\n".join(head).encode())
        self.buffer = b""
        while b"\r\n\r\n" not in self.buffer:
            self.buffer += self.stream.recv(4096)
        head, _, self.buffer = self.buffer.partition(b"\r\n\r\n")
        assert b" 101 " in head.split(b"\r\n")[0], head

    def send(self, text):
        data, mask = text.encode(), os.urandom(4)
        size = len(data)
        if size < 126:
            head = struct.pack(">BB", 0x81, 0x80 | size)
        elif size < 1 << 16:
            head = struct.pack(">BBH", 0x81, 0x80 | 126, size)
        else:
            head = struct.pack(">BBQ", 0x81, 0x80 | 127, size)
        masked = bytes(byte ^ mask[idx % 4] for idx, byte in enumerate(data))
        self.stream.sendall(head + mask + masked)

    def receive(self):
        text = b""
        while True:
            first, second = self.read(2)
            size = second & 0x7F
            if size == 126:
                size = struct.unpack(">H", self.read(2))[0]
            elif size == 127:
                size = struct.unpack(">Q", self.read(8))[0]
            data = self.read(size)
            if first & 0x0F in (0, 1):
                text += data
                if first & 0x80:
                    return text.decode()
            elif first & 0x0F == 8:
                raise RuntimeError("Chromium closed the connection")

    def read(self, n):
        while len(self.buffer) < n:
            more = self.stream.recv(1 << 16)
            if not more:
                raise RuntimeError("Chromium is gone")
            self.buffer += more
        data, self.buffer = self.buffer[:n], self.buffer[n:]
        return data
