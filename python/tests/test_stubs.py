"""The generated messages and stubs."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def test_the_stubs_are_those_of_the_protocol():
    pytest.importorskip("grpc_tools")
    check = [sys.executable, str(ROOT / "python" / "generate_stubs"), "--check"]
    result = subprocess.run(check, capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, result.stderr
