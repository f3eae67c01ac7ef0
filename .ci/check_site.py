"""Fail if a page of a built site fetches anything from another host: ``python .ci/check_site.py FOLDER``.

Links that a reader may follow are ignored; scripts, styles, fonts, pictures and frames count.
"""

import re
import sys
from html.parser import HTMLParser
from pathlib import Path

FETCHES = {"script", "link", "img", "source", "iframe", "video", "audio", "embed", "object", "input", "track"}
ELSEWHERE = re.compile(r"^\s*(\w+:)?//")


class _Fetches(HTMLParser):
    """Collects the addresses that a page fetches from other hosts."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Look at the addresses that a tag fetches, and at styles."""
        for name, value in attrs:
            if tag in FETCHES and name in ("src", "href", "srcset", "data", "poster") and ELSEWHERE.match(value or ""):
                self.found.append(f"<{tag} {name}={value}>")
            elif name == "style":
                self.found += fetched_by_style(value or "")


def fetched_by_style(text: str) -> list[str]:
    """Addresses on other hosts that a style sheet fetches."""
    return re.findall(r"(?:url\(|@import)\s*['\"]?((?:\w+:)?//[^'\")\s]+)", text)


def fetched(path: Path) -> list[str]:
    """The addresses that a file of a site fetches from other hosts."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".css":
        return fetched_by_style(text)
    page = _Fetches()
    page.feed(text)
    return page.found + [
        found for style in re.findall(r"<style.*?</style>", text, re.DOTALL) for found in fetched_by_style(style)
    ]


def main(folder: Path) -> int:
    """Print the fetched addresses; returns the exit code."""
    paths = [path for path in sorted(folder.rglob("*")) if path.suffix in (".html", ".css")]
    if not any(path.name == "index.html" for path in paths):
        print(f"There is no site in {folder}.")
        return 1
    found = [f"{path.relative_to(folder)}: {what}" for path in paths for what in fetched(path)]
    print("\n".join(found) or f"{len(paths)} pages and styles fetch nothing from other hosts.")
    return bool(found)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
