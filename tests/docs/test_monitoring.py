"""The files for operators name what the server has."""

import json
import re
from pathlib import Path

import pytest
import yaml
from prometheus_client import CollectorRegistry

from vergence_service.process.metrics import Metrics
from vergence_service.settings import load_settings

DOCKER = Path(__file__).parents[2] / "docker"


def test_every_metric_of_the_dashboard_exists() -> None:
    registry = CollectorRegistry()
    Metrics(registry)
    # A metric with labels has no samples yet; its name says which it will have.
    known = {metric.name for metric in registry.collect()}
    dashboard = json.loads((DOCKER / "monitoring" / "dashboard.json").read_text())
    queries = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    used = {name for query in queries for name in re.findall(r"vergence_\w+", query)}
    assert used
    assert not {re.sub(r"_(total|bucket|count|sum)$", "", name) for name in used} - known


def test_the_settings_of_compose_and_kubernetes_are_settings(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    compose = yaml.safe_load((DOCKER / "compose.fleet.yaml").read_text())
    manifests = yaml.safe_load_all((DOCKER / "kubernetes" / "servers.yaml").read_text())
    [deployment] = [each for each in manifests if each["kind"] == "Deployment"]
    [container] = deployment["spec"]["template"]["spec"]["containers"]
    of_kubernetes = {each["name"]: each["value"] for each in container["env"]}
    of_compose = compose["services"]["vergence"]["environment"]
    assert of_kubernetes == of_compose
    for name, value in of_compose.items():
        monkeypatch.setenv(name, value)
    settings = load_settings()
    assert settings.snapshots.store.startswith("redis://")
    assert settings.security.tokens is not None
