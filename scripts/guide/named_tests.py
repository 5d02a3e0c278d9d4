"""The tests that Markdown files name: whether they exist."""

import re
import subprocess
from pathlib import Path

from pages import ROOT

# A sentence. Names of metrics begin with tandem_, columns of reports with held_out_.
NAME = re.compile(r"`(?!tandem_|held_out_)([a-z0-9]+(?:_[a-z0-9]+){4,})`")
DEFINITION = re.compile(r"\b(?:fn|def) (\w+)")


def missing_tests(files: list[Path]) -> list[str]:
    """Returns a line for each name of a test in these files that no source file defines."""
    command = ["git", "grep", "--untracked", "-hE", r"\b(fn|def) ", "--", "*.rs", "*.py"]
    sources = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    defined = set(DEFINITION.findall(sources))
    named = [(file.relative_to(ROOT), name) for file in files for name in NAME.findall(file.read_text())]
    return [f"{place}: there is no test {name}" for place, name in named if name not in defined]
