"""Executes the commands of a page, in order, in a directory of its own."""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from pages import ROOT, Command

COPIED = ("deploy", "docs", "policies", "scripts", "compose.yaml")
LINKED = ("bridge", "environment", "examples", "onnx", "proto", "python", "tests")
TIMEOUT_S = 120
START_TIMEOUT_S = 30
INTERRUPT = "^C"
# A server's first words, and the text that it prints once it can be called ("" if it prints none).
SERVERS = [
    (r"tandem (teacher|learner|env|relay)\b(?!.*--describe)", "listening on"),
    (r"tandem bridge( arms\b.*| --.*)?$", "listening on"),
    (r"tandem worker\b", ""),
    (r"tandem (replay|eval) .*--live", "live on"),
]
SHIM = "#!/bin/sh\nexec {python} {guide}/{module}.py \"$@\"\n"


class Failure(Exception):
    """A command that does not do what its page shows."""


class Session:
    """A directory with the files of the repository, in which the commands of a page run one after the other."""

    def __init__(self, program: Path, given: Path):
        self.work = Path(tempfile.mkdtemp(prefix="guide-"))
        self.directory = self.work / "repository"
        self.directory.mkdir()
        for name in COPIED:
            copy(ROOT / name, self.directory / name)
        for name in LINKED:
            (self.directory / name).symlink_to(ROOT / name)
        copy(given, self.directory / "given")
        self.log = self.work / "log"
        self.log.touch()
        self.servers: list[tuple[Command, "Process"]] = []
        self.processes: list[Process] = []
        self.block, self.current, self.code = -1, self.directory, 0
        self.environment = self.make_environment(program)

    def make_environment(self, program: Path) -> dict[str, str]:
        programs = self.work / "bin"
        programs.mkdir()
        for name, module in (("tandem", "shortened"), ("cargo", "cargo_run")):
            shim = programs / name
            shim.write_text(SHIM.format(python=sys.executable, guide=Path(__file__).parent, module=module))
            shim.chmod(0o755)
        python = programs / "python"
        python.write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
        python.chmod(0o755)
        kept = {name: os.environ[name] for name in ("LANG", "LD_LIBRARY_PATH") if name in os.environ}
        return {
            **kept,
            "PATH": f"{programs}:{os.environ['PATH']}",
            "HOME": str(self.work),
            "TMPDIR": str(self.work),
            "GUIDE_PROGRAM": str(program),
            "GUIDE_LOG": str(self.log),
        }

    def run(self, command: Command) -> None:
        """Executes a command, and starts it in the background if it is a server."""
        if command.block != self.block:
            self.block, self.current = command.block, self.directory
        ready = None if is_refused(command) else server_of(command.text)
        process = self.start(command, as_server=ready is not None)
        self.processes.append(process)
        if ready is not None:
            self.servers.append((command, process))
            process.wait_for(lambda text: ready in text, START_TIMEOUT_S, f"{ready!r} is not printed")
            self.compare(command, process)
            return
        if INTERRUPT in command.expected:
            shown = command.expected[: command.expected.index(INTERRUPT)]
            process.wait_for(lambda text: difference(shown, text) is None, TIMEOUT_S, "the output before ^C is missing")
            process.signal(signal.SIGINT)
        self.code = process.wait(TIMEOUT_S)
        cwd = self.work / "cwd"
        self.current = Path(cwd.read_text().strip()) if cwd.exists() else self.current
        self.compare(command, process)
        fails = INTERRUPT in command.expected or is_refused(command)
        if fails == (self.code == 0):
            raise Failure(f"exit code {self.code}\n{process.text()}")

    def start(self, command: Command, as_server: bool) -> "Process":
        if as_server:
            return Process(f"exec {command.text}", self.current, self.environment)
        script = f"cd {self.current}; (exit {self.code})\n{command.text}\ncode=$?; pwd > {self.work}/cwd; exit $code"
        return Process(script, self.directory, self.environment)

    def compare(self, command: Command, process: "Process") -> None:
        shown = [line for line in command.expected if line != INTERRUPT]
        deadline = time.monotonic() + 5
        while (line := difference(shown, process.text())) and time.monotonic() < deadline and process.is_running():
            time.sleep(0.05)
        if line:
            raise Failure(f"the page shows a line like {line!r}; the output is\n{process.text()}")

    def was_late(self) -> bool:
        """Returns whether the arms of a bridge were stopped because the machine was busy."""
        return any("since the last command" in process.text() for process in self.processes)

    def as_run(self) -> str:
        """Returns what the shortened `tandem` last ran, for messages."""
        lines = self.log.read_text().splitlines()
        return "\n" + lines[-1] if lines else ""

    def end(self) -> list[str]:
        """Ends the servers, removes the directory, and returns what went wrong with the servers."""
        wrong = []
        for command, process in reversed(self.servers):
            was_running = process.is_running()
            if was_running:
                process.signal(signal.SIGTERM)
            try:
                code = process.wait(TIMEOUT_S)
            except Failure as failure:
                wrong.append(f"{command.place}: {command.text}\n{failure}")
                continue
            stopped = (0, 130) if server_of(command.text) else (0, 130, -signal.SIGTERM)
            if code not in (stopped if was_running else (0,)):
                wrong.append(f"{command.place}: {command.text}\nthe server ended with {code}\n{process.text()}")
        shutil.rmtree(self.work, ignore_errors=True)
        return wrong


