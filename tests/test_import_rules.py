"""The import rules of the layout, read from the source of every module (imports inside functions count too)."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import accumulate
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("schemas", "fusion_service", "sensor_clients")
GROUND_FLOOR = {
    f"fusion_service.{name}"
    for name in (
        *("linalg", "geodesy", "hulls", "motion", "coverage", "metrics", "existence", "process", "progress", "colours"),
        *(
            "errors",
            "arrays",
            "order",
            "records",
            "turn",
            "ways",
            "source_words",
            "decision_words",
            "layout",
            "compiled",
            "escape",
        ),
        *("logs", "hangup", "lifeline", "decision_words", "extras", "labels"),
    )
}
STANDS_ON = {
    "schemas": set(),
    **{name: {*GROUND_FLOOR, "schemas", "fusion_service.densities"} for name in sorted(GROUND_FLOOR)},
    "fusion_service.densities": {*GROUND_FLOOR},
    "fusion_service.hints": {*GROUND_FLOOR, "schemas"},
    "fusion_service.monitoring": {*GROUND_FLOOR, "schemas"},
    "fusion_service.rules": {*GROUND_FLOOR, "fusion_service.densities"},
    "fusion_service.bus": {*GROUND_FLOOR, "schemas"},
    "fusion_service.lookout": {*GROUND_FLOOR, "schemas", "fusion_service.bus", "fusion_service.hints"},
    "fusion_service.config": {*GROUND_FLOOR, "schemas", "fusion_service.rules", "fusion_service.bus.endpoint"},
    "fusion_service.centre": {
        *(*GROUND_FLOOR, "schemas", "fusion_service.densities", "fusion_service.rules", "fusion_service.config"),
    },
    "fusion_service.service": {
        *(*GROUND_FLOOR, "schemas", "fusion_service.bus", "fusion_service.config", "fusion_service.centre"),
        "fusion_service.hints",
    },
    "fusion_service.console": {
        *(*GROUND_FLOOR, "schemas", "fusion_service.densities", "fusion_service.bus", "fusion_service.hints"),
    },
    "fusion_service.recording": {
        *(*GROUND_FLOOR, "schemas", "fusion_service.densities", "fusion_service.bus", "fusion_service.config"),
    },
    "fusion_service.review": {
        *(*GROUND_FLOOR, "schemas", "fusion_service.densities", "fusion_service.config", "fusion_service.centre"),
        *("fusion_service.recording", "fusion_service.rules"),
    },
    "sensor_clients": {
        *(*GROUND_FLOOR, "schemas", "fusion_service.densities", "fusion_service.bus", "fusion_service.hints"),
    },
}
"""What each package may import of ours, beside itself and the version."""
LONGEST_FILE = 400
LONGEST_FUNCTION = 60


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))}


def imports(source: str, module: str, is_package: bool = False) -> set[str]:
    """Full names of what a module imports; for `from a import b` both `a.b` and, unless it is a bare package, `a`."""
    return {name for node in ast.walk(ast.parse(source)) for name in imported(node, module, is_package)}


def imported(node: ast.AST, module: str, is_package: bool) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        base = node.module or ""
        if node.level:
            parts = module.split(".")
            parents = parts[: len(parts) - node.level + is_package]
            base = ".".join([*parents, base] if base else parents)
        names = [f"{base}.{alias.name}" for alias in node.names]
        yield from names
        if base not in PACKAGES:
            yield base
    elif isinstance(node, ast.Call):
        called = getattr(node.func, "attr", getattr(node.func, "id", ""))
        if called.endswith(("import_module", "__import__")):
            argument = node.args[0] if node.args else None
            yield argument.value if isinstance(argument, ast.Constant) and isinstance(argument.value, str) else "?"


@dataclass(frozen=True)
class Read:
    """What is asked of a file, which is parsed once for all."""

    lines: int
    imports: set[str]
    relative: list[int]
    """Lines of relative imports."""
    functions: dict[str, int]
    """Their lengths in lines."""
    attributes: set[str]
    listed: list[str]
    """`__all__`."""
    here: set[str]
    """Names that are defined or set."""
    given: set[str]
    """Names that an import binds."""


@cache
def read(path: Path) -> Read:
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    found = Read(len(text.splitlines()), set(), [], {}, set(), _all(tree), set(), set())
    module, is_package = module_name(path), path.name == "__init__.py"
    for node in ast.walk(tree):
        found.imports.update(imported(node, module, is_package))
        if isinstance(node, ast.FunctionDef):
            assert node.end_lineno is not None
            found.functions[f"{node.name} of line {node.lineno}"] = node.end_lineno - node.lineno + 1
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found.here.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.here.add(node.id)
        elif isinstance(node, ast.Attribute):
            found.attributes.add(node.attr)
        elif isinstance(node, (ast.Import, ast.ImportFrom)):
            found.given.update((alias.asname or alias.name).split(".")[0] for alias in node.names)
            if isinstance(node, ast.ImportFrom) and node.level:
                found.relative.append(node.lineno)
    return found


def _all(tree: ast.Module) -> list[str]:
    for node in tree.body:
        if isinstance(node, ast.Assign) and [ast.unparse(target) for target in node.targets] == ["__all__"]:
            return list(ast.literal_eval(node.value))
    return []


@cache
def all_imports() -> dict[str, set[str]]:
    """{module: full names of what it imports}."""
    return {name: read(path).imports for name, path in MODULES.items()}


@cache
def users() -> dict[str, list[tuple[str, str]]]:
    """{module: (another module, a name that it takes from there)}, without what is a module itself."""
    found: dict[str, list[tuple[str, str]]] = {module: [] for module in MODULES}
    for other, names in all_imports().items():
        for name in names - set(MODULES):
            for module in accumulate(name.split(".")[:-1], "{}.{}".format):
                if module in MODULES:
                    found[module].append((other, name.removeprefix(f"{module}.")))
    return found


def below(name: str, parents: set[str]) -> bool:
    return any(name == parent or name.startswith(parent + ".") for parent in parents)


def ours(names: set[str]) -> set[str]:
    return {name for name in names if below(name, set(PACKAGES))}


def breaches(of: set[str], forbidden: set[str]) -> list[str]:
    """What the modules below `of` import of what is `forbidden`."""
    return [
        f"{module} imports {name}"
        for module, names in all_imports().items()
        if below(module, of)
        for name in sorted(names)
        if below(name, forbidden)
    ]


def reach(start: str) -> set[str]:
    """Everything imported by `start`, by our modules that it imports, and so on."""
    seen: set[str] = set()
    rest = [start]
    while rest:
        for name in all_imports()[rest.pop()] - seen:
            seen.add(name)
            if name in all_imports():
                rest.append(name)
    return seen


def test_the_reader_of_imports_reads_them() -> None:
    source = "import a.b as c\nfrom d import e\nfrom . import f\nfrom ..g import h\ndef k():\n  import m"
    assert imports(source, "p.q.r") == {"a.b", "d", "d.e", "p.q", "p.q.f", "p.g", "p.g.h", "m"}
    assert imports("from .x import y", "p.q", is_package=True) == {"p.q.x", "p.q.x.y"}
    assert imports("from fusion_service import bus", "p") == {"fusion_service.bus"}
    assert imports("importlib.import_module('zenoh')\nimportlib.import_module(x)", "p") == {"zenoh", "?"}
    assert {"schemas.codec", "schemas.keys"} <= set(MODULES)
    assert "msgpack" in all_imports()["schemas.codec"]
    assert "numpy" in reach("schemas.codec")


def test_what_is_imported_is_known_when_read() -> None:
    assert not [module for module, names in all_imports().items() if "?" in names]


def test_schemas_needs_numpy_and_msgpack_only() -> None:
    allowed = {"schemas", "numpy", "msgpack", *sys.stdlib_module_names}
    for module, names in all_imports().items():
        if below(module, {"schemas"}):
            assert {name for name in names if not below(name, allowed)} == set(), module


@pytest.mark.parametrize("package", STANDS_ON)
def test_a_package_stands_on_what_is_below_it(package: str) -> None:
    allowed = {package, "fusion_service.__version__", *STANDS_ON[package]}
    found = [
        f"{module} imports {name}"
        for module, names in all_imports().items()
        if below(module, {package})
        for name in sorted(ours(names))
        if not below(name, allowed)
    ]
    assert found == []


def test_no_import_goes_in_a_circle() -> None:
    """Imports inside functions and for types only are counted. A package's face stands for what it hands on."""
    within = {
        module: {name for name in names if name in MODULES and name != module and not module.startswith(f"{name}.")}
        for module, names in all_imports().items()
    }
    done: set[str] = set()
    path: list[str] = []

    def visit(module: str) -> None:
        if module in path:
            raise AssertionError(" -> ".join([*path[path.index(module) :], module]))
        if module not in done:
            path.append(module)
            for name in sorted(within[module]):
                visit(name)
            path.pop()
            done.add(module)

    for module in sorted(within):
        visit(module)


