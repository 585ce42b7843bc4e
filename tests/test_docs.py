"""The documentation holds: its examples run, its pages build, what it refers to exists."""

import html
import importlib
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

import pupper_sysid
from support import docs_conf, docs_outputs, golden
from support.command_line import run_program
from support.package import MODULES, ROOMS, ROOT, public_names
from support.undrawn import leave_undrawn

DOCS = ROOT / "docs"
WRITTEN = [  # pages written by hand
    path
    for path in (ROOT / "README.md", *sorted(DOCS.rglob("*.md")))
    if path.name != "commands.md" and not {"_build", "gallery"} & set(path.parts)
]
SOURCES = [
    path
    for folder in ("api", *ROOMS, "reproduction", "tests", "benchmarks", "docs", "examples")
    for path in sorted((ROOT / folder).rglob("*.py"))
]


def console(page: Path) -> list[str]:
    """Lines of a page's console blocks."""
    blocks = re.findall(r"```console\n(.*?)```", page.read_text(), re.DOTALL)
    return [line for block in blocks for line in block.splitlines()]


EXAMPLES = {
    page: [shlex.split(line[2:]) for line in console(page) if line.startswith("$ ")]
    for page in WRITTEN
    if console(page)
}


@pytest.mark.usefixtures("fitted_once")
@pytest.mark.parametrize(
    "page",
    [p if p.stem == "tutorial" else pytest.param(p, marks=pytest.mark.slow) for p in EXAMPLES],
    ids=lambda p: p.stem,
)
def test_every_example_of_a_page_runs_in_an_empty_folder(page, here, monkeypatch, capsys):
    if page.stem == "tutorial":  # what its network predicts is not on the page
        networks = importlib.import_module("pupper_sysid.sysid.servo_fit.networks")
        monkeypatch.setattr(networks, "MLP", replace(networks.MLP, steps=100, check_every=50))
        leave_undrawn(monkeypatch)
    printed = {}
    for words in EXAMPLES[page]:
        module = importlib.import_module(f"pupper_sysid.cli.programs.{words[0].replace('-', '_')}")
        code, out, err = run_program(capsys, module, *words[1:])
        assert code == 0, f"{shlex.join(words)}: {err}"
        printed[shlex.join(words)] = out
    for found in docs_outputs.BLOCK.finditer(page.read_text()):
        (line,) = found["commands"].splitlines()
        difference = docs_outputs.differs(
            found["output"], printed[shlex.join(shlex.split(line[2:]))]
        )
        assert not difference, (
            f"{page}, {line}: {difference}\nMend it: python docs/outputs.py {page}"
        )
    if page.stem == "tutorial":
        made = ("calibrated.yaml", "report/report.html", "calibrated_isaaclab.py", "servo")
        assert all((here / name).exists() for name in made)


def test_the_tutorial_leads_from_a_sweep_to_a_servo_model_and_is_run_as_it_stands():
    steps = [words[1] for words in EXAMPLES[DOCS / "tutorial.md"]]
    order = [
        "sweep", "doctor", "delay", "calibrate", "compare-truth", "compare", "report", "export",
        "fit-servo",
    ]  # fmt: skip
    assert list(dict.fromkeys(steps)) == order
    for page in EXAMPLES:
        unrun = [line for line in console(page) if "pupper-" in line and line[:2] != "$ "]
        assert unrun == [], page


def python_blocks(page: Path) -> list[str]:
    """A page's examples in Python."""
    return re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)


def execute(page: Path) -> None:
    """A page's examples in turn, in one name space."""
    names: dict[str, object] = {}
    for block in python_blocks(page):
        exec(compile(block, str(page), "exec"), names)


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in WRITTEN if python_blocks(p)], ids=lambda p: p.stem)
def test_python_examples_of_a_page_run_in_the_repository(page, here):
    (here / "data").symlink_to(ROOT / "data")
    execute(page)


@pytest.mark.usefixtures("fitted_once")
def test_the_readmes_example_runs_on_a_part_of_its_sample(hip, here):
    (here / "data/samples").mkdir(parents=True)
    shutil.copy(hip, here / "data/samples/sweep.csv")
    execute(ROOT / "README.md")
    assert (here / "calibrated.yaml").exists()