class Process:
    """A process group whose output is collected."""

    def __init__(self, script: str, directory: Path, environment: dict[str, str]):
        self.process = subprocess.Popen(
            ["bash", "-c", script],
            cwd=directory,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        self.chunks: list[bytes] = []
        self.reader = threading.Thread(target=self.read, daemon=True)
        self.reader.start()

    def read(self) -> None:
        while chunk := os.read(self.process.stdout.fileno(), 1 << 16):
            self.chunks.append(chunk)

    def text(self) -> str:
        return b"".join(self.chunks).decode(errors="replace")

    def is_running(self) -> bool:
        return self.process.poll() is None

    def signal(self, number: signal.Signals) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, number)

    def wait_for(self, condition, timeout_s: float, problem: str) -> None:
        deadline = time.monotonic() + timeout_s
        while not condition(self.text()):
            if not self.is_running() or time.monotonic() > deadline:
                self.reader.join(1)
                if condition(self.text()):
                    return
                self.signal(signal.SIGKILL)
                raise Failure(f"{problem}\n{self.text()}")
            time.sleep(0.02)

    def wait(self, timeout_s: float) -> int:
        try:
            code = self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.signal(signal.SIGKILL)
            raise Failure(f"no end within {timeout_s} s\n{self.text()}") from None
        self.reader.join(2)
        return code


def is_refused(command: Command) -> bool:
    """Returns whether a page shows that a command fails."""
    return any(line.startswith("tandem: ") for line in command.expected)


def server_of(command: str) -> str | None:
    """Returns what a server prints when it is ready, or None for a command that ends by itself."""
    words = re.sub(r"\\\n\s*", "", command)
    return next((ready for pattern, ready in SERVERS if re.match(pattern, words)), None)


def difference(shown: list[str], text: str) -> str | None:
    """Returns the first shown line that has no counterpart in the text, in order. The first words of a line count."""
    lines = iter(text.splitlines())
    for line in shown:
        words = first_words(line)
        if words and not any(first_words(other)[: len(words)] == words for other in lines):
            return line
    return None


def first_words(line: str) -> list[str]:
    """Returns the first two words of a line, of an error the first ten; numbers differ from run to run."""
    return re.findall(r"[A-Za-z]{2,}", line)[: 10 if line.startswith("tandem:") else 2]


def copy(source: Path, target: Path) -> None:
    if source.is_dir():
        shutil.copytree(source, target, symlinks=True, ignore=shutil.ignore_patterns("secrets", "__pycache__"))
    else:
        shutil.copy(source, target)
