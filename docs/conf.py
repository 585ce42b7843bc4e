"""Sphinx: pages in Markdown, and the reference of every command, generated from the code."""

from __future__ import annotations

import io
import os
import re
import shutil
import sys
import tomllib
from contextlib import redirect_stderr, redirect_stdout, suppress
from importlib import import_module
from pathlib import Path
from types import GenericAlias
from typing import ClassVar, get_args
from unittest.mock import patch

from jinja2 import Template
from jinja2.sandbox import SandboxedEnvironment
from numpydoc import docscrape_sphinx
from sphinx.addnodes import pending_xref
from sphinx.domains.python import PythonDomain

from pupper_sysid.cli.program import words

HERE = Path(__file__).resolve().parent
REFERENCE = HERE / "reference"  # written by `setup`
GALLERY = HERE / "gallery"  # the same
_PLAIN = {"COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"}

project = "pupper-sysid"
copyright = "the pupper-sysid developers, Apache-2.0"
sys.path.insert(0, str(HERE))
extensions = ["myst_parser", "sphinx.ext.autodoc", "numpydoc", "mathml"]
html_math_renderer = "mathml"
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
default_role = "code"  # docstrings write code in single back quotes
add_module_names = False
python_maximum_signature_line_length = 88
autodoc_typehints = "signature"
toc_object_entries = False
autodoc_member_order = "bysource"
numpydoc_show_class_members = False
autosummary_generate = False
# two classes of one name, in two rooms, are told apart by the page that is linked to
suppress_warnings = ["ref.python"]
html_theme = "furo"
html_title = "pupper-sysid"
html_static_path = ["style"]
html_css_files = ["pages.css"]
html_search_scorer = str(HERE / "style/scorer.js")
# code that no highlighter knows is shown as it is
highlight_language = "text"

_PROGRAMS = (
    "pupper_sysid", "pupper_train", "pupper_play", "pupper_eval", "pupper_deploy",
    "pupper_analyze",
)  # fmt: skip


def help_text(module: str, *words: str) -> str:
    """What `--help-all` prints, without colours and without the lines' empty ends."""
    said, plain = io.StringIO(), patch.dict(os.environ, _PLAIN)
    with plain, redirect_stdout(said), redirect_stderr(said), suppress(SystemExit):
        import_module(f"pupper_sysid.cli.programs.{module}").main([*words, "--help-all"])
    text = re.sub(r"\x1b\[[0-9;]*m", "", said.getvalue())
    return "\n".join(line.rstrip() for line in text.splitlines()).strip()


def subcommands(module: str) -> list[str]:
    """Names of a program's commands, those of a command's own as two words; empty without any."""
    program = import_module(f"pupper_sysid.cli.programs.{module}")
    return words(program.COMMANDS) if hasattr(program, "COMMANDS") else []


def reference() -> str:
    """The page of all commands, as Markdown."""
    lines = [
        "# Every command", "",
        "Generated from the code: what `--help-all` prints. Every program also takes `--version`, "
        "`--debug` (shows the traceback of an error), `--install-completion`, and "
        "`--read-limit N`, which reads files up to N times as large, long and wide as is usual "
        "(1 to 1000). Exit codes: 0, 2 for bad input (one sentence says what and where), 130 after "
        "Ctrl-C, 143 after SIGTERM, 129 after SIGHUP, 1 for anything else.", "",
    ]  # fmt: skip
    for module in _PROGRAMS:
        program = module.replace("_", "-")
        lines += [f"## {program}", "", "```text", help_text(module), "```", ""]
        for name in subcommands(module):
            shown = help_text(module, *name.split())
            lines += [f"### {program} {name}", "", "```text", shown, "```", ""]
    return "\n".join(lines)


_GROUPS = {
    "Read": ("load", "Recording"),
    "Measure": ("doctor", "delay", "bode", "backlash"),
    "Fit": ("calibrate", "fit_servo", "sindy", "compare"),
    "Use": ("report", "export", "load_calibration", "Calibration", "load_servo_model"),
    "Simulate": (
        "DelayedPD", "DelayedPDParameters", "HeldFeedback", "SparseEquation", "PupperEnv",
        "make_env", "load_policy", "Policy",
    ),
    "Values and errors": ("Interval", "JOINT_NAMES", "InputError", "PupperError"),
}  # fmt: skip
_EXAMPLES = """

A recording from a file, its lag, a calibration, and actuators for a simulator::

    import pupper_sysid as ps

    recording = ps.load("data/samples/sweep.csv")
    lag = ps.delay(recording, "LF_hip")
    print(lag)                                # one line a joint
    lag["LF_hip"].dead_time_s                 # Interval(value, low … high), in seconds
    lag.to_frame()                            # a table; to_dict() is the command's --json

    calibration = ps.calibrate(recording, "LF_hip")
    calibration.save("calibrated.yaml")
    ps.export(calibration, "mjlab", "exported")

Arrays in memory become a recording, too::

    recording = ps.Recording.from_arrays(time_s, {"knee": command_rad}, {"knee": position_rad})

A servo in your own loop::

    servo = ps.load_calibration("calibrated.yaml").delayed_pd(["LF_hip"])
    servo.reset([0.0])
    position_rad = servo.step([0.1])          # 2 ms later
"""


