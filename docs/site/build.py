"""The site: README, docs/, WIRE.md and the API from the docstrings, in HTML: `python docs/site/build.py`.

The pages of the repository are gathered in site/source, where their links lead to each other; Sphinx makes site/html
of them, and a warning is an error. Links to files that are no page become paths in code font: the site has no address
of the repository. Nothing is asked of the network.
"""

from __future__ import annotations

import os
import posixpath
import re
import shutil
import sys
from pathlib import Path

from sphinx.cmd.build import main as sphinx

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
ELSEWHERE = {
    "README.md": "index.md",
    "schemas/WIRE.md": "wire.md",
    "docker/README.md": "docker.md",
    "deploy/README.md": "deploy.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "threats.md",
}
"""Pages that are not below docs/: path in the repository, name in the site."""
SECTIONS = {
    "Use it": [
        *(
            "tutorial",
            "operating",
            "console",
            "troubles",
            "top",
            "standby",
            "security",
            "arrival",
            "judgement",
            "supervision",
            "registration",
            "conduct",
            "platforms",
            "extent",
        ),
        *("tracklets", "late", "outages", "motion", "rules", "mixtures", "partial", "review", "requirements"),
        *("docker", "wire", "deploy", "monitoring", "backup"),
    ],
    "How good, how fast": ["measurements", "worlds", "studies", "performance", "rules-speed", "reliability"],
    "API": ["api/*"],
    "Carry it on": ["architecture", "threats", "decisions/README", "contributing", "changelog"],
}
API = {
    "schemas": "It needs NumPy and MessagePack only.",
    "sensor_clients.publisher": "",
    "fusion_service.rules": "",
    "fusion_service.densities": "",
    "fusion_service.existence": "",
    "fusion_service.metrics": "",
    "fusion_service.centre": "",
    "fusion_service.config": "",
    "fusion_service.bus": "",
}
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")
FENCE = re.compile(r"^(```.*?^```$)", re.M | re.S)


def pages() -> dict[str, str]:
    """Path in the repository: name in the site, of every page."""
    below = {path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").rglob("*.md")}
    return {path: path.removeprefix("docs/") for path in sorted(below)} | ELSEWHERE


def linked(text: str, path: str, names: dict[str, str]) -> str:
    """`text`, the page at `path`, with links that are right in the site."""
    place, site = posixpath.dirname(path), posixpath.dirname(names[path])

    def link(found: re.Match[str]) -> str:
        mark, words, target = found.groups()
        if re.match(r"[a-z]+:|#", target):
            return found[0]
        file, _, anchor = target.partition("#")
        file = posixpath.normpath(posixpath.join(place, file))
        file = posixpath.join(file, "README.md") if posixpath.join(file, "README.md") in names else file
        there = file.removeprefix("docs/") if mark else names.get(file)
        if there is None:
            if not (ROOT / file).exists():
                sys.exit(f"{path}: no such file: {target}")
            return f"`{file}`" if words.strip("`") in file else f"{words} (`{file}`)"
        there = posixpath.relpath(there, site or ".")
        return f"{mark}[{words}]({there}{'#' + anchor if anchor else ''})"

    parts = FENCE.split(text)
    return "".join(part if part.startswith("```") else LINK.sub(link, part) for part in parts)


def tree(caption: str, names: list[str]) -> str:
    entries = "\n".join(names)
    return f"\n```{{toctree}}\n:caption: {caption}\n:hidden:\n:glob:\n:maxdepth: 1\n\n{entries}\n```\n"


def gather(source: Path) -> None:
    """All pages, pictures and settings in the folder `source`."""
    shutil.rmtree(source, ignore_errors=True)
    shutil.copytree(ROOT / "docs", source, ignore=shutil.ignore_patterns("site", "*.json", "*.md"))
    names = pages()
    for path, name in names.items():
        text = linked((ROOT / path).read_text("utf-8"), path, names)
        if name == "index.md":
            text += "".join(tree(caption, list(entries)) for caption, entries in SECTIONS.items())
        if name == "decisions/README.md":
            text += tree("Decisions", ["*"])
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_text(text, "utf-8")
    (source / "api").mkdir()
    for number, (module, text) in enumerate(API.items()):
        page = f"# `{module}`\n\n{text}\n\n```{{eval-rst}}\n.. automodule:: {module}\n   :imported-members:\n```\n"
        (source / "api" / f"{number}-{module.replace('_', '-')}.md").write_text(page, "utf-8")
    (source / "static").mkdir()
    shutil.copy(HERE / "site.css", source / "static")
    shutil.copy(HERE / "conf.py", source)


def main() -> int:
    site = ROOT / "site"
    os.chdir(ROOT)
    sys.path.insert(0, str(ROOT))
    gather(site / "source")
    shutil.rmtree(site / "html", ignore_errors=True)
    kept = ["-d", str(site / "trees"), str(site / "source"), str(site / "html")]
    return sphinx(["-b", "html", "-q", "-W", "--keep-going", "-E", *kept])


if __name__ == "__main__":
    sys.exit(main())
