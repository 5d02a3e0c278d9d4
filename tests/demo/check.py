"""Tests the browser demo in headless Chromium.

Uses the page of docs/demo as a visitor does: drags a goal and waits until the student has brought the cube there, moves
another one by keyboard, drops logs that the program has recorded, damaged ones among them, and computes the hash of
1,000 steps, which must be that of demo/digests.json. Prints the control steps per second.
"""

import argparse
import base64
import functools
import http.server
import json
import pathlib
import re
import shutil
import struct
import subprocess
import sys
import tempfile
import threading
import time
import zlib

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "dashboard"))

from devtools import Browser  # noqa: E402

TASKS = ["push", "pick-and-place"]
# Of 16, with room for a step at each end of the measurement.
MIN_STEPS_PER_S = 15.5
MAX_BYTES = 5_000_000
MAGIC_BYTES = 8
DATA_END, FOOTER, METADATA = 0x0F, 0x02, 0x0C


class Server(http.server.ThreadingHTTPServer):
    """Serves a directory on a free port. A context manager."""

    class Handler(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    def __init__(self, directory):
        super().__init__(("127.0.0.1", 0), functools.partial(self.Handler, directory=str(directory)))
        threading.Thread(target=self.serve_forever, daemon=True).start()
        self.url = f"http://127.0.0.1:{self.server_port}/"

    def __exit__(self, *_):
        self.shutdown()


def check_size(directory):
    n_bytes = sum(path.stat().st_size for path in directory.iterdir())
    assert n_bytes < MAX_BYTES, f"{n_bytes} bytes, expected less than {MAX_BYTES}"
    print(f"the demo has {n_bytes / 1e6:.2f} MB")


PLACE_OF = ("(arm => (box => [box.x + box.width / 2, box.y + box.height / 2])"
            "(document.getElementById(`goal-${arm}`).getBoundingClientRect()))")


# The student may reach a moved goal before a poll sees that it was not reached.
RECORD_BADGE = """
    globalThis.badgeTexts = [];
    new MutationObserver(() => badgeTexts.push(document.getElementById('badge').textContent))
        .observe(document.getElementById('badge'), { childList: true, characterData: true, subtree: true });
    true"""


def place_of(page, arm):
    """Returns where the goal of an arm is on the page."""
    return page.value(f"{PLACE_OF}({arm})")


def centimetres_right(page, arm):
    """Returns how far the goal of an arm is to the right of the centre of the table, as its label says."""
    label = page.value(f"document.getElementById('goal-{arm}').ariaLabel")
    distance, direction = re.search(r"(\d+) cm (right|left)", label).groups()
    return int(distance) * (1 if direction == "right" else -1)


def drag(page, arm, right, down):
    """Drags the goal of an arm by a number of pixels."""
    x, y = place_of(page, arm)
    mouse = functools.partial(page.call, "Input.dispatchMouseEvent", button="left", clickCount=1)
    mouse(type="mousePressed", x=x, y=y)
    for share in [0.25, 0.5, 0.75, 1.0]:
        mouse(type="mouseMoved", x=x + share * right, y=y + share * down, buttons=1)
    mouse(type="mouseReleased", x=x + right, y=y + down)


def wait_for_success(page, what):
    """Waits until both goals are reached; starts elsewhere where the student does not succeed, at most three times."""
    for attempt in range(4):
        try:
            page.wait("document.getElementById('badge').textContent === 'Both goals reached'", what, 16)
            return attempt
        except AssertionError:
            if attempt == 3:
                raise
            page.value("document.getElementById('next').click()")


def check_student(page, task):
    """The student reaches its goals, and a goal that is dragged while it acts."""
    page.value(f"document.querySelector('input[value={task}]').click()")
    page.wait("document.getElementById('badge').textContent !== 'Loading'", f"the student of {task} is loaded")
    restarts = wait_for_success(page, f"the student reaches the goals of {task}")
    before = place_of(page, 0)
    # The goals of the first arm lie from 12 cm to the left of the centre to 8 cm to the right of it: drag towards the
    # farther end.
    page.value(RECORD_BADGE)
    drag(page, 0, 70 if centimetres_right(page, 0) < -2 else -70, 0)
    page.wait(f"Math.abs({PLACE_OF}(0)[0] - {before[0]}) > 25", "the goal follows the pointer", 5)
    page.wait("badgeTexts.some(text => text !== 'Both goals reached')", "the moved goal is not reached", 2)
    n_moves = restarts + wait_for_success(page, f"the student follows a goal of {task}")
    print(f"{task}: the student reached its goals and a dragged one ({n_moves} further starts)")


def check_keyboard(page):
    """A goal moves by the arrow keys, and says where it is."""
    page.value("document.getElementById('goal-1').focus()")
    before = centimetres_right(page, 1)
    name, code, step = ("ArrowLeft", 37, -1) if before > 2 else ("ArrowRight", 39, 1)
    for _ in range(3):
        page.key(name, code)
    after = centimetres_right(page, 1)
    assert after == before + 3 * step, f"{before} cm, then {after} cm"


def steps_per_s(page, seconds=5):
    """Returns the control steps per second of wall time, from the counter of the page."""
    page.value("document.getElementById('restart').click()")
    counter = "Number(document.getElementById('steps').textContent)"
    page.wait(f"{counter} > 5", "the student acts")
    first = page.value(f"[{counter}, performance.now()]")
    time.sleep(seconds)
    last = page.value(f"[{counter}, performance.now()]")
    return 1000 * (last[0] - first[0]) / (last[1] - first[1])


def check_speed(page):
    """The page keeps up with the 16 control steps per second of its initial speed, four times that of the arms."""
    fastest = 0.0
    for _ in range(6):
        fastest = max(fastest, steps_per_s(page))
        if fastest >= MIN_STEPS_PER_S:
            break
    drawing = page.value("document.getElementById('drawing').textContent")
    assert fastest >= MIN_STEPS_PER_S, f"{fastest:.1f} control steps per second ({drawing})"
    print(f"{fastest:.1f} control steps per second; a picture is {drawing}")


def check_digests(page, directory):
    """The hash of 1,000 steps in the browser is that of every processor."""
    expected = json.loads((directory / "digests.json").read_text())
    for task in TASKS:
        page.value(f"document.querySelector('input[value={task}]').click()")
        page.wait("document.getElementById('badge').textContent !== 'Loading'", f"the student of {task} is loaded")
        page.value("document.getElementById('compute').click()")
        page.wait("!document.getElementById('digest-verdict').hidden", f"the hash of {task} is computed", 120)
        here, verdict = page.value("['digest-here', 'digest-verdict'].map(id => document.getElementById(id).textContent)")
        native = expected[f"shared-{task}"]
        assert here == native, f"{task}: {here} in Chromium, expected {native}"
        assert verdict == "Equal: 1,000 steps, every bit", verdict
        print(f"{task}: {here} in Chromium, as expected")


def drop(page, name, data):
    """Drops a file on the page, and returns what it says."""
    page.value("document.getElementById('verdict').hidden = true")
    page.value(f"""(text => {{
        const bytes = Uint8Array.from(atob(text), it => it.charCodeAt(0));
        const files = new DataTransfer();
        files.items.add(new File([bytes], {json.dumps(name)}));
        dispatchEvent(new DragEvent('drop', {{ dataTransfer: files, bubbles: true, cancelable: true }}));
    }})({json.dumps(base64.b64encode(data).decode())})""")
    page.wait("!document.getElementById('verdict').hidden", f"{name} is read", 60)
    return page.value("document.getElementById('verdict').textContent")


def with_metadata(log, **changes):
    """Returns a valid log whose metadata have other values."""
    parts, at = [log[:MAGIC_BYTES]], MAGIC_BYTES
    while at < len(log) - MAGIC_BYTES:
        opcode, (size,) = log[at], struct.unpack_from("<Q", log, at + 1)
        body = log[at + 9:at + 9 + size]
        at += 9 + size
        if opcode == METADATA:
            body = changed(body, {key.encode(): value.encode() for key, value in changes.items()})
        elif opcode == DATA_END:
            body = bytes(4)  # No checksum of the data.
        elif opcode == FOOTER:
            body = body[:16] + bytes(4)  # No checksum of the summary.
        parts.append(struct.pack("<BQ", opcode, len(body)) + body)
    return b"".join(parts) + log[at:]


def changed(metadata, changes):
    """Returns a metadata record with other values, and the checksum that `tandem` gives them."""
    def text(at):
        size, = struct.unpack_from("<I", metadata, at)
        return metadata[at + 4:at + 4 + size], at + 4 + size

    name, at = text(0)
    at, entries = at + 4, {}
    while at < len(metadata):
        key, at = text(at)
        entries[key], at = text(at)
    entries.update(changes)
    checksum = 0
    for key in sorted(set(entries) - {b"checksum"}):
        for part in [key, entries[key]]:
            checksum = zlib.crc32(b"\xff", zlib.crc32(part, checksum))
    entries[b"checksum"] = f"{checksum:08x}".encode()

    def field(part):
        return struct.pack("<I", len(part)) + part

    pairs = b"".join(field(key) + field(value) for key, value in entries.items())
    return field(name) + struct.pack("<I", len(pairs)) + pairs


def record(program, directory):
    """Records an episode of each task, one of a single arm, and a trial."""
    logs = {}
    for policy in ["student-push", "student-pick-and-place", "teacher-push"]:
        path = directory / f"{policy}.mcap"
        subprocess.run([program, "eval", "--policy", ROOT / "policies" / f"{policy}.safetensors", "--episodes", "1",
                        "--record", path], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        logs[policy] = path.read_bytes()
    trial = directory / "trial"
    subprocess.run([program, "bridge", "trial", "--policy", ROOT / "policies/student-push.safetensors", "--trials", "1",
                    "--record", "all", "--out", trial], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    logs["trial"] = next(trial.rglob("*.mcap")).read_bytes()
    return logs


def check_logs(page, logs):
    """Logs are simulated again and compared; what cannot be is refused in one line."""
    for name in ["student-push", "student-pick-and-place", "teacher-push"]:
        verdict = drop(page, f"{name}.mcap", logs[name])
        assert verdict == "50 of 50 steps equal bit for bit", f"{name}: {verdict}"
        page.wait("Number(document.getElementById('position').value) > 5", "the episode plays")
        print(f"{name}.mcap: {verdict}")
    page.value("document.getElementById('back').click()")
    log = logs["student-push"]
    altered = bytearray(log)
    altered[len(log) // 2] ^= 1
    refusals = {
        "other seed": (with_metadata(log, seed="12345"), r"0 of 50 steps equal, then step 0: observation\[\d+\] is \S+ in the log, \S+ "
                                             r"when simulated again"),
        "other task": (with_metadata(log, format="2", task="lab/push"),
                       'the log is of task "lab/push", which only its own environments can simulate again'),
        "truncated": (log[:len(log) // 2], "the file is damaged or incomplete: .*"),
        "one bit altered": (bytes(altered), "the file is damaged or incomplete: .*"),
        "empty": (b"", "the file is not an MCAP file"),
        "a picture": (b"\x89PNG\r\n\x1a\n" + bytes(100), "the file is not an MCAP file"),
        "a trial": (logs["trial"], "the file is the log of a trial, not of an episode: .*"),
    }
    for name, (data, expected) in refusals.items():
        verdict = drop(page, f"{name}.mcap", data).removeprefix(f"{name}.mcap: ")
        assert re.fullmatch(expected, verdict), f"{name}: {verdict!r}"
        print(f"{name}: {verdict}")
        page.value("document.getElementById('back').click()")
    page.wait("document.getElementById('title').textContent === 'The student'", "the student is back")


def check_without_student(browser, demo, directory, log):
    """A page that cannot load its student says so, offers none of its controls, and plays a log."""
    shutil.copytree(demo, directory, ignore=shutil.ignore_patterns("student-*"))
    with Server(directory) as server:
        page = browser.open(server.url)
        page.wait("document.getElementById('badge').textContent === 'Not loaded'", "the page has no student")
        controls = "['play', 'restart', 'next', 'compute'].every(id => document.getElementById(id).disabled)"
        assert page.value(controls), "controls without a student"
        verdict = drop(page, "student-push.mcap", log)
        assert verdict == "50 of 50 steps equal bit for bit", verdict
        page.wait("Number(document.getElementById('position').value) > 5", "the episode plays")
        page.wait("(it => it.getContext('2d').getImageData(0, 0, it.width, it.height).data.some(part => part > 0))"
                  "(document.getElementById('canvas'))", "the episode is drawn")
        page.value("document.getElementById('back').click()")
        assert page.value("document.getElementById('badge').textContent") == "Not loaded"
        errors = [error for error in page.errors if "404" not in str(error)]
        assert not errors, errors
        print("without a student, a log is played")


def check_layout(page):
    """Nothing overflows or is cut off, and everything has a name."""
    for width in page.layouts():
        cut = page.value("[...document.querySelectorAll('.controls *, .card *')].filter(it => it.checkVisibility() && "
                         "!it.matches('.visually-hidden') && it.getBoundingClientRect().right > "
                         "it.closest('section').getBoundingClientRect().right).map(it => it.id || it.tagName)")
        assert cut == [], f"cut off at {width} px: {cut}"
    page.check_names()


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--program", type=pathlib.Path, required=True)
    parser.add_argument("--demo", type=pathlib.Path, default=ROOT / "docs" / "demo")
    parser.add_argument("--pictures", type=pathlib.Path)
    args = parser.parse_args()
    began = time.monotonic()
    check_size(args.demo)
    with tempfile.TemporaryDirectory() as directory, Server(args.demo) as server, Browser() as browser:
        logs = record(args.program.resolve(), pathlib.Path(directory))
        page = browser.open(server.url)
        page.resize(1280, 900)
        page.wait("document.getElementById('badge').textContent !== 'Loading'", "the page is ready")
        check_speed(page)
        for task in TASKS:
            check_student(page, task)
            page.take_pictures(args.pictures, task, pause_s=0.6)
        check_keyboard(page)
        check_logs(page, logs)
        if args.pictures:
            drop(page, "student-pick-and-place.mcap", logs["student-pick-and-place"])
            page.take_pictures(args.pictures, "log", pause_s=0.6)
            page.value("document.getElementById('back').click()")
        check_without_student(browser, args.demo, pathlib.Path(directory, "demo"), logs["student-push"])
        page.show()
        check_layout(page)
        check_digests(page, args.demo)
        page.take_pictures(args.pictures, "digest", pause_s=0.6)
        assert not page.errors, page.errors
    print(f"the demo passed in {time.monotonic() - began:.0f} s")


if __name__ == "__main__":
    sys.exit(main())