def write_api_pages() -> None:
    """The page of the public names, and one of internals per folder of the package."""
    project = tomllib.loads((HERE.parent / "pyproject.toml").read_text())
    shutil.rmtree(REFERENCE, ignore_errors=True)
    REFERENCE.mkdir()
    pages = []
    for package in project["tool"]["setuptools"]["packages"]:
        if package == "pupper_sysid":
            continue
        folder = HERE.parent / package.removeprefix("pupper_sysid.").replace(".", "/")
        modules = sorted(path.stem for path in folder.glob("*.py") if path.stem != "__init__")
        for name in modules:  # before autodoc changes annotations that pydantic reads
            import_module(f"{package}.{name}")
        if modules:
            title = package.removeprefix("pupper_sysid.")
            (REFERENCE / f"{title}.rst").write_text(_api_page(package, modules))
            pages.append(title)
    (REFERENCE / "index.rst").write_text(_front_door())
    lines = [
        ":nosearch:", "", *_titled("Internals, by folder", "="),
        "Every module of the package, for those who change it. Programs that use it need "
        ":doc:`index` alone.", "", ".. toctree::", "   :maxdepth: 1", "",
        *(f"   {page}" for page in pages), "",
    ]  # fmt: skip
    (REFERENCE / "internals.rst").write_text("\n".join(lines))


def _titled(text: str, line: str) -> list[str]:
    return [text, line * len(text), ""]


def _api_page(package: str, modules: list[str]) -> str:
    """All modules of one folder; no page of the search."""
    summary = (import_module(package).__doc__ or "").strip()
    lines = [":nosearch:", "", *_titled(f"``{package}``", "="), summary, ""]
    for name in modules:
        lines += [
            *_titled(f"``{name}``", "-"),
            f".. automodule:: {package}.{name}", "   :members:", "",
        ]  # fmt: skip
    return "\n".join(lines)


def _front_door() -> str:
    """The page of the names of `pupper_sysid`."""
    front = import_module("pupper_sysid")
    assert sorted(name for names in _GROUPS.values() for name in names) == sorted(front.__all__)
    lines = [*_titled("Python: the public names", "=")]
    lines += [
        "``import pupper_sysid as ps`` has these names. Functions have the names of the commands; "
        "``examine``, ``lag``, ``frequency_response`` and ``sparse_equations`` are older names of "
        "``doctor``, ``delay``, ``bode`` and ``sindy``. Results are frozen dataclasses with units "
        "in their field names, ``to_dict()``, ``to_frame()`` and ``plot()``." + _EXAMPLES
    ]
    for title, names in _GROUPS.items():
        listed = ", ".join(f":py:obj:`~pupper_sysid.{name}`" for name in names)
        lines += [*_titled(title, "-"), listed, ""]
        for name in names:
            item = getattr(front, name)
            kind = "class" if isinstance(item, type) else "function" if callable(item) else "data"
            kind = "exception" if kind == "class" and issubclass(item, Exception) else kind
            lines += [f".. auto{kind}:: pupper_sysid.{name}"]
            lines += ["   :members:"] * (kind == "class") + [""]
    return "\n".join(lines)


class _Names(PythonDomain):
    """Python names, of which the search shows those of `pupper_sysid` itself."""

    def get_objects(self):
        for name, shown, kind, page, anchor, priority in super().get_objects():
            inside = page.startswith("reference/") and page != "reference/index"
            yield name, shown, kind, page, anchor, -1 if inside else priority


def _short_signature(app, what, name, item, options, signature, returns):
    """Without the fields of a file's classes, which their documentation lists."""
    return ("", None) if what == "class" and hasattr(item, "model_fields") else None


def _as_rst(app, what, name, item, options, lines: list[str]) -> None:
    """Docstrings are plain text for reStructuredText: stars and bars, indented code of modules."""
    code = False
    for i, line in enumerate(list(lines)):
        indented = line.startswith("    ")
        code = indented if line.strip() else code
        if what == "module" and code:
            continue
        if not line.lstrip().startswith((">>>", "...", "..", "|", "*")):
            parts = re.split(r"(`[^`]*`)", line)
            parts[::2] = [re.sub(r"(?<!\\)([*|])(?=\S)", r"\\\1", part) for part in parts[::2]]
            lines[i] = "".join(parts)
    if what == "module":
        text = re.sub(r"(?<=[^:\n])\n\n(?=    \S)", "\n\n::\n\n", "\n".join(lines))
        lines[:] = text.split("\n")


def _skip_aliases(app, what, name, item, skip, options) -> bool | None:
    """Names of types have no docstring of their own."""
    return True if isinstance(item, GenericAlias) or get_args(item) else None


def _link_whole_names(app, doctree) -> None:
    """Types in signatures are whole names, so that none has to be looked for in every room."""
    for reference in doctree.findall(pending_xref):
        reference.attributes.pop("refspecific", None)


class _CompiledOnce(SandboxedEnvironment):
    """Keeps the templates; numpydoc compiles its only one anew for every docstring."""

    kept: ClassVar[dict[str, Template]] = {}

    def get_template(self, name, *more, **named) -> Template:
        """The template of that name."""
        if name not in self.kept:
            self.kept[name] = super().get_template(name, *more, **named)
        return self.kept[name]


def setup(app) -> None:
    """Write the generated pages before any page is read."""
    (HERE / "commands.md").write_text(reference())
    write_api_pages()
    shutil.rmtree(GALLERY, ignore_errors=True)
    GALLERY.mkdir()
    for script in sorted((HERE.parent / "examples").glob("*.py")):
        page = import_module("notebook").page(script, GALLERY / "figures")
        (GALLERY / f"{script.stem}.md").write_text(page)
    app.add_domain(_Names, override=True)
    app.connect("autodoc-process-docstring", _as_rst, priority=100)  # before numpydoc
    app.connect("autodoc-process-signature", _short_signature)
    app.connect("autodoc-skip-member", _skip_aliases)
    app.connect("doctree-read", _link_whole_names)
    docscrape_sphinx.SandboxedEnvironment = _CompiledOnce
