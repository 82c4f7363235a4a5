"""The manifests of Kubernetes: every line is a command of ours, ports and probes are those that are served, and the
schemas of Kubernetes find nothing wrong."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from fusion_service import __version__, cli
from fusion_service.config import load_config
from tests.test_docker import DOCKER

FOLDER = Path(__file__).parents[2] / "deploy" / "kubernetes"
VERSIONS = ("1.28", "1.33")
OF_OTHERS = ("Kustomization", "PodMonitor")
"""Kinds that are no part of Kubernetes itself, and of which there is no schema here."""


def objects() -> list[tuple[str, dict[str, Any]]]:
    return [(path.name, one) for path in sorted(FOLDER.glob("*.yaml")) for one in yaml.safe_load_all(path.read_text())]


OBJECTS = objects()
PODS = {one["metadata"]["name"]: one for _, one in OBJECTS if one["kind"] in ("Deployment", "StatefulSet")}


def container(name: str) -> dict[str, Any]:
    (found,) = PODS[name]["spec"]["template"]["spec"]["containers"]
    assert isinstance(found, dict)
    return found


def test_all_files_are_applied() -> None:
    (kustomization,) = [one for _, one in OBJECTS if one["kind"] == "Kustomization"]
    assert set(kustomization["resources"]) == {name for name, _ in OBJECTS} - {"kustomization.yaml", "podmonitor.yaml"}
    assert kustomization["images"] == [{"name": "track-fusion-centre", "newTag": __version__}]


@pytest.mark.parametrize("name", PODS)
def test_what_runs_is_a_command_that_serves_what_is_asked(name: str) -> None:
    one = container(name)
    program, *words = one["args"]
    assert program == "fusion-service"
    args = cli._parser().parse_args(words)
    assert args.log_format == "json"
    host, port = args.listen if name == "metrics" else args.metrics
    assert host == "0.0.0.0"
    ports = {entry["name"]: entry["containerPort"] for entry in one["ports"]}
    assert ports["metrics"] == port
    for probe in ("startupProbe", "readinessProbe", "livenessProbe"):
        if "httpGet" in one.get(probe, {}):
            assert one[probe]["httpGet"]["port"] in ports
            assert one[probe]["httpGet"]["path"] in ("/healthz", "/readyz")
    alive = one["livenessProbe"].get("httpGet", {}).get("path")
    assert alive in (None, "/healthz")  # who waits for the hub must not be ended for it
    services = [entry for _, entry in OBJECTS if entry["kind"] == "Service" and entry["metadata"]["name"] == name]
    for service in services:
        assert {entry["targetPort"] for entry in service["spec"]["ports"]} <= set(ports)
        assert all(entry["port"] == ports[entry["targetPort"]] for entry in service["spec"]["ports"])
    assert len(services) == 1


@pytest.mark.parametrize("name", PODS)
def test_none_is_root_and_none_writes_but_on_volumes(name: str) -> None:
    template = PODS[name]["spec"]["template"]["spec"]
    assert template["securityContext"]["runAsNonRoot"] is True
    assert f"USER {template['securityContext']['runAsUser']}:" in (DOCKER / "Dockerfile").read_text()
    assert template["automountServiceAccountToken"] is False
    one = container(name)
    assert one["securityContext"] == {
        "allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]},
    }  # fmt: skip
    assert one["resources"]["limits"]["memory"]
    claimed = {claim["metadata"]["name"] for claim in PODS[name]["spec"].get("volumeClaimTemplates", [])}
    given = claimed | {volume["name"] for volume in template["volumes"]}
    assert {mount["name"] for mount in one["volumeMounts"]} == given
    assert claimed == {"centre": {"state"}, "recorder": {"recordings"}}.get(name, set())


def test_what_must_last_is_on_its_volume(tmp_path: Path) -> None:
    (text,) = [one["data"]["centre.toml"] for _, one in OBJECTS if one["kind"] == "ConfigMap"]
    (tmp_path / "centre.toml").write_text(text)
    mounts = {mount["name"]: mount["mountPath"] for mount in container("centre")["volumeMounts"]}
    assert load_config(tmp_path / "centre.toml").service.state == mounts["state"]
    assert container("centre")["args"][3] == f"{mounts['config']}/centre.toml"
    assert tomllib.loads(text)["bus"]["connect"] == ["tcp/hub:7447"]
    mounts = {mount["name"]: mount["mountPath"] for mount in container("recorder")["volumeMounts"]}
    record = cli._parser().parse_args(container("recorder")["args"][1:])
    assert record.out.startswith(f"{mounts['recordings']}/")


def test_the_schemas_of_kubernetes_find_nothing_wrong() -> None:
    validator = pytest.importorskip(
        "kubernetes_validate", reason="kubernetes-validate (108 MB of schemas) is not installed: pip install it"
    )
    for name, one in OBJECTS:
        if one["kind"] not in OF_OTHERS:
            for version in VERSIONS:
                assert validator.validate(one, version, strict=True), name