@pytest.mark.parametrize("package", ["fusion_service.centre", "fusion_service.rules"])
def test_the_core_reaches_no_bus(package: str) -> None:
    """Neither directly nor through what it imports: whatever zenoh does, the centre can be made and stepped."""
    outside = {"fusion_service.bus.session", "fusion_service.service", "fusion_service.recording", "zenoh", "rerun"}
    reached = {name for module in MODULES if below(module, {package}) for name in reach(module)}
    assert [found for found in sorted(reached) if below(found, outside)] == []


def test_the_service_knows_no_mathematics() -> None:
    mathematics = {f"fusion_service.{name}" for name in ("linalg", "densities", "rules", "existence")}
    assert breaches({"fusion_service.service"}, mathematics | {"numpy.linalg", "scipy"}) == []
    for module, path in MODULES.items():
        if below(module, {"fusion_service.service"}):
            assert "linalg" not in read(path).attributes


def test_what_is_installed_stands_without_studies_benchmarks_and_tests() -> None:
    assert breaches(set(PACKAGES), {"studies", "benchmarks", "tests"}) == []


def test_imports_are_absolute() -> None:
    for path in MODULES.values():
        assert read(path).relative == [], path


def test_a_file_answers_one_question() -> None:
    """No file over 400 lines; no function over 60, but in the studies, which say one experiment from end to end."""
    long: list[str] = []
    for folder in (*PACKAGES, "studies", "benchmarks"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            name = path.relative_to(ROOT)
            if folder not in PACKAGES:
                lines = len(path.read_text(encoding="utf-8").splitlines())
                long += [f"{name}: {lines} lines"] * (lines > LONGEST_FILE)
                continue
            found = read(path)
            long += [f"{name}: {found.lines} lines"] * (found.lines > LONGEST_FILE)
            long += [
                f"{name}: {one} has {size} lines" for one, size in found.functions.items() if size > LONGEST_FUNCTION
            ]
    assert long == []


@pytest.mark.parametrize("module", sorted(MODULES))
def test_all_says_what_is_exported(module: str) -> None:
    """`__all__` is every public name that a module defines and others import, and nothing that is not there."""
    found = read(MODULES[module])
    assert set(found.listed) <= found.here | found.given
    assert len(set(found.listed)) == len(found.listed)
    used = {name for other, name in users()[module] if other != module and not other.startswith(f"{module}.")}
    public = {name for name in used & found.here if not name.startswith("_")}
    assert public - set(found.listed) == set()


def test_nothing_imports_cli() -> None:
    for package in ("fusion_service", "sensor_clients"):
        cli = {f"{package}.cli"}
        doors = tuple(f"{package}.{name} " for name in ("cli", "__main__"))
        assert [breach for breach in breaches(set(PACKAGES), cli) if not breach.startswith(doors)] == []


def test_only_the_bus_imports_zenoh() -> None:
    using = {module for module, names in all_imports().items() if any(below(name, {"zenoh"}) for name in names)}
    assert using <= {"fusion_service.bus.session", "fusion_service.bus.joining"}


def test_only_recording_imports_rerun() -> None:
    using = {module for module, names in all_imports().items() if any(below(name, {"rerun"}) for name in names)}
    assert {module for module in using if not below(module, {"fusion_service.recording"})} == set()


def loaded_by(module: str) -> set[str]:
    """What a process has loaded that imports this alone."""
    code = f"import {module}, sys; print(*sys.modules)"
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False, cwd=ROOT
    )
    assert run.returncode == 0, run.stderr
    return set(run.stdout.split())


def test_publisher_loads_neither_scipy_nor_rerun() -> None:
    loaded = {name.split(".")[0] for name in loaded_by("sensor_clients.publisher")}
    assert {"schemas", "sensor_clients", "numpy"} <= loaded
    assert loaded & {"scipy", "rerun", "matplotlib", "pyarrow"} == set()


def test_a_service_starts_without_what_takes_longest_to_import() -> None:
    loaded = loaded_by("fusion_service.service.daemon")
    assert {"fusion_service.centre.centre", "scipy.special", "zenoh"} <= loaded
    assert loaded & {"scipy.stats", "rerun", "matplotlib", "pyarrow", "numba"} == set()
