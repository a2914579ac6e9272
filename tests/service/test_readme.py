"""The tables of service/README.md state what the code defines."""

import json
import re
from pathlib import Path

from prometheus_client import CollectorRegistry
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from vergence_service.process.metrics import Metrics
from vergence_service.settings import Settings

README = (Path(__file__).parents[2] / "service" / "README.md").read_text("utf-8")


def expected_rows() -> list[str]:
    """One row per key: its name, its default and its meaning."""
    rows = []
    for name, field in Settings.model_fields.items():
        if isinstance(field.default, BaseModel):
            section = type(field.default)
            rows += [row(f"{name}.{key}", each) for key, each in section.model_fields.items()]
        else:
            rows.append(row(name, field))
    return rows


def row(key: str, field: FieldInfo) -> str:
    assert field.description, f"{key} has no description"
    default = "not set" if field.default is None else f"`{json.dumps(field.default)}`"
    return f"| `{key}` | {default} | {field.description} |"


def test_the_table_of_settings_equals_the_settings() -> None:
    table = README.partition("| key | default | meaning |\n|---|---|---|\n")[2]
    assert table.partition("\n\n")[0].splitlines() == expected_rows()


def test_every_metric_is_listed_and_no_other() -> None:
    registry = CollectorRegistry()
    Metrics(registry)
    names = {
        metric.name + ("_total" if metric.type == "counter" else "")
        for metric in registry.collect()
    }
    assert set(re.findall(r"^\| `(vergence_\w+)` \|", README, re.M)) == names
