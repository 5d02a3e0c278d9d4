"""Tests the operator page of a bridge in headless Chromium.

Starts a bridge with a simulated pair and uses its page as an operator does: the arms move on the page during a motion,
the stop button stops the motion within a second and the page shows the cause, the keyboard reaches the button first,
another page cannot press it, a confirmation disappears with the reset, an injected fault is shown, values that arrive
late count as old, a page whose address another one has taken is loaded again, nothing overflows on a phone, scripts
have no errors. Prints the times that it measured.
"""

import argparse
import json
import pathlib
import re
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request

from devtools import Browser, ended_after

MOTION = pathlib.Path(__file__).resolve().parents[2] / "deploy" / "first-motion.json"
# The causes of stops that a busy machine may produce.
BUSY = ["late", "owner-silent", "state-old", "state-stale", "command-lost", "drive-fault"]
SHAPES = "document.getElementById('view-side').innerHTML"
CONFIRMED = "document.getElementById('stop-result').classList.contains('confirmed')"


class Bridge:
    """A bridge with a simulated pair and a page. A context manager."""

    def __init__(self, program):
        self.program = str(program)
        command = [self.program, "bridge", "--driver", "sim", "--listen", "127.0.0.1:0"]
        self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                                        stderr=subprocess.PIPE, text=True)
        self.url, self.lines = None, []
        with ended_after(self.process, "the address of its page"):
            self.address = self.process.stdout.readline().strip().rpartition(" ")[2]
            for line in self.process.stderr:
                self.lines.append(line)
                if found := re.search(r"dashboard on (http://\S+/)", line):
                    self.url = found[1]
                    break
        assert self.url and self.address, "the bridge ended without a page: " + "".join(self.lines)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()

    def run(self, *words):
        command = [self.program, "bridge", *words, "--connect", self.address]
        return subprocess.run(command, capture_output=True, text=True, timeout=60)

    def status(self):
        return json.loads(self.run("status", "--json").stdout)

    def reset(self):
        for _ in range(100):
            ended = self.run("reset")
            if ended.returncode == 0 or "not stopped but Idle" in ended.stderr:
                return
            time.sleep(0.05)
        raise AssertionError(ended.stderr)

    def move(self):
        command = [self.program, "bridge", "move", str(MOTION), "--speed", "0.1", "--connect", self.address]
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


class Slow(AssertionError):
    """The page was slower than a machine with free processors allows."""


def with_motion(bridge, page, check):
    """Calls `check` during a motion; again with another motion if a busy machine has stopped it or slowed the page."""
    n_slow = 0
    for _ in range(10):
        bridge.reset()
        mover = bridge.move()
        try:
            page.wait("document.getElementById('motion-text').textContent.includes('first-motion.json')", "a motion is shown")
            return check(mover)
        except Slow:
            n_slow += 1
            if n_slow == 3:
                raise
        except AssertionError:
            if bridge.status()["stopped"] is None or bridge.status()["stopped"]["name"] not in BUSY:
                raise
        finally:
            mover.kill()
            mover.communicate()
    raise AssertionError("the machine is too busy")


def check_motion(page, _mover):
    """The arms move on the page, several times a second, and the progress grows."""
    page.value("window.shown = []; new MutationObserver(() => window.shown.push([performance.now(), "
               "document.getElementById('view-side').innerHTML])).observe(document.getElementById('view-side'), "
               "{ childList: true })")
    progress = "Number(document.getElementById('progress').getAttribute('aria-valuenow'))"
    before = page.value(progress)
    page.wait(f"{progress} > {before} + 8", "the motion progresses", 20)
    shown = page.value("window.shown")
    seconds = (shown[-1][0] - shown[0][0]) / 1000
    pictures = len({picture for _, picture in shown})
    longest = max(b[0] - a[0] for a, b in zip(shown, shown[1:])) / 1000
    print(f"{pictures / seconds:.1f} different pictures of the arms per second, longest pause {longest:.2f} s")
    if pictures / seconds < 5 or longest >= 1:
        raise Slow(pictures, seconds, longest)
    assert page.value("document.querySelectorAll('#view-above .planned').length") == 2
    check_times(page)


def check_times(page):
    """The progress is in seconds on the clock, and the three times fit together."""
    text = page.value("document.getElementById('motion-text').textContent")
    found = re.search(r": ([\d.]+) of ([\d.]+) s at speed ([\d.]+), about (\d+):(\d\d) left", text)
    assert found, text
    played_s, duration_s, _, minutes, seconds = map(float, found.groups())
    assert abs(played_s + 60 * minutes + seconds - duration_s) <= 1.2, text


