"""Services of the built program, for tests."""

import contextlib
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def program() -> str:
    """Returns the path of the program: `TANDEM`, or the release build."""
    path = os.environ.get("TANDEM", str(ROOT / "target/release/tandem"))
    if not Path(path).exists():
        pytest.skip(f"there is no program {path}: cargo build --release, or set TANDEM")
    return path


@contextlib.contextmanager
def service(*arguments: str) -> Iterator[str]:
    """Runs `tandem ARGUMENTS --listen 127.0.0.1:0`, and yields its address."""
    command = [program(), *arguments, "--listen", "127.0.0.1:0"]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        line = process.stdout.readline()
        if not line.startswith("listening on "):
            pytest.fail(f"{command}: {line}{process.communicate(timeout=20)[1]}")
        yield line.removeprefix("listening on ").strip()
    finally:
        process.terminate()
        process.communicate(timeout=20)


def refusal(*arguments: str) -> tuple[int, str]:
    """Runs `tandem ARGUMENTS`, which must fail, and returns its exit code and the last line of standard error."""
    result = subprocess.run([program(), *arguments], cwd=ROOT, capture_output=True, text=True, timeout=60)
    return result.returncode, result.stderr.strip().splitlines()[-1]
