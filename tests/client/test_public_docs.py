"""Every public name of the SDK is documented in its source, fields included."""

import ast
import inspect
from collections.abc import Iterator
from pathlib import Path

import pytest

import vergence

NAMES = [name for name in vergence.__all__ if inspect.isroutine(getattr(vergence, name))]
CLASSES = [name for name in vergence.__all__ if inspect.isclass(getattr(vergence, name))]
# An error class documents its code, and the code has no text of its own.
BY_ITS_CLASS = {"ErrorCode"}
NOT_FIELDS = {"code"}


def definition(name: str) -> ast.ClassDef | ast.FunctionDef:
    source = inspect.getsourcefile(getattr(vergence, name))
    assert source is not None
    for node in ast.parse(Path(source).read_text("utf-8")).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == name:
            return node
    raise AssertionError(f"{name} is not defined in {source}")


def without_string(node: ast.ClassDef) -> Iterator[str]:
    """The public fields, members, methods and properties of a class that say nothing."""
    for index, each in enumerate(node.body):
        if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef):
            quiet = each.name in ("__init__", "__post_init__", "__aiter__", "__iter__")
            private = each.name.startswith("_") and not each.name.startswith("__")
            if not (quiet or private or ast.get_docstring(each)):
                yield each.name
        elif isinstance(each, ast.AnnAssign | ast.Assign):
            target = each.target if isinstance(each, ast.AnnAssign) else each.targets[0]
            assert isinstance(target, ast.Name)
            following = node.body[index + 1] if index + 1 < len(node.body) else None
            said = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
            if not (said or target.id.startswith("_") or target.id in NOT_FIELDS):
                yield target.id


def test_every_public_name_is_a_class_a_function_or_a_constant() -> None:
    constants = {name for name in vergence.__all__ if name.isupper()}
    assert {*NAMES, *CLASSES} | constants == set(vergence.__all__)
    assert len(CLASSES) > 50


@pytest.mark.parametrize("name", [*NAMES, *CLASSES])
def test_it_has_a_docstring_of_its_own(name: str) -> None:
    assert ast.get_docstring(definition(name)), name


@pytest.mark.parametrize("name", sorted({*CLASSES} - BY_ITS_CLASS))
def test_no_member_is_without_a_docstring_or_a_string_under_it(name: str) -> None:
    node = definition(name)
    assert isinstance(node, ast.ClassDef)
    assert list(without_string(node)) == []


def test_an_undocumented_field_is_found() -> None:
    node = ast.parse("class A:\n    x: int\n    y: int\n    'y'\n    def f(self): ...\n").body[0]
    assert isinstance(node, ast.ClassDef)
    assert list(without_string(node)) == ["x", "f"]
