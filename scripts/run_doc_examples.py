"""Runs the Python examples of Markdown files, each block in a process of its own, in the repository's root.

    python scripts/run_doc_examples.py README.md docs/*.md

A comment in the line above a block changes how it is run:

    <!-- example: with tandem teacher --listen 127.0.0.1:7001 ... -->   starts a server for the block
    <!-- example: needs torch -->                                       skips the block without this module

A server's command has the program of this repository in its path and a temporary directory in `$WORK`. Exits with 1 if
an example fails.
"""

import contextlib
import importlib.util
import os
import re
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"(?:^<!-- example: (with|needs) (.*?) -->\n)?^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LISTEN = re.compile(r"--listen (\S+):(\d+)")
TIMEOUT_S = 300
START_TIMEOUT_S = 30


def main(paths: list[str]) -> int:
    n_failed = 0
    for path in paths:
        text = Path(path).read_text()
        for match in BLOCK.finditer(text):
            place = f"{path}:{text.count(chr(10), 0, match.start(3))}"
            if match[1] == "needs" and importlib.util.find_spec(match[2]) is None:
                print(f"{place}: skipped, needs {match[2]}")
                continue
            with server(match[2]) if match[1] == "with" else contextlib.nullcontext():
                n_failed += not runs(place, match[3])
    return 1 if n_failed else 0


@contextlib.contextmanager
def server(command: str):
    """Runs a command until the block is left, and enters it once the address after `--listen` accepts connections."""
    host, port = LISTEN.search(command).groups()
    with tempfile.TemporaryDirectory() as directory:
        programs = ROOT / os.environ.get("CARGO_TARGET_DIR", "target") / "release"
        path = f"{programs}:{os.environ['PATH']}"
        environment = {**os.environ, "PATH": path, "WORK": directory}
        process = subprocess.Popen(["bash", "-c", f"exec {command}"], cwd=ROOT, env=environment)
        try:
            deadline = time.monotonic() + START_TIMEOUT_S
            while not accepts(host, int(port)):
                if process.poll() is not None or time.monotonic() > deadline:
                    raise SystemExit(f"no server at {host}:{port}: {command}")
                time.sleep(0.1)
            yield
        finally:
            process.terminate()
            process.wait(TIMEOUT_S)


def accepts(host: str, port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection((host, port), timeout=1):
        return True
    return False


def runs(place: str, code: str) -> bool:
    """Runs a block and prints its place with the outcome."""
    with tempfile.TemporaryDirectory() as directory:
        script = Path(directory, "example.py")
        script.write_text(code)
        command = [sys.executable, "-W", "error", str(script)]
        try:
            result = subprocess.run(
                command, cwd=ROOT, timeout=TIMEOUT_S, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
            )
            output, is_good = result.stdout, result.returncode == 0
        except subprocess.TimeoutExpired:
            output, is_good = f"no end within {TIMEOUT_S} s", False
    print(f"{place}: {'ok' if is_good else 'failed'}", flush=True)
    if not is_good:
        print(output)
    return is_good


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
