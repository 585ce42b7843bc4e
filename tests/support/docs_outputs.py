"""`docs/outputs.py`, for the tests: what commands print in the pages."""

import importlib.util
from pathlib import Path

_spec = importlib.util.spec_from_file_location(
    "docs_outputs", Path(__file__).resolve().parents[2] / "docs/outputs.py"
)
assert _spec is not None and _spec.loader is not None
_module = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(_module)

BLOCK, differs = _module.BLOCK, _module.differs
