"""The tables of rules in README.md and docs/rules.md, made from what the rules declare.

`python -m fusion_service.rules`, in a clone, writes them anew between their markers, `<!-- NAME -->` and
`<!-- /NAME -->`. A test fails where a page says something else.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from fusion_service.rules.base.rule import Declaration
from fusion_service.rules.face.registry import RULES
from fusion_service.rules.mixtures import MIXTURE_RULES

__all__ = ["PAGES", "main", "written"]


def promises() -> str:
    """The short table of the rules for Gaussians: name, what it is, promise."""
    return _table(("name", "rule", "promise"), ((rule.title, _promise(rule)) for rule in RULES.values()), RULES)


def rules() -> str:
    """The long one: with its options and source too."""
    return _long(RULES)


def mixture_rules() -> str:
    """The same of the rules for mixtures."""
    return _long(MIXTURE_RULES)


PAGES: Mapping[str, Mapping[str, Callable[[], str]]] = {
    "README.md": {"rules": promises},
    "docs/rules.md": {"rules": rules, "mixture rules": mixture_rules},
}
"""Of each page the tables, by the name of their marker."""


def written(page: str, text: str) -> str:
    """The text of a page with its tables made anew. Raises ValueError where a marker is missing."""
    for name, table in PAGES[page].items():
        marked = re.compile(rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", re.DOTALL)
        if len(marked.findall(text)) != 1:
            raise ValueError(f"{page} needs the markers <!-- {name} --> and <!-- /{name} -->, once")
        text = marked.sub(lambda found: found[1] + table() + found[2], text)  # noqa: B023
    return text


def main() -> None:
    """Write the pages below the current folder. Raises ValueError as `written`, OSError for a missing page."""
    for page in PAGES:
        path = Path(page)
        path.write_text(written(page, path.read_text(encoding="utf-8")), encoding="utf-8")
        print(page)


def _long(rules: Mapping[str, Declaration]) -> str:
    head = ("name", "rule", "promise", "sources", "options and their defaults", "source")
    rows = (
        (
            rule.title,
            _promise(rule),
            "any number" if rule.n_way else "two at a time",
            ", ".join(f"`{name}={value!r}`" for name, value in rule.options.items()),
            rule.source,
        )
        for rule in rules.values()
    )
    return _table(head, rows, rules)


def _promise(rule: Declaration) -> str:
    return rule.promise.replace("none in general", "**none in general**")


def _table(head: Iterable[str], rows: Iterable[Iterable[str]], names: Iterable[str]) -> str:
    head = list(head)
    lines = [head, ["---"] * len(head), *([f"`{name}`", *row] for name, row in zip(names, rows, strict=True))]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines).replace("| --- ", "|---").replace("|--- |", "|---|")