def test_the_readme_is_short_and_its_lag_table_is_that_of_the_frozen_figures():
    readme = (ROOT / "README.md").read_text()
    assert len(readme.split()) <= 1000
    figures = golden.read()
    for joint in ("LF_hip", "LF_thigh"):
        frozen = figures[f"mini_pupper_{joint[3:]}"]
        lag, dead_time = frozen["lag"][joint], frozen["calibrate"][joint]["dead_time_ms"]
        (row,) = re.findall(rf"^{joint} .*$", readme, re.MULTILINE)
        raw, stale, hold, servo, low, high, *dead = map(float, re.findall(r"\d+\.\d", row))
        frozen_servo = lag["lag_ms"]
        assert [raw, servo, low, high] == pytest.approx(
            [lag["raw_lag_ms"]["value"], *(frozen_servo[k] for k in ("value", "low", "high"))],
            abs=0.06,
        )
        assert dead == pytest.approx([dead_time[k] for k in ("value", "low", "high")], abs=0.06)
        assert raw == pytest.approx(stale + hold + servo, abs=0.15)


def test_outputs_of_other_processors_are_the_same_and_others_are_not():
    shown = "lag  80.1 ms, use\nRecorded 4 trials in 0.3 s."
    assert not docs_outputs.differs(shown, "lag 80.3 ms, use\nRecorded 4 trials in 12 s.\n")
    assert docs_outputs.differs(shown, "lag 99.1 ms, use\nRecorded 4 trials in 0.3 s.")
    assert docs_outputs.differs(shown, "lag 80.1 ms, do not use\nRecorded 4 trials in 0.3 s.")
    assert len(list(docs_outputs.BLOCK.finditer((DOCS / "tutorial.md").read_text()))) >= 6


def test_the_page_of_public_names_has_them_all():
    page = docs_conf.front_door()
    assert all(f"pupper_sysid.{name}`" in page for name in pupper_sysid.__all__)


@pytest.mark.slow
def test_the_built_pages_have_every_command_and_public_name_and_need_no_network(tmp_path):
    # one test: the gallery is written into the sources, by one build at a time
    pytest.importorskip("sphinx")
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", DOCS, tmp_path],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-4000:]

    commands = (tmp_path / "commands.html").read_text()
    for program in ("pupper-sysid", "pupper-train", "pupper-analyze"):
        for name in docs_conf.subcommands(program.replace("-", "_")):
            assert f">{program} {name}<" in commands

    anchors: set[str] = set()
    for page in (tmp_path / "reference").glob("*.html"):
        anchors |= set(re.findall(r'id="(?:module-)?([^"]+)"', page.read_text()))
    wanted = {name for module in MODULES for name in public_names(module)}
    assert sorted(name for name in wanted if name not in anchors) == []

    tag = re.compile(r'<(?:script|link|img|iframe)\b[^>]*?(?:src|href)="(?:https?:)?//([^"]+)"')
    for page in tmp_path.rglob("*.html"):
        assert tag.findall(page.read_text()) == [], page
    theory = (tmp_path / "theory/lag.html").read_text()
    formulas = re.findall(r"<math\b.*?</math>", theory, re.DOTALL)
    assert len(formulas) > 5  # as MathML
    assert not any("\\" in html.unescape(re.sub("<[^>]+>", "", f)) for f in formulas)


def test_a_commands_own_commands_are_on_the_page_of_all_commands():
    known = docs_conf.subcommands("pupper_sysid")
    assert {"emulate", "emulate esp32", "emulate feetech", "sweep"} <= set(known)
    assert docs_conf.subcommands("pupper_play") == []


def command_lines() -> Iterator[tuple[Path, str]]:
    """Lines of the pages that begin with a command, those that are not run here, too."""
    for page in WRITTEN:
        for line in re.findall(r"^(?:\$ )?(pupper-[a-z]+ .*)$", page.read_text(), re.MULTILINE):
            yield page, line


