"""A page of texts, tables and figures, as one self-contained HTML file and as Markdown.

A text is a heading (``## ...``), a list (lines of ``* ...``) or a paragraph, as in Markdown; nothing else is markup.
"""

import base64
import html
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 76rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
h1, h2, h3 { line-height: 1.2; } h2 { margin-top: 2.5rem; border-bottom: 1px solid #ccc; }
.wide { overflow-x: auto; } table { border-collapse: collapse; font-size: 13px; margin: 1rem 0; }
th, td { border-bottom: 1px solid #ddd; padding: 0.25rem 0.6rem; text-align: left; vertical-align: top; }
th { border-bottom: 2px solid #888; } td { font-variant-numeric: tabular-nums; }
figure { margin: 1.5rem 0; } img { max-width: 100%; } figcaption { color: #555; font-size: 13px; }
"""


Table = list[dict[str, str]]
"""Its rows: plain texts by the titles of the columns, which are those of the first row; at least one."""


@dataclass(frozen=True)
class Picture:
    """A figure that is next to the page as NAME.png and NAME.svg."""

    name: str
    """Name of its files."""
    caption: str
    """What it shows."""


Block = str | Table | Picture


def to_html(blocks: Sequence[Block], folder: Path) -> str:
    """The page as HTML that needs no other file: figures are inside."""
    title = next((block.lstrip("# ") for block in blocks if isinstance(block, str)), "")
    body = "\n".join(_html(block, folder) for block in blocks)
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{html.escape(title)}</title>\n'
        f"<style>{STYLE}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def _html(block: Block, folder: Path) -> str:
    match block:
        case str() if block.startswith("#"):
            mark, text = block.split(" ", 1)
            return f"<h{len(mark)}>{html.escape(text)}</h{len(mark)}>"
        case str() if block.startswith("* "):
            return "<ul>" + "".join(f"<li>{html.escape(item[2:])}</li>" for item in block.splitlines()) + "</ul>"
        case str():
            return f"<p>{html.escape(block)}</p>"
        case Picture(name, caption):
            data = base64.b64encode((folder / f"{name}.png").read_bytes()).decode()
            image = f'<img alt="{html.escape(caption)}" src="data:image/png;base64,{data}">'
            return f"<figure>{image}<figcaption>{html.escape(caption)}</figcaption></figure>"
        case rows:
            head = "".join(f"<th>{html.escape(title)}</th>" for title in rows[0])
            lines = ("".join(f"<td>{html.escape(cell)}</td>" for cell in row.values()) for row in rows)
            body = "\n".join(f"<tr>{line}</tr>" for line in lines)
            return f'<div class="wide"><table><thead><tr>{head}</tr></thead>\n<tbody>{body}</tbody></table></div>'


def to_markdown(blocks: Sequence[Block], pictures: str) -> str:
    """The page as Markdown, with links to the figures in a folder, as seen from the page."""
    return "\n\n".join(_markdown(block, pictures) for block in blocks) + "\n"


def _markdown(block: Block, pictures: str) -> str:
    match block:
        case str():
            return _plain(block)
        case Picture(name, caption):
            return f"![{_plain(caption)}]({pictures}/{name}.png)"
        case rows:
            lines = [rows[0], ["---"] * len(rows[0]), *(row.values() for row in rows)]
            shown = ([_plain(cell).replace("|", "\\|") for cell in line] for line in lines)
            return "\n".join("| " + " | ".join(line) + " |" for line in shown)


def _plain(text: str) -> str:
    """A text in which nothing is a tag of HTML, which Markdown would let through."""
    return re.sub("<(?=[A-Za-z/!?])", "&lt;", text)