def check_stop(page, bridge, mover, press, how):
    """The button stops the motion within a second, and the page shows the cause."""
    n_stops = "document.getElementById('log').textContent.split('a client stopped the arms').length"
    before = page.value(n_stops)
    began = time.monotonic()
    press()
    page.wait("document.getElementById('phase').textContent === 'stopped'", "the page shows the stop", 5)
    page.wait(CONFIRMED, "the page confirms the stop", 5)
    shown_s = time.monotonic() - began
    status = bridge.status()
    assert status["phase"] == "stopped" and status["stopped"]["name"] == "requested", status
    _, errors = mover.communicate(timeout=10)
    assert mover.returncode == 75 and "a client stopped the arms" in errors, (mover.returncode, errors)
    last = page.value("document.getElementById('last-stop').textContent")
    assert "a client stopped the arms (requested)" in last, last
    result = page.value("document.getElementById('stop-result').textContent")
    assert result.startswith("Stopped at ") and "a client stopped the arms" in result, result
    page.wait(f"{n_stops} > {before}", "the stop is among the events", 5)
    if shown_s >= 1:
        raise Slow(shown_s)
    print(f"a stop by {how} was confirmed on the page after {shown_s:.2f} s")


def check_drill(page, bridge):
    """An injected fault is a tile until it is cleared."""
    shown = "document.getElementById('tiles').textContent.includes('contact, arm 1')"
    assert bridge.run("inject", "contact", "--arm", "1").returncode == 0
    page.wait(shown, "the page shows the injected fault", 5)
    assert bridge.run("inject", "--clear").returncode == 0
    page.wait(f"!{shown}", "the page shows that the fault was cleared", 5)


def check_tab(page):
    """The Tab key reaches the button first."""
    page.key("Tab", 9)
    assert page.value("document.activeElement?.id") == "stop", page.value("document.activeElement?.outerHTML")


def check_foreign_page(bridge):
    """A page of another server cannot press the button, and nobody can reset the arms here."""
    def post(path, headers):
        request = urllib.request.Request(bridge.url + path, data=b"", headers=headers, method="POST")
        try:
            with urllib.request.urlopen(request, timeout=10) as answer:
                return answer.status
        except urllib.error.HTTPError as error:
            return error.code

    assert post("stop", {"Origin": "http://evil.example", "x-tandem-action": "stop"}) == 403
    assert post("stop", {}) == 403
    assert post("stop", {"Host": "evil.example", "x-tandem-action": "stop"}) == 421
    assert post("reset", {"x-tandem-action": "reset"}) == 404
    stopped = bridge.status()["stopped"]
    assert stopped is None or stopped["name"] in BUSY, stopped


def check_layout(page):
    """Nothing overflows, everything has a name, and the button stays in view."""
    for _ in page.layouts(640):
        page.value("scrollTo(0, document.body.scrollHeight)")
        place = page.value("(box => [box.top, box.bottom, innerHeight])(document.getElementById('stop').getBoundingClientRect())")
        assert 0 <= place[0] and place[1] <= place[2], place
        page.value("scrollTo(0, 0)")
    page.check_names()


def check_late_states(page):
    """A state that was on its way for long is old, and a connection of which all are late is opened again."""
    ages_s, n_open, times_s = page.value("""import('/assets/common.js').then(({ follow }) => {
      const [streams, shown, ages_s, n_open, real] = [[], [], [], [], window.EventSource];
      window.EventSource = class {
        constructor() { streams.push(this); }
        addEventListener() {}
        close() {}
      };
      const { ageOfState } = follow((state) => shown.push(state.time_s), () => {}, (state) => 1000 * state.time_s);
      const began_s = performance.now() / 1000;
      for (const delay_s of [0.5, 0, 2, 4, 7, 7, 7.5]) {
        streams.at(-1).onmessage({ data: JSON.stringify({ time_s: began_s - delay_s }) });
        ages_s.push(ageOfState() / 1000);
        n_open.push(streams.length);
      }
      window.EventSource = real;
      return [ages_s, n_open, shown.map((time_s) => began_s - time_s)];
    })""")
    # The last two came over a new connection, on which 7 s is the least difference of the clocks that is known.
    expected_s = [0, 0, 2, 4, 7, 0, 0.5]
    assert all(0 <= age - expected < 0.3 for age, expected in zip(ages_s, expected_s, strict=True)), ages_s
    assert n_open == [1, 1, 1, 1, 2, 2, 2], n_open
    assert len(times_s) == 7, "a late state is shown too"


