"""Every Sphinx cross-reference in a docstring or comment names something that exists."""

import ast
import importlib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

PACKAGES = ("vergence", "vergence_proto", "vergence_service", "vergence_models")
REFERENCE = re.compile(r":(?:attr|class|data|exc|func|meth|mod|obj):`~?([\w.]+)`")


@dataclass(frozen=True)
class Reference:
    module: str
    scope: str  # the class whose docstring holds it, or whose method's does; else empty
    target: str


def references(module: str, path: Path) -> Iterator[Reference]:
    """Every reference of a file; one in a comment counts as the module's."""
    source = path.read_text("utf-8")
    tree = ast.parse(source)
    spans = [
        (node.lineno, node.end_lineno or node.lineno, node.name)
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    ]
    for number, line in enumerate(source.splitlines(), start=1):
        inside = [(start, name) for start, end, name in spans if start <= number <= end]
        scope = max(inside)[1] if inside else ""
        for target in REFERENCE.findall(line):
            yield Reference(module, scope, target)


def found_in(owner: object, dotted: str) -> bool:
    for name in dotted.split("."):
        if name in getattr(owner, "__annotations__", {}) and not hasattr(owner, name):
            return True  # a field without a default
        if not hasattr(owner, name):
            return False
        owner = getattr(owner, name)
    return True


def resolves(reference: Reference) -> bool:
    """Look in the class, then in the module, then from the top, as Sphinx does."""
    module = importlib.import_module(reference.module)
    owners = [getattr(module, reference.scope, module), module]
    if any(found_in(owner, reference.target) for owner in owners):
        return True
    parts = reference.target.split(".")
    for count in range(len(parts), 0, -1):
        try:
            top = importlib.import_module(".".join(parts[:count]))
        except ImportError:
            continue
        return found_in(top, ".".join(parts[count:])) if parts[count:] else True
    return False


@pytest.mark.parametrize("package", PACKAGES)
def test_every_cross_reference_resolves(package: str) -> None:
    if package == "vergence_models":
        pytest.importorskip("torch", reason="its modules need the train extra")
    folder = Path(str(importlib.import_module(package).__file__)).parent
    unresolved = []
    for path in sorted(folder.rglob("*.py")):
        parts = path.relative_to(folder).with_suffix("").parts
        name = ".".join((package, *parts)).removesuffix(".__init__")
        unresolved += [each for each in references(name, path) if not resolves(each)]
    assert not unresolved


def test_a_reference_to_nothing_is_found() -> None:
    assert not resolves(Reference("vergence_proto.codec", "", "vergence_proto.codec.nothing"))
    assert not resolves(Reference("vergence_proto.geometry", "Axes", "nothing"))
    assert resolves(Reference("vergence_proto.geometry", "Axes", "to_opencv"))
    assert resolves(Reference("vergence_proto.geometry", "", "vergence_proto.types.PoseSample"))
