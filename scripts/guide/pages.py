"""The pages of the guide and the commands on them. docs/testing.md describes the convention."""

import re
import shlex
import subprocess
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BLOCK = re.compile(
    r"(?:^<!-- example: where (?P<where>(?:(?!-->).)*?)\s*-->\n)?^```(?P<label>\S*)\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL
)
INLINE = re.compile(r"(?<!`)`((?:tandem|scripts/|python |cargo install )[^`]+)`(?!`)")
COMMAND_LABELS = ("", "sh", "console")
PROMPT = "$ "


@dataclass
class Command:
    """A command of a page, with the output that the page shows below it."""

    page: str
    line: int
    text: str
    block: int
    expected: list[str] = field(default_factory=list)

    @property
    def place(self) -> str:
        return f"{self.page}:{self.line}"


def all_pages() -> list[str]:
    """Returns the Markdown files that users read, as paths from the root."""
    pages = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "ARCHITECTURE.md")]
    pages += sorted((ROOT / "docs").rglob("*.md"))
    return [str(page.relative_to(ROOT)) for page in pages]


def commands(page: str) -> list[Command]:
    """Returns the commands of a page's blocks, in order, with the replacements that a comment above a block lists."""
    text = (ROOT / page).read_text()
    found = []
    for number, match in enumerate(BLOCK.finditer(text)):
        if match["label"] not in COMMAND_LABELS:
            continue
        first = text.count("\n", 0, match.start("text")) + 1
        parse = of_console if is_console(match["label"], match["text"]) else of_script
        for line, command, expected in parse(match["text"]):
            for name, value in replacements(match["where"]):
                end = r"(?![\w-])" if name[-1].isalnum() else ""
                command = re.sub(rf"(?<![\w/.-]){re.escape(name)}{end}", lambda _, value=value: value, command)
            found.append(Command(page, first + line, without_comment(command), number, expected))
    return found


def inline_commands(page: str) -> list[Command]:
    """Returns the commands between backticks in the prose of a page."""
    text = (ROOT / page).read_text()
    prose = re.sub(r"^```.*?^```$", lambda block: re.sub(r"[^\n]", "", block[0]), text, flags=re.MULTILINE | re.DOTALL)
    return [
        Command(page, prose.count("\n", 0, match.start()) + 1, " ".join(match[1].split()), -1)
        for match in INLINE.finditer(prose)
    ]


def replacements(where: str | None) -> list[tuple[str, str]]:
    """Parses `FILE=policies/a.safetensors, runs/NAME=$RUN`; longer names come first."""
    pairs = [tuple(pair.split("=", 1)) for pair in re.split(r",\s+", where or "") if pair]
    return sorted(pairs, key=lambda pair: -len(pair[0]))


def is_console(label: str, text: str) -> bool:
    return label == "console" or (label == "" and text.startswith(PROMPT))


def of_console(text: str):
    """Yields the line, the command and the output of each prompt."""
    number, command, expected = 0, "", []
    for idx, line in enumerate(text.splitlines()):
        if line.startswith(PROMPT):
            if command:
                yield number, command, expected
            number, command, expected = idx, line[len(PROMPT) :], []
        elif command.endswith("\\"):
            command += "\n" + line
        elif command:
            expected.append(line)
    if command:
        yield number, command, expected


def of_script(text: str):
    """Yields the line and the text of each command; a command ends with the first line at which bash accepts it."""
    number, command = 0, ""
    for idx, line in enumerate(text.splitlines()):
        if not command and (not line.strip() or line.startswith("#")):
            continue
        number = number if command else idx
        command = f"{command}\n{line}" if command else line
        if not command.endswith("\\") and is_complete(command):
            yield number, command, []
            command = ""
    if command:
        yield number, command, []


def without_comment(command: str) -> str:
    """Returns a command without the comment at its end: a `#` after a blank, outside quotes."""
    quote, previous = "", " "
    for idx, character in enumerate(command):
        if quote:
            quote = "" if character == quote and previous != "\\" else quote
        elif character in "'\"" and previous != "\\":
            quote = character
        elif character == "#" and previous.isspace() and "\n" not in command[idx:]:
            return command[:idx].rstrip()
        previous = character
    return command.rstrip()


def is_complete(command: str) -> bool:
    """Returns whether bash accepts a text; of a here-document without an end it only warns."""
    result = subprocess.run(["bash", "-n", "-c", command], capture_output=True)
    return result.returncode == 0 and not result.stderr


def simple_commands(command: str) -> list[list[str]]:
    """Returns the words of the simple commands that a command line consists of, without redirections and variables."""
    lexer = shlex.shlex(command.replace("\\\n", " "), posix=True, punctuation_chars="|&;()<>")
    lexer.whitespace_split = True
    lexer.commenters = ""
    parts, skip = [[]], False
    try:
        words = list(lexer)
    except ValueError:
        return [command.split()]
    for word in words:
        if set(word) <= set("<>&") and set(word) & set("<>"):
            skip = True
        elif set(word) <= set("|&;()"):
            parts.append([])
        elif skip:
            skip = False
        elif parts[-1] or not re.fullmatch(r"[A-Z_]+=.*", word):
            parts[-1].append(word)
    return [part for part in parts if part]
