"""Checks the dependencies of a workspace against deny.toml: licences, banned crates and sources.

    python3 scripts/check_dependencies.py Cargo.toml

Reads the part of cargo-deny's rules that deny.toml uses. Needs Python 3.11 and cargo.
"""

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path


def main() -> int:
    with open("deny.toml", "rb") as file:
        rules = tomllib.load(file)
    packages = dependencies(sys.argv[1], rules["graph"]["targets"])
    problems = [problem for package in packages for problem in problems_of(package, rules)]
    for problem in problems:
        print(f"error: {problem}", file=sys.stderr)
    print(f"{len(packages)} dependencies checked, {len(problems)} problems")
    return 1 if problems else 0


def dependencies(manifest: str, targets: list[str]) -> list[dict]:
    """Returns every package outside the workspace that a build for `targets` with all features uses."""
    command = ["cargo", "metadata", "--format-version=1", "--locked", "--all-features", f"--manifest-path={manifest}"]
    command += [f"--filter-platform={target}" for target in targets]
    metadata = json.loads(subprocess.check_output(command))
    used = {node["id"] for node in metadata["resolve"]["nodes"]} - set(metadata["workspace_members"])
    return [package for package in metadata["packages"] if package["id"] in used and not is_ours(package)]


def is_ours(package: dict) -> bool:
    """Returns whether a package lies in this repository; those of other workspaces are no members."""
    return package["source"] is None and Path(package["manifest_path"]).is_relative_to(Path.cwd())


def problems_of(package: dict, rules: dict):
    name = f"{package['name']} {package['version']}"
    if package["name"] in {banned["crate"] for banned in rules["bans"]["deny"]}:
        yield f"{name} is banned"
    sources = {f"registry+{url}" for url in rules["sources"]["allow-registry"]}
    if package["source"] not in sources:
        yield f"{name} comes from {package['source']}"
    if not is_allowed(package["license"] or "", set(rules["licenses"]["allow"])):
        yield f"{name} has licence {package['license']!r}"


def is_allowed(expression: str, allowed: set[str]) -> bool:
    """Evaluates an SPDX expression: a licence is true when it is allowed. "/" is an old way to write OR."""
    expression = re.sub(r"\s+WITH\s+", "~", expression.replace("/", " OR "))
    words = []
    for word in re.findall(r"[()]|[^\s()]+", expression):
        if word in ("(", ")"):
            words.append(word)
        elif word in ("AND", "OR"):
            words.append(word.lower())
        else:
            words.append(str(word.replace("~", " WITH ") in allowed))
    return bool(words) and bool(eval(" ".join(words)))  # noqa: S307, only and, or, parentheses, True and False


if __name__ == "__main__":
    sys.exit(main())
