"""Sphinx builds the site from these pages: ``sphinx-build -W docs build/site``."""

import re
from pathlib import Path
from typing import Any

import warp as wp
from deimos.kernels import episodes, random
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform

from deimos import __version__

project, author = "Deimos", "The Deimos developers"
project_copyright = "The Deimos developers, Apache-2.0"
release = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]

html_theme = "furo"
html_title = "Deimos"
html_show_sphinx = False
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#9a4a00", "color-brand-content": "#9a4a00"},
    "dark_css_variables": {"color-brand-primary": "#f0a860", "color-brand-content": "#f0a860"},
}
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True}
napoleon_google_docstring = True
python_maximum_signature_line_length = 90


class DarkPictures(SphinxTransform):
    """Beside ``picture.svg`` there may be a ``picture-dark.svg``, which pages in the dark mode show instead."""

    default_priority = 200

    def apply(self) -> None:
        """Give every such picture its twin."""
        for image in list(self.document.findall(nodes.image)):
            path = Path(image["uri"])
            dark = path.with_name(f"{path.stem}-dark{path.suffix}")
            if (Path(self.env.doc2path(self.env.docname)).parent / dark).is_file():
                twin = image.deepcopy()
                twin["uri"] = dark.as_posix()
                image["classes"].append("only-light")
                twin["classes"].append("only-dark")
                image.parent.insert(image.parent.index(image) + 1, twin)


def prepare_docstring(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Print sources as the docstring does, and keep Napoleon from taking words in front of a colon for a type.

    It looks for one in the first line of a field and of what is returned; a line with nothing to print comes first.
    """
    lines[:] = [re.sub(r"^(\s*)\.\. (?=\[\d+\])", r"\1", re.sub(r"(\[\d+\])_", r"\1", line)) for line in lines]
    if what in ("attribute", "property"):
        lines.insert(0, "\\ ")
    for i, line in reversed(list(enumerate(lines))):
        if line.strip() in ("Returns:", "Yields:"):
            lines.insert(i + 1, line[: len(line) - len(line.lstrip())] + "    \\ ")


def uncover_warp_functions() -> None:
    """Put in the place of the Warp functions that environments call the Python functions that they are made of."""
    for module in (episodes, random):
        for name, value in list(vars(module).items()):
            if isinstance(value, wp.Function):
                setattr(module, name, value.func)


def setup(app: Sphinx) -> None:
    """What Sphinx calls first."""
    uncover_warp_functions()
    app.connect("autodoc-process-docstring", prepare_docstring, priority=400)  # before Napoleon
    app.add_transform(DarkPictures)
