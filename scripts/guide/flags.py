"""Compares commands with what exists: scripts, and the options that `tandem --help` prints."""

import functools
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

from pages import ROOT, Command, simple_commands

NAME = re.compile(r"[a-z][a-z-]*")
OPTION = re.compile(r"(?<![\w-])(--[a-z][a-z-]*|-[a-zA-Z])\b")


class Flags:
    """The subcommands and options of a program."""

    def __init__(self, program: Path):
        self.program = program

    def check(self, command: Command) -> Iterator[str]:
        """Yields a line for each script, and each subcommand and option of `tandem`, that does not exist, and for each
        `cargo install` that ignores Cargo.lock."""
        for words in simple_commands(command.text):
            if missing := [word for word in words[:2] if word.startswith("scripts/") and not (ROOT / word).exists()]:
                yield f"{missing[0]} does not exist"
            if words[:2] == ["cargo", "install"] and "--locked" not in words:
                yield "`cargo install` ignores Cargo.lock: add --locked"
            if (start := start_of(words)) is not None:
                yield from self.check_words(words[start + 1 :])

    def check_words(self, words: list[str]) -> Iterator[str]:
        names: tuple[str, ...] = ()
        while words and NAME.fullmatch(words[0]) and (subcommands := self.subcommands(names)):
            if words[0] not in subcommands:
                yield f"there is no `tandem {' '.join([*names, words[0]])}`"
                return
            names, words = (*names, words[0]), words[1:]
        for word in words:
            option = word.split("=")[0]
            if OPTION.fullmatch(option) and option not in self.options(names):
                yield f"`tandem {' '.join(names)}` has no option {option}"

    def subcommands(self, names: tuple[str, ...]) -> set[str]:
        listed = re.search(r"^Commands:\n((?:  .*\n)+)", self.help(names), re.MULTILINE)
        return set(re.findall(r"^  ([a-z-]+)", listed[1], re.MULTILINE)) if listed else set()

    @functools.cache
    def options(self, names: tuple[str, ...]) -> set[str]:
        return set(OPTION.findall(self.help(names).split("Examples:")[0]))

    @functools.cache
    def help(self, names: tuple[str, ...]) -> str:
        return subprocess.run([self.program, *names, "--help"], capture_output=True, text=True, check=True).stdout


def start_of(words: list[str]) -> int | None:
    """Returns the index of the word `tandem` if it is a program: `--namespace tandem` is none."""
    for idx, word in enumerate(words):
        if word == "tandem" and (idx == 0 or words[idx - 1] == "--" or words[0] == "docker"):
            return idx
    return None
