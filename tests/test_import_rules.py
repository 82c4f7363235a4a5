"""The import rules of the layout, read from the source of every module (imports inside functions count too)."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("schemas", "fusion_service", "sensor_clients")
GROUND_FLOOR = {f"fusion_service.{name}" for name in ("linalg", "densities", "geodesy", "motion", "bus")}


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))}


def imports(source: str, module: str, is_package: bool = False) -> Iterator[str]:
    """Full names of what a module imports; for `from a import b` both `a.b` and, unless it is a bare package, `a`."""
    for node in ast.walk(ast.parse(source)):
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
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "__import__")):
            argument = node.args[0] if node.args else None
            yield argument.value if isinstance(argument, ast.Constant) and isinstance(argument.value, str) else "?"


IMPORTS = {
    name: set(imports(path.read_text(encoding="utf-8"), name, path.name == "__init__.py"))
    for name, path in MODULES.items()
}


def below(name: str, parents: set[str]) -> bool:
    return any(name == parent or name.startswith(parent + ".") for parent in parents)


def ours(names: set[str]) -> set[str]:
    return {name for name in names if below(name, set(PACKAGES))}


def breaches(of: set[str], forbidden: set[str]) -> list[str]:
    """What the modules below `of` import of what is `forbidden`."""
    return [
        f"{module} imports {name}"
        for module, names in IMPORTS.items()
        if below(module, of)
        for name in sorted(names)
        if below(name, forbidden)
    ]


def reach(start: str) -> set[str]:
    """Everything imported by `start`, by our modules that it imports, and so on."""
    seen: set[str] = set()
    rest = [start]
    while rest:
        for name in IMPORTS[rest.pop()] - seen:
            seen.add(name)
            if name in IMPORTS:
                rest.append(name)
    return seen


def test_the_reader_of_imports_reads_them() -> None:
    source = "import a.b as c\nfrom d import e\nfrom . import f\nfrom ..g import h\ndef k():\n  import m"
    assert set(imports(source, "p.q.r")) == {"a.b", "d", "d.e", "p.q", "p.q.f", "p.g", "p.g.h", "m"}
    assert set(imports("from .x import y", "p.q", is_package=True)) == {"p.q.x", "p.q.x.y"}
    assert set(imports("from fusion_service import bus", "p")) == {"fusion_service.bus.session"}
    assert set(imports("importlib.import_module('zenoh')\nimportlib.import_module(x)", "p")) == {"zenoh", "?"}
    assert {"schemas.codec", "schemas.keys"} <= set(MODULES)
    assert "msgpack" in IMPORTS["schemas.codec"]
    assert "numpy" in reach("schemas.codec")


def test_what_is_imported_is_known_when_read() -> None:
    assert not [module for module, names in IMPORTS.items() if "?" in names]


def test_schemas_needs_numpy_and_msgpack_only() -> None:
    allowed = {"schemas", "numpy", "msgpack", *sys.stdlib_module_names}
    for module, names in IMPORTS.items():
        if below(module, {"schemas"}):
            assert {name for name in names if not below(name, allowed)} == set(), module


def test_fusion_service_never_imports_sensor_clients() -> None:
    assert breaches({"fusion_service"}, {"sensor_clients"}) == []


def test_sensor_clients_stand_on_the_ground_floor() -> None:
    for module, names in IMPORTS.items():
        if below(module, {"sensor_clients"}):
            used = {name for name in names if below(name, {"fusion_service"})}
            assert {name for name in used if not below(name, GROUND_FLOOR)} == set(), module


def test_rules_know_no_track() -> None:
    allowed = {"fusion_service.rules", "fusion_service.linalg", "fusion_service.densities"}
    for module, names in IMPORTS.items():
        if below(module, {"fusion_service.rules"}):
            assert {name for name in ours(names) if not below(name, allowed)} == set(), module


def test_what_is_installed_stands_without_studies_benchmarks_and_tests() -> None:
    assert breaches(set(PACKAGES), {"studies", "benchmarks", "tests"}) == []


@pytest.mark.parametrize("name", ["centre", "association", "lifecycle"])
def test_the_centre_knows_no_bus(name: str) -> None:
    """Neither directly nor through what it imports."""
    outside = {"fusion_service.bus.session", "fusion_service.service.daemon", "zenoh"}
    assert [found for found in sorted(reach(f"fusion_service.{name}")) if below(found, outside)] == []


def test_daemon_knows_no_mathematics() -> None:
    mathematics = {f"fusion_service.{name}" for name in ("linalg", "densities", "rules", "association", "existence")}
    assert breaches({"fusion_service.service.daemon"}, mathematics | {"numpy.linalg", "scipy"}) == []
    for module, path in MODULES.items():
        if below(module, {"fusion_service.service.daemon"}):
            attributes = {n.attr for n in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(n, ast.Attribute)}
            assert "linalg" not in attributes


def test_nothing_imports_cli() -> None:
    for package in ("fusion_service", "sensor_clients"):
        cli = {f"{package}.cli"}
        doors = tuple(f"{package}.{name} " for name in ("cli", "__main__"))
        assert [breach for breach in breaches(set(PACKAGES), cli) if not breach.startswith(doors)] == []


def test_only_the_bus_imports_zenoh() -> None:
    users = {module for module, names in IMPORTS.items() if any(below(name, {"zenoh"}) for name in names)}
    assert users <= {"fusion_service.bus.session"}


def test_only_recording_imports_rerun() -> None:
    users = {module for module, names in IMPORTS.items() if any(below(name, {"rerun"}) for name in names)}
    assert {module for module in users if not below(module, {"fusion_service.recording"})} == set()


def test_publisher_loads_neither_scipy_nor_rerun() -> None:
    code = "import sensor_clients.publisher, sys; print(*sorted({name.split('.')[0] for name in sys.modules}))"
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False, cwd=ROOT
    )
    assert run.returncode == 0, run.stderr
    loaded = set(run.stdout.split())
    assert {"schemas", "sensor_clients", "numpy"} <= loaded
    assert loaded & {"scipy", "rerun", "matplotlib", "pyarrow"} == set()
