"""Docstrings of every public name of the wheel follow numpydoc.

The checks are those of `[tool.numpydoc_validation]` in pyproject.toml. Beyond them, a section
named Parameters lists every parameter; names of the front door have all their sections.
"""

import inspect
from importlib import import_module
from types import ModuleType

import pytest

import pupper_sysid
from support.package import FILES, MODULES, PROJECT, public_names

CHECKS = set(PROJECT["tool"]["numpydoc_validation"]["checks"])
COMPLETE = CHECKS | {"PR01", "PR07", "RT01", "RT03", "YD01"}
FRONT_DOOR = sorted(getattr(pupper_sysid, "__all__", []))


@pytest.fixture
def numpydoc() -> ModuleType:
    """The validation, imported by the worker that needs it: it brings Sphinx."""
    return pytest.importorskip("numpydoc.validate")


def violations(numpydoc: ModuleType, name: str, checks: set[str]) -> list[str]:
    """Sentences of numpydoc's validation of one name, for these checks only."""
    try:
        found = numpydoc.validate(name)
    except StopIteration:  # a module without `def` and `class` is too small for it
        summary = (import_module(name).__doc__ or "").split("\n")[0]
        return [] if summary.endswith(".") else [f"{name}: SS03 {summary}"]
    listed = "\nParameters\n" in inspect.cleandoc(found["docstring"] or "")
    wanted = checks | {"PR01"} if listed else checks
    return [f"{name}: {code} {text}" for code, text in found["errors"] if code in wanted]


def test_the_summary_of_every_module_is_a_sentence():
    summaries = {p: p.read_text().split('"""', 2)[1].split("\n\n")[0] for p in FILES.values()}
    assert [path for path, text in summaries.items() if text.rstrip()[-1] != "."] == []


@pytest.mark.slow
def test_public_docstrings_are_clean(monkeypatch, numpydoc):
    # half of the time goes into line numbers and comments that switch a check off: neither is used
    monkeypatch.setattr(numpydoc, "extract_ignore_validation_comments", lambda *_, **__: {})
    monkeypatch.setattr(numpydoc.Validator, "source_file_def_line", None)
    names = [name for module in MODULES for name in public_names(module)]
    assert [v for name in names for v in violations(numpydoc, name, CHECKS)] == []


def test_names_of_the_front_door_have_all_sections(numpydoc):
    items = [getattr(pupper_sysid, name) for name in FRONT_DOOR]
    names = [f"{item.__module__}.{item.__qualname__}" for item in items if callable(item)]
    assert [v for name in names for v in violations(numpydoc, name, COMPLETE)] == []
