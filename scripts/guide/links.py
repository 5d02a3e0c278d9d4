"""The links of Markdown files: what they lead to, and whether it exists."""

import re
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

from pages import ROOT

FENCED = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"(`+)(?!`).*?(?<!`)\1(?!`)", re.DOTALL)
LINK = re.compile(r"(\]\(|^\[[^\]\n]+\]: |<img [^>]*?src=\")([^)\s\"]+)", re.MULTILINE)
EXTERNAL = re.compile(r"[a-z]+:|#$")


def markdown_files() -> list[Path]:
    """Returns the Markdown files of the repository, those that are not committed yet included."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "*.md"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return [ROOT / name for name in listed.stdout.split() if (ROOT / name).exists()]


def rewrite(text: str, change: Callable[[str], str]) -> str:
    """Returns Markdown with the targets of its local links changed; code is left alone."""
    code: list[str] = []

    def hide(match: re.Match) -> str:
        code.append(match[0])
        return f"\0{len(code) - 1}\0"

    def show(match: re.Match) -> str:
        return code[int(match[1])]

    hidden = CODE.sub(hide, FENCED.sub(hide, text))
    changed = LINK.sub(lambda match: match[1] + (match[2] if EXTERNAL.match(match[2]) else change(match[2])), hidden)
    while "\0" in changed:
        changed = re.sub("\0(\\d+)\0", show, changed)
    return changed


def targets(text: str) -> list[str]:
    found: list[str] = []
    rewrite(text, lambda target: found.append(target) or target)
    return found


def broken(file: Path, root: Path = ROOT) -> Iterator[str]:
    """Yields a line for each link of a file whose target, or whose heading there, does not exist."""
    for target in targets(file.read_text()):
        path, _, heading = target.partition("#")
        held = (file.parent / path).resolve() if path else file
        place = file.relative_to(root)
        if not held.exists() or root not in (held, *held.parents):
            yield f"{place}: {target} does not exist"
        elif heading and held.suffix == ".md" and heading not in headings(held.read_text()):
            yield f"{place}: {target}: there is no such heading"


def headings(text: str) -> set[str]:
    """Returns the anchors that a git host gives to the headings of a text."""
    found: set[str] = set()
    for title in re.findall(r"^#+ +(.*?)\s*$", FENCED.sub("", text), re.MULTILINE):
        title = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", title)
        anchor = re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")
        number = next(n for n in range(100) if (f"{anchor}-{n}" if n else anchor) not in found)
        found.add(f"{anchor}-{number}" if number else anchor)
    return found
