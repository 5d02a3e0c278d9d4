"""Runs the Python examples of Markdown files, each block in a process of its own, in the repository's root.

    python scripts/run_doc_examples.py README.md docs/*.md

Comments in the lines above a block change how it is run:

    <!-- example: with tandem teacher --listen 127.0.0.1:7001 ... -->   starts a server for the block
    <!-- example: needs torch -->                                       skips the block without this module
    <!-- example: where NAME=VALUE, NAME=VALUE -->                      replaces names in the block

Servers and blocks have the program of this repository in their path. In a server's command and in values `$WORK` is a
temporary directory. Exits with 1 if an example fails.
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
# A comment ends at the first "-->", so that one of an earlier block is not taken for one of this block.
BLOCK = re.compile(r"((?:^<!-- example: (?:(?!-->).)* -->\n)*)^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
COMMENT = re.compile(r"<!-- example: (with|needs|where) (.*?) -->")
LISTEN = re.compile(r"--listen (\S+):(\d+)")
TIMEOUT_S = 300
START_TIMEOUT_S = 30


def main(paths: list[str]) -> int:
    n_failed = 0
    for path in paths:
        text = Path(path).read_text()
        for match in BLOCK.finditer(text):
            place = f"{path}:{text.count(chr(10), 0, match.start(2))}"
            comments = dict(COMMENT.findall(match[1]))
            module = comments.get("needs")
            if module and importlib.util.find_spec(module) is None:
                print(f"{place}: skipped, needs {module}")
                continue
            with server(comments["with"]) if "with" in comments else contextlib.nullcontext():
                n_failed += not runs(place, match[2], comments.get("where"))
    return 1 if n_failed else 0


def with_programs() -> dict[str, str]:
    """Returns the environment variables of a process that finds the program of this repository."""
    programs = ROOT / os.environ.get("CARGO_TARGET_DIR", "target") / "release"
    return {**os.environ, "PATH": f"{programs}:{os.environ['PATH']}"}


@contextlib.contextmanager
def server(command: str):
    """Runs a command until the block is left, and enters it once the address after `--listen` accepts connections."""
    host, port = LISTEN.search(command).groups()
    with tempfile.TemporaryDirectory() as directory:
        environment = {**with_programs(), "WORK": directory}
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


def runs(place: str, code: str, where: str | None) -> bool:
    """Runs a block and prints its place with the outcome."""
    with tempfile.TemporaryDirectory() as directory:
        for pair in re.split(r",\s+", where) if where else ():
            name, value = pair.split("=", 1)
            if name not in code:
                raise SystemExit(f"{place}: the block has no {name!r}")
            code = code.replace(name, value.replace("$WORK", directory))
        script = Path(directory, "example.py")
        script.write_text(code)
        command = [sys.executable, "-W", "error", str(script)]
        try:
            result = subprocess.run(
                command,
                cwd=ROOT,
                env=with_programs(),
                timeout=TIMEOUT_S,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
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