def check_other_page(page):
    """A page loads itself again if its stream is that of another page, and only then."""
    send = ("import('/assets/common.js').then(({{ follow }}) => {{ window.former = true; const real = window.EventSource; "
            "window.EventSource = class {{ constructor() {{ this.heard = {{}}; window.stream = this; }} close() {{}} "
            "addEventListener(name, act) {{ this.heard[name] = act; }} }}; follow(() => {{}}, () => {{}}); "
            "window.EventSource = real; window.stream.heard.page({{ data: {} }}); }})")
    page.value(send.format("document.documentElement.dataset.page"))
    time.sleep(0.5)
    assert page.value("window.former") is True
    page.value(send.format("'another'"))
    page.wait("window.former === undefined && document.getElementById('link')?.textContent === 'live'", "it is loaded again")


def switch_hidden(page, is_hidden):
    """Hides the page, or shows it again."""
    page.value(f"Object.defineProperty(document, 'hidden', {{ value: {str(is_hidden).lower()}, configurable: true }}); "
               "void document.dispatchEvent(new Event('visibilitychange'))")


def check_hidden(page):
    """A hidden page leaves its connection to others, and has a new one when it is visible again."""
    link = "document.getElementById('link').textContent"
    switch_hidden(page, True)
    page.wait(f"{link}.includes('no connection') && document.title.startsWith('No connection')", "the page rests", 10)
    switch_hidden(page, False)
    page.wait(f"{link} === 'live' && !document.title.startsWith('No')", "the page is live again", 5)


def check_reset_unseen(page, bridge):
    """The confirmation of a stop disappears even if the page has seen neither the stop nor the reset that ended it."""
    link = "document.getElementById('link').textContent"
    phase = "document.getElementById('phase').textContent"
    bridge.reset()
    page.wait(f"{phase} === 'idle'", "the arms are idle", 5)
    switch_hidden(page, True)
    page.wait(f"{link}.includes('no connection')", "the page rests", 10)
    page.value("void document.getElementById('stop').click()")
    page.wait(CONFIRMED, "the page confirms the stop", 5)
    bridge.reset()
    switch_hidden(page, False)
    page.wait(f"{link} === 'live'", "the page is live again", 5)
    # A busy machine may stop the arms again.
    page.wait(f"!{CONFIRMED} || {phase} === 'stopped'", "the confirmation disappears", 5)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--program", type=pathlib.Path, required=True)
    parser.add_argument("--pictures", type=pathlib.Path)
    args = parser.parse_args()
    began = time.monotonic()
    with Browser() as browser, Bridge(args.program.resolve()) as bridge:
        page = browser.open(bridge.url)
        page.resize(1280, 900)
        page.wait("document.getElementById('last-stop').textContent.includes('not reset')", "the page shows the arms")
        check_tab(page)
        bridge.reset()
        page.wait("document.getElementById('last-stop-time').textContent.includes('reset since') || "
                  "!document.getElementById('last-stop').textContent.includes('not reset')", "the reset is shown", 5)
        check_foreign_page(bridge)

        def by_mouse(mover):
            check_motion(page, mover)
            page.take_pictures(args.pictures, "bridge-moving")
            check_stop(page, bridge, mover, lambda: page.value("void document.getElementById('stop').click()"), "click")

        def by_keyboard(mover):
            page.value("document.getElementById('stop').focus()")
            check_stop(page, bridge, mover, lambda: page.key("Enter", 13, "\r"), "keyboard")

        with_motion(bridge, page, by_mouse)
        page.take_pictures(args.pictures, "bridge-stopped")
        with_motion(bridge, page, by_keyboard)
        check_drill(page, bridge)
        check_layout(page)
        other = browser.open(bridge.url)
        check_late_states(other)
        check_other_page(other)
        page.show()
        check_hidden(page)
        check_reset_unseen(page, bridge)
        bridge.process.send_signal(signal.SIGTERM)
        page.wait("document.getElementById('link').textContent.includes('no connection')", "the end is shown", 10)
        assert bridge.process.wait(20) == 0
        page.value("document.getElementById('stop').focus()")
        page.key("Enter", 13, "\r")
        page.wait("document.getElementById('stop-result').textContent.includes('Use the emergency stop')", "a failed stop is shown", 10)
        page.take_pictures(args.pictures, "bridge-gone")
        expected = ["ERR_CONNECTION_REFUSED", "ERR_INCOMPLETE_CHUNKED_ENCODING", "ERR_CONNECTION_RESET", "ERR_EMPTY_RESPONSE"]
        errors = [error for error in page.errors if not any(known in str(error) for known in expected)]
        assert not errors, errors
    print(f"the page of the bridge passed in {time.monotonic() - began:.0f} s")


if __name__ == "__main__":
    sys.exit(main())