def test_pages_name_commands_and_options_that_exist():
    """Also those that need a robot, and so cannot be run here."""
    for page, line in command_lines():
        program, *words = shlex.split(line, comments=True)
        module = program.replace("-", "_")
        known = docs_conf.subcommands(module)
        command: list[str] = []
        while known and words and not words[0].startswith("-"):
            if " ".join([*command, words[0]]) not in known:
                break
            command.append(words.pop(0))
        assert command or not known or words[0].startswith("-"), f"{page.name}: {line}"
        shown = (
            docs_conf.help_text(module, *command)
            + " --version --install-completion --debug --read-limit"
        )
        for word in words:
            if word.startswith("--"):
                option = word.split("=")[0]
                assert re.search(rf"{option}(?![\w-])", shown), f"{page.name}: {line}: {option}"

    shown = docs_conf.help_text("pupper_sysid", "sweep")
    assert "--amplitude" in shown and "--no-such-option" not in shown


# ----- references

WRITTEN_BY_USERS = {  # `/runs/` and the like, which following the README makes
    line.strip("/") for line in (ROOT / ".gitignore").read_text().split() if line[0] == "/"
}
FOLDERS = {path.name for path in ROOT.iterdir() if path.is_dir() and path.name[0] != "."}
FOLDERS -= WRITTEN_BY_USERS
PATH = re.compile(r"`([\w.-]+/[\w./*<>-]*)`")
DOTTED = re.compile(rf"`(?:pupper_sysid\.)?((?:{'|'.join(ROOMS)})(?:\.\w+)+)(?:\(\))?`")


def dangling(text: str, folder: Path) -> list[str]:
    """Paths and modules in back quotes that are not in the repository."""
    found = []
    for name in PATH.findall(text):
        here = name.split("/")[0] in FOLDERS
        if here and not any(ROOT.glob(name)) and not any(folder.glob(name)):
            found.append(name)
    for name in DOTTED.findall(text):
        path, rest = ROOT, name.split(".")
        while rest and (path / rest[0]).is_dir():
            path, rest = path / rest[0], rest[1:]
        module = path / f"{rest[0]}.py" if rest else path / "__init__.py"
        inside = module.exists() and all(
            re.search(rf"\b{name}\b", module.read_text()) for name in rest[1:]
        )
        if not inside and name.split(".")[-1] not in ("py", "md", "csv", "yaml"):
            found.append(name)
    return found


def test_what_is_not_in_the_repository_would_be_found():
    there = "`common/errors.py`, `common.errors.InputError`, `runs/NAME`, `report/report.html`"
    assert dangling(there, ROOT) == []
    gone = ["common/gone.py", "common.gone", "common.errors.gone"]
    assert dangling(" ".join(f"`{name}`" for name in gone), ROOT) == gone


def test_pages_and_docstrings_refer_to_files_that_are_in_the_repository():
    others = [*(ROOT / "benchmarks").rglob("*.md"), ROOT / "data/samples/README.md"]
    missing = {
        str(path.relative_to(ROOT)): names
        for path in (*WRITTEN, *others, *SOURCES)
        if path != Path(__file__) and (names := dangling(path.read_text(), path.parent))
    }
    assert missing == {}


def test_links_and_pictures_of_the_readme_exist():
    for target in re.findall(r"\]\(([^)#]+)\)", (ROOT / "README.md").read_text()):
        assert target.startswith("https://") or (ROOT / target).exists(), target


# ----- benchmarks

BENCHMARKS = sorted((ROOT / "benchmarks").rglob("*.py"))
ELSEWHERE = re.compile(r"^(from|import) (bam|mjlab|newton|warp|cmaes|isaaclab|exchange)\b", re.M)


@pytest.mark.slow
def test_benchmarks_import(monkeypatch):
    """Programs that run in the environments of other projects are compiled only."""
    for path in BENCHMARKS:
        source = path.read_text()
        compile(source, str(path), "exec")
        if (
            path.parent.name == "peers"
            and ELSEWHERE.search(source)
            and "pupper_sysid" not in source
        ):
            continue
        with monkeypatch.context() as patched:
            for folder in (ROOT / "benchmarks", path.parent):
                patched.syspath_prepend(str(folder))
            runpy.run_path(str(path), run_name=path.stem)
