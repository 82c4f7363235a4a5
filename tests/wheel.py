"""The wheel, built and tried in an empty environment, as a user gets it: `python tests/wheel.py`.

Not collected by pytest: it takes packages from the index. Two environments: bare, for a client on a small computer
(`record` must say what is missing in one line), then with the extra `record`.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
STATIC = "fusion_service/console/static"
"""The console's page, which is no Python."""
VERSION = """
import importlib.metadata, fusion_service
version = importlib.metadata.version("track-fusion-centre")
assert version == fusion_service.__version__, (version, fusion_service.__version__)
print(version)
"""
CLIENT = """
import sys
import schemas
from sensor_clients.publisher import TrackPublisher
assert "site-packages" in schemas.__file__, schemas.__file__
assert not {"scipy", "rerun"} & set(sys.modules)
assert TrackPublisher("radar1").source == "radar1"
"""
CENTRE = """
from fusion_service.centre import FusionCentre
import schemas
result = FusionCentre({}).step(10**9)
assert schemas.decode(schemas.encode(result.tracks)).step == 1
"""


def run(*command: str | Path, code: int = 0, folder: Path) -> str:
    """What it printed; ends the test if it exits with anything else than `code`."""
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False, cwd=folder, env=clean)
    if done.returncode != code:
        sys.exit(
            f"{' '.join(map(str, command))}\nended with {done.returncode}, not {code}:\n{done.stdout}{done.stderr}"
        )
    return done.stdout + done.stderr


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        pins = [
            line.split(" ")[0] for line in (ROOT / "constraints.txt").read_text("utf-8").splitlines() if "==" in line
        ]
        (folder / "versions.txt").write_text("\n".join(pins), "utf-8")  # with hashes pip would want one of the wheel
        os.environ["PIP_CONSTRAINT"] = str(folder / "versions.txt")
        run(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, ROOT, folder=folder)
        (wheel,) = folder.glob("*.whl")
        names = set(zipfile.ZipFile(wheel).namelist())
        assert {name.partition("/")[0] for name in names if ".dist-info" not in name} == {
            "fusion_service",
            "schemas",
            "sensor_clients",
        }
        for package in ("fusion_service", "schemas", "sensor_clients"):
            assert f"{package}/py.typed" in names, package
        assert "schemas/WIRE.md" in names
        page = {path.relative_to(ROOT).as_posix() for path in (ROOT / STATIC).rglob("*") if path.is_file()}
        assert {f"{STATIC}/index.html", f"{STATIC}/leaflet/leaflet.js", f"{STATIC}/leaflet/LICENSE"} <= page
        assert page <= names, page - names
        assert any(name.startswith("schemas/vectors/") for name in names)
        venv.create(folder / "empty", with_pip=True)
        there = folder / "empty" / "bin"
        run(there / "pip", "install", "-q", wheel, folder=folder)
        version = run(there / "python", "-c", VERSION, folder=folder).strip()
        run(there / "python", "-W", "error", "-c", CLIENT, folder=folder)
        run(there / "python", "-W", "error", "-c", CENTRE, folder=folder)
        assert "hmd-ga" in run(there / "fusion-service", "rules", folder=folder)
        (folder / "centre.toml").write_text(run(there / "fusion-service", "check", folder=folder), "utf-8")
        assert "good" in run(there / "fusion-service", "check", "centre.toml", folder=folder)
        assert "three-radars" in run(there / "sensor-client", "list", folder=folder)
        (folder / "mission.rrd").write_bytes(b"")
        told = run(there / "fusion-service", "evaluate", "mission.rrd", code=1, folder=folder).strip()
        assert len(told.splitlines()) == 1, told
        assert "record" in told, told
        print(f"{wheel.name}: version {version}, installed and tried without extras")


if __name__ == "__main__":
    main()
