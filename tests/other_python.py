"""The quick tests under the lowest and the highest Python of this machine: `python tests/other_python.py [PYTHON ...]`.

Those that need no bus, recording or picture. A Python that is not there, does not run, or for which a dependency has no
wheel, is said and left out; a test that fails ends with code 1. Environments are kept in .venv-<version>.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
KNOWN = range(11, 16)
TESTS = (
    "tests/schemas",
    "tests/config",
    "tests/centre/test_centre.py",
    "tests/centre/test_clock.py",
    "tests/rules/test_rule_properties.py",
)
NEEDED = ("hypothesis", "pytest", "pytest-xdist")
VERSION = "import sys; print('%d.%d' % sys.version_info[:2])"


def version_of(python: str) -> str | None:
    """3.13, say; None if it is not there or does not run."""
    path = shutil.which(python)
    if path is None:
        return None
    run = subprocess.run([path, "-c", VERSION], capture_output=True, text=True, check=False)
    return run.stdout.strip() if run.returncode == 0 else None


def chosen() -> dict[str, str]:
    """{version: command} of the lowest and the highest Python here, but not of that which runs all tests."""
    found = {f"3.{minor}": f"python3.{minor}" for minor in KNOWN if version_of(f"python3.{minor}") == f"3.{minor}"}
    ends = {version: found[version] for version in (*list(found)[:1], *list(found)[-1:])}
    return {version: command for version, command in ends.items() if version != own()}


def own() -> str | None:
    """The version that runs all tests: that of .venv, or, while there is none yet, this one, which is to make it."""
    return version_of(".venv/bin/python") or version_of(sys.executable)


def tested(version: str, python: str) -> str:
    """Run the tests; what came of it, in a line."""
    here = ROOT / f".venv-{version}"
    if not (here / "ready").exists():
        subprocess.run([python, "-m", "venv", here], check=True)
        install: list[str | Path] = [
            here / "bin" / "pip",
            "install",
            "-q",
            "--only-binary",
            ":all:",
            "-e",
            ".",
            *NEEDED,
        ]
        pins = [
            line.split(" ")[0] for line in (ROOT / "constraints.txt").read_text("utf-8").splitlines() if "==" in line
        ]
        (here / "versions.txt").write_text("\n".join(pins), "utf-8")  # with hashes pip would want one of the package
        constraint = {"PIP_CONSTRAINT": str(here / "versions.txt")}
        done = subprocess.run(
            install, cwd=ROOT, capture_output=True, text=True, check=False, env=os.environ | constraint
        )
        if done.returncode:
            why = next((line for line in done.stderr.splitlines() if line.startswith("ERROR")), done.stderr[-300:])
            return f"skipped: {why}"
        (here / "ready").touch()
    run = subprocess.run(
        [here / "bin" / "python", "-m", "pytest", "-q", "-x", "-n", "2", "-p", "no:cacheprovider", *TESTS],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if run.returncode:
        sys.exit(f"Python {version}:\n{run.stdout}{run.stderr}")
    return run.stdout.strip().splitlines()[-1].strip("= ")


def main(given: list[str]) -> None:
    os.chdir(ROOT)
    told = []
    if given:
        pythons = {version_of(python) or f"{python} (not here, or does not run)": python for python in given}
    else:
        pythons = chosen()
    for version, python in pythons.items():
        told.append(f"{version} {tested(version, python) if version_of(python) else 'skipped'}")
        print(f"Python {told[-1]}", flush=True)
    if not pythons:
        print(f"no Python but {own()} is here: skipped")


if __name__ == "__main__":
    main(sys.argv[1:])
