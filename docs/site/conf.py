"""Sphinx's settings for the site of `make docs`, and docstrings as they are written here: plain text with `code`."""

from __future__ import annotations

import re
from typing import Any

import fusion_service

project = "Track fusion centre"
version = release = fusion_service.__version__
extensions = ["sphinx.ext.autodoc", "myst_parser", "sphinxcontrib.mermaid"]
html_theme = "furo"
html_title = f"{project} {version}"
html_show_copyright = html_show_sphinx = html_copy_source = False
html_static_path = ["static"]
html_css_files = ["site.css"]
myst_heading_anchors = 4
myst_fence_as_directive = ["mermaid"]
pygments_style = "tango"
autodoc_member_order = "groupwise"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_default_options = {"members": True, "exclude-members": "__new__, __init__"}
autodoc_type_aliases = {"ArrayLike": "ArrayLike"}
python_maximum_signature_line_length = 88
toc_object_entries_show_parents = "hide"

CODE = re.compile(r"(`[^`]+`)")
ARRAY = re.compile(r"[~\w.]*ndarray\[tuple\[[~\w.]*Any, \.\.\.\], [~\w.]*dtype\[([~\w.]+)\]\]")
ARRAY_LIKE = re.compile(r"[~\w.]*Buffer \| [~\w.]*_SupportsArray.+?_NestedSequence\[complex \| bytes \| str\]")


def restructured(lines: list[str]) -> list[str]:
    """A docstring as reStructuredText: `code` in code font, marks that Sphinx would read escaped, and blocks that
    stand indented after an empty line, or are a table or a drawing, as they are."""
    made: list[str] = []
    literal = False
    for place, line in enumerate(lines):
        indented = line.startswith("  ")
        begins = indented and (place == 0 or not lines[place - 1].strip())
        if begins and not literal:
            made += ["::", ""]
            literal = True
        elif line.strip() and not indented:
            literal = False
        if literal:
            made.append("    " + line if line.strip() else "")
            continue
        if not indented and made and made[-1].startswith("  "):
            made.append("")
        hanging = indented and not literal
        item = re.match(r"[*-] ", line)
        text, head = (line[2:], line[:2]) if item else (line.strip() if hanging else line, "")
        parts = (
            f"``{part[1:-1]}``\\ " if part[:1] == "`" and len(part) > 1 else re.sub(r"([\\*_|`])", r"\\\1", part)
            for part in CODE.split(text)
        )
        if item and made and made[-1] and not made[-1].startswith(("* ", "- ", "  ")):
            made.append("")
        made.append(("  " if hanging and _in_list(made) else "") + head + "".join(parts))
    return made


def _in_list(made: list[str]) -> bool:
    for line in reversed(made):
        if not line.strip():
            return False
        if line.startswith(("* ", "- ")):
            return True
    return False


def _docstring(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    lines[:] = restructured(lines)


def _signature(app: Any, what: str, name: str, thing: Any, options: Any, given: str | None, result: str | None) -> Any:
    """The names of array types as the code writes them."""

    def short(text: str | None) -> str | None:
        return ARRAY.sub(r"NDArray[\1]", ARRAY_LIKE.sub("ArrayLike", text)) if text else text

    return short(given), short(result)


def setup(app: Any) -> None:
    app.connect("autodoc-process-signature", _signature)
    app.connect("autodoc-process-docstring", _docstring)
