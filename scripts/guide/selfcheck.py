"""Checks that the test of the guide detects mistakes."""

import tempfile
from pathlib import Path

from elsewhere import entry_for, unfit_entries
from flags import Flags
from links import broken, headings, rewrite
from pages import Command, of_console, of_script, replacements, simple_commands, without_comment
from sessions import difference, is_refused, server_of
from shortened import sweep, to_toml, train, without


def main() -> None:
    commands()
    outputs()
    rules()
    options()
    links()


def commands() -> None:
    script = "# a comment\na \\\n  --b   # c\ncat <<E\nx\nE\n\nd |\n  e\n"
    assert [text for _, text, _ in of_script(script)] == ["a \\\n  --b   # c", "cat <<E\nx\nE", "d |\n  e"]
    assert list(of_console("$ a\nx\n$ b\n")) == [(0, "a", ["x"]), (2, "b", [])]
    assert without_comment("a '#b' \"#c\"  # d's") == "a '#b' \"#c\""
    assert simple_commands("A=1 a b > c && d | e") == [["a", "b"], ["d"], ["e"]]
    assert replacements("FILE=a,\n  FILE.mcap=b") == [("FILE.mcap", "b"), ("FILE", "a")]
    # A command that is not executed has an entry, and an entry without a command is an error.
    assert entry_for(command("docker compose up")) and not entry_for(command("tandem train"))
    assert any("'docker'" in problem for problem in unfit_entries([command("tandem train")]))


def outputs() -> None:
    text = "run directory runs/a\ndone: 800 steps\n"
    assert difference(["run directory runs/b", "...", "done: 1 steps"], text) is None
    assert difference(["done: 1 steps", "run directory runs/b"], text) == "run directory runs/b"
    assert difference(["tandem: x is not known here"], "tandem: x is not there here\n")
    assert is_refused(command("a", ["tandem: no"])) and not is_refused(command("a", ["done"]))
    assert server_of("tandem teacher --x") and server_of("tandem bridge") and not server_of("tandem bridge status")


def rules() -> None:
    assert without(["a", "--b", "c", "--b=d", "e"], "--b") == ["a", "e"]
    assert "--max-env-steps" in train(["train"]) and "9" not in train(["train", "--max-env-steps", "9"])
    assert to_toml({"a": {"b": [1, True]}}) == '"a" = { "b" = [1, true] }\n'
    assert sweep(["sweep", "a.toml", "--dry-run"]) == ["sweep", "a.toml", "--dry-run"]


def options() -> None:
    flags = Flags(Path("tandem"))
    flags.help = lambda names: "Commands:\n  train  Trains\n\nOptions:\n  -q, --quiet\n" if not names else "--seed <N>"
    assert not list(flags.check(command("tandem train --seed 1 && a --b")))
    assert len(list(flags.check(command("tandem train --sed 1")))) == 1
    assert len(list(flags.check(command("tandem trian")))) == 1
    assert len(list(flags.check(command("scripts/missing --x")))) == 1
    assert len(list(flags.check(command("cd a && cargo install --path .")))) == 1
    assert not list(flags.check(command("cargo install --locked --path .")))


def links() -> None:
    assert headings("# A `b`, c\n# A `b`, c\n") == {"a-b-c", "a-b-c-1"}
    assert rewrite("[a](b) `[c](d)` [e](https://f)", str.upper) == "[a](B) `[c](d)` [e](https://f)"
    with tempfile.TemporaryDirectory() as directory:
        page = Path(directory).resolve() / "page.md"
        page.write_text("# Here\n[a](missing.md) [b](#there) [c](#here) [d](page.md#here) [e](..)\n")
        assert len(list(broken(page, page.parent))) == 3


def command(text: str, expected: list[str] | None = None) -> Command:
    return Command("page", 1, text, 0, expected or [])
