"""The sources of the book: docs/, the pages beside it, and the files that pages link to.

On a git host the links of docs/ lead to files of the repository. In the book, a link to a file outside docs/ leads to a
copy below `files/`, and a link to a directory to a list of its files.
"""

import html
import os
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

from links import rewrite
from pages import ROOT

DOCS = ROOT / "docs"
# In the book, the table of contents is beside every page.
FIRST_PAGE = DOCS / "quick-start.md"
# Pages of the book that lie beside docs/.
BESIDE = (ROOT / "ARCHITECTURE.md", ROOT / "CONTRIBUTING.md")
SHOWN_BY_BROWSERS = {".gif", ".html", ".jpg", ".json", ".pdf", ".png", ".svg", ".txt"}
MAX_LISTED = 1000


class Source:
    """A directory with the sources of the book."""

    def __init__(self, directory: Path):
        self.directory = directory

    def write(self) -> None:
        shutil.rmtree(self.directory, ignore_errors=True)
        for file in sorted(DOCS.rglob("*")):
            if file.is_file() and file.suffix != ".md":
                self.copy(file, self.directory / file.relative_to(DOCS))
        for page in [*sorted(DOCS.rglob("*.md")), *BESIDE]:
            target = self.page(page)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(rewrite(page.read_text(), lambda link: self.link(page, link)))

    def page(self, page: Path) -> Path:
        if page in BESIDE:
            return self.directory / page.name
        # mdBook calls the page of a README.md index.html, but does not change the links to it.
        return (self.directory / page.relative_to(DOCS)).with_stem("index" if page.stem == "README" else page.stem)

    def link(self, page: Path, link: str) -> str:
        """Returns the target of a page's link in the book."""
        path, _, heading = link.partition("#")
        if not path:
            return link
        held = (page.parent / path).resolve()
        target = os.path.relpath(self.target(held), self.page(page).parent)
        return f"{target}#{heading}" if heading else target

    def target(self, held: Path) -> Path:
        if held == DOCS / "SUMMARY.md":
            held = FIRST_PAGE
        in_docs = DOCS in (held, *held.parents)
        if held.is_dir():
            return self.page(held / "README.md") if in_docs and (held / "README.md").exists() else self.listing(held)
        if held in BESIDE or (in_docs and held.suffix == ".md"):
            return self.page(held)
        if in_docs:
            return self.directory / held.relative_to(DOCS)
        target = self.directory / "files" / held.relative_to(ROOT)
        if held.suffix not in SHOWN_BY_BROWSERS:
            # mdBook changes `.md` within a link.
            target = target.with_suffix(".txt") if held.suffix == ".md" else target.with_name(f"{target.name}.txt")
        self.copy(held, target)
        return target

    def listing(self, directory: Path) -> Path:
        """Writes a page with links to the files of a directory."""
        name = directory.relative_to(ROOT)
        base = self.directory / (directory.relative_to(DOCS) if DOCS in directory.parents else Path("files") / name)
        files = [file for file in sorted(directory.rglob("*")) if file.is_file() and "__pycache__" not in file.parts]
        lines = [f"<!doctype html><meta charset=utf-8><title>{name}</title><h1>{name}</h1><ul>"]
        for file in files[:MAX_LISTED]:
            shown = html.escape(str(file.relative_to(directory)))
            lines.append(f'<li><a href="{html.escape(os.path.relpath(self.target(file), base))}">{shown}</a>')
        base.mkdir(parents=True, exist_ok=True)
        (base / "index.html").write_text("\n".join(lines) + "\n</ul>\n")
        return base / "index.html"

    def copy(self, source: Path, target: Path) -> None:
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(source, target)


class Page(HTMLParser):
    """The anchors and the local links of a page."""

    def __init__(self, file: Path):
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.feed(file.read_text())

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        for name, value in attributes:
            if name in ("id", "name") and value:
                self.anchors.add(value)
            if name in ("href", "src") and value and not re.match(r"[a-z]+:|//", value) and tag != "base":
                self.links.append(unquote(value))


def broken_links(book: Path) -> list[str]:
    """Returns a line for each link within a built book that leads nowhere."""
    pages = {file: Page(file) for file in sorted(book.rglob("*.html")) if file.name not in ("404.html", "toc.html")}
    found = []
    for file, page in pages.items():
        for link in page.links:
            path, _, anchor = link.partition("#")
            target = (file.parent / path.split("?")[0]).resolve() if path else file
            if not target.is_file():
                found.append(f"{file.relative_to(book)}: {link} does not exist")
            elif anchor and target in pages and anchor not in pages[target].anchors:
                found.append(f"{file.relative_to(book)}: {link}: there is no such anchor")
    return found


def left_out(summary: Path) -> list[str]:
    """Returns the pages of docs/ that the table of contents does not list."""
    listed = {(summary.parent / link).resolve() for link in re.findall(r"\]\(([^)]+)\)", summary.read_text())}
    every = {page for page in DOCS.rglob("*.md") if page != summary}
    return [f"docs/SUMMARY.md does not list {page.relative_to(DOCS)}" for page in sorted(every - listed)]
