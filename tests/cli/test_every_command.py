"""What every command has in common: a quick start, help of one screen, output, messages, keys."""

import ast
import importlib
import io
import json
import re
import shlex
from contextvars import copy_context
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Annotated, Literal

import pytest
import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.cli.help_page import SCREEN_LINES
from pupper_sysid.cli.program import overview, parse, words
from pupper_sysid.cli.programs import pupper_analyze, pupper_sysid
from pupper_sysid.cli.terminal import remember, spell
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import select_joints
from pupper_sysid.data import SAMPLES
from support.command_line import fresh_python, json_of, ran, refused
from support.json_keys import DOCUMENTED, key_line
from support.package import FOLDERS, ROOT

PROGRAMS = (
    "pupper_sysid", "pupper_train", "pupper_play", "pupper_eval", "pupper_deploy", "pupper_analyze",
)  # fmt: skip
SLOW = ("torch", "rsl_rl", "matplotlib", "pandas", "scipy", "control", "mujoco", "numba", "sklearn")


def imported(code: str) -> set[str]:
    """Slow libraries that a fresh interpreter has imported after `code`."""
    printed = fresh_python(f"import sys\n{code}\nprint('AFTER', *sys.modules)")
    return set(SLOW) & set(printed.rpartition("AFTER ")[2].split())


def test_help_and_version_of_every_command_import_no_slow_library():
    commands = {
        "pupper_sysid": words(pupper_sysid.COMMANDS),
        "pupper_analyze": words(pupper_analyze.COMMANDS),
    }
    code = f"""
from contextlib import suppress
from importlib import import_module
commands = {commands!r}
for program in {PROGRAMS!r}:
    main = import_module("pupper_sysid.cli.programs." + program).main
    for words in ("", *commands.get(program, ())):
        for option in ("--help", "--version"):
            with suppress(SystemExit):
                main([*words.split(), option])
"""
    assert imported(code) == set()


def test_every_program_prints_its_version(capsys):
    for name in PROGRAMS:
        out = shown(capsys, (name,), "--version")
        assert out.startswith(f"{name.replace('_', '-')} {version('pupper-sysid')} (numpy ")


@pytest.mark.parametrize("program", [pupper_sysid, pupper_analyze])
def test_the_overview_fits_a_screen_of_24_times_80(program):
    lines = overview("pupper-analyze", program.DESCRIPTION, program.COMMANDS).splitlines()
    assert len(lines) < 24 and max(map(len, lines)) <= 80
    assert all(any(f" {word} " in line for line in lines) for word in program.COMMANDS)


# ----- help of every command: one screen, options by their types, everything behind `--help-all`

COMMANDS = [
    *(("pupper_sysid", *each.split()) for each in words(pupper_sysid.COMMANDS)),
    *(("pupper_analyze", each) for each in words(pupper_analyze.COMMANDS)),
    *((name,) for name in ("pupper_train", "pupper_play", "pupper_eval", "pupper_deploy")),
]


@pytest.fixture(autouse=True)
def of_80_columns(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")


def shown(capsys, command, option: str) -> str:
    module = importlib.import_module(f"pupper_sysid.cli.programs.{command[0]}")
    out, _ = ran(capsys, *command[1:], option, program=module)
    return out


def options(page: str) -> set[str]:
    return set(re.findall(r"^  (?:-h, )?(--[a-z][\w.-]*)", page, re.MULTILINE))


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_help_is_one_screen_and_leaves_out_only_groups_and_later_sentences(command, capsys):
    page, everything = shown(capsys, command, "--help"), shown(capsys, command, "--help-all")
    assert len(page.splitlines()) <= SCREEN_LINES
    assert max(map(len, page.splitlines())) <= 80
    called = " ".join(command).replace("_", "-")
    if command[-1] not in ("emulate", "servo", "pupper_train"):
        assert f"Example: {called} " in " ".join(page.split())
    assert not re.search(r"None|%%|TYRO|\[\[|default: \)", page)
    left_out = options(everything) - options(page)
    assert all("." in name for name in left_out)
    if page != everything:
        assert f"{called} --help-all" in " ".join(page.split())
    for group in {name.split(".")[0] for name in left_out}:
        assert f"{group}.*" in page


def test_all_settings_of_a_training_are_behind_help_all(capsys):
    everything = options(shown(capsys, ("pupper_train",), "--help-all"))
    assert {"--task.rewards.progress", "--learner.learning-rate", "--actuator"} <= everything
    assert len(everything) > 150


@dataclass
class Optional:
    """Options that have no value by default, or one."""

    amplitude: float | None = 0.3
    kind: Literal["sine", "chirp"] | None = None


def test_an_optional_value_is_read_as_its_type_or_as_none():
    assert parse(Optional, [], "x") == Optional(0.3, None)
    read = parse(Optional, ["--amplitude", "None", "--kind", "chirp"], "x")
    assert read == Optional(None, "chirp")
    with pytest.raises(SystemExit):
        parse(Optional, ["--amplitude", "4_1"], "x")
    with pytest.raises(InputError, match="--kind is 'square'. It may be sine, chirp"):
        parse(Optional, ["--kind", "square"], "x")


def test_what_was_typed_is_never_proposed():
    """A kind, a leg or a joint of the robot that a recording does not have."""
    for word in ("thigh", "RB", "RB_calf"):
        with pytest.raises(InputError) as refused:
            select_joints(word, ["LF_hip"])
        assert "Did you mean" not in str(refused.value)
        assert f"there is no {word} here; there is LF_hip" in str(refused.value)
    with pytest.raises(InputError, match=r"Did you mean LF_hip\?"):
        select_joints("LF_hop", ["LF_hip"])


# ----- progress of long commands: it ends, and is written as lines where there is no terminal


@pytest.fixture
def lines(monkeypatch):
    """What goes to stderr, and a clock that a test sets."""
    text, clock = io.StringIO(), [100.0]
    monkeypatch.setattr(terminal.err, "_file", text)  # its property would keep the old one
    monkeypatch.setattr(terminal.time, "monotonic", lambda: clock[0])
    return text, clock


def test_without_a_terminal_there_is_a_line_each_ten_seconds(lines):
    text, clock = lines
    with terminal.progress("calibrating", 4) as advance:
        for name in ("a", "b", "c", "d"):
            clock[0] += 6.0
            advance(name)
    assert text.getvalue().splitlines() == [
        "calibrating b: 50 %, 12 s", "calibrating d: 100 %, 24 s",
    ]  # fmt: skip


# ----- text from files reaches the terminal without its control characters

ESCAPES = ["\x1b[31m", "\x1b]0;title\x07", "\x9b2J", "\u202e", "\r"]


@pytest.mark.parametrize("escape", ESCAPES)
def test_tables_warnings_and_json_have_no_control_characters(capsys, escape):
    shown = terminal.table(f"of {escape}", f"joint{escape}")
    shown.add_row(f"a{escape}b")
    terminal.out.print(shown)
    terminal.out.print(f"x{escape}y")
    terminal.warn(f"odd {escape}")
    terminal.print_json({"name": f"k{escape}"})
    printed = capsys.readouterr()
    assert escape[0] not in printed.out + printed.err
    assert json.loads(printed.out[printed.out.index("{") :])["name"] == f"k{escape}"


def test_a_hostile_cell_is_quoted_without_its_escape(capsys, tmp_path):
    path = tmp_path / "hostile.csv"
    path.write_text("send_time_s,read_time_s,trial,joint,frequency_hz,command_rad,position_rad\n")
    with path.open("a") as file:
        file.write("0,0,0,a,1,\x1b[2Jhello,0\n" * 30)
    assert "\x1b" not in refused(capsys, pupper_sysid, "doctor", path)


@pytest.mark.parametrize("on_terminal", [True, False])
def test_sentences_are_broken_between_words_on_a_terminal_and_commands_are_not(on_terminal):
    sentence = "error: results/a.csv does not exist. Check the name."
    command = "Next: pupper-sysid calibrate a.csv b.csv c.csv"
    file = io.StringIO()
    console = type(terminal.out)(file=file, force_terminal=on_terminal, width=20)
    console.print(sentence)
    console.print(command)
    lines = file.getvalue().splitlines()
    assert lines[-1] == command
    assert " ".join(line.strip() for line in lines[:-1]) == sentence
    assert (len(lines) > 2) is on_terminal


def test_a_command_to_run_next_can_be_copied(capsys, tmp_path):
    recording = tmp_path / "my log.csv"
    _, err = ran(capsys, "import", SAMPLES / "sweep.csv", "--out", recording)
    assert shlex.split(err.split("Next: ")[1]) == ["pupper-sysid", "doctor", str(recording)]


# ----- messages of the library name arguments; at the command line they name its options


@dataclass
class Learner:
    """A group of options."""

    learning_rate: float = 1.0


@dataclass
class Run:
    """Options without a prefix of their own."""

    learner: Learner = field(default_factory=Learner)


@dataclass
class Options:
    """A command's."""

    recordings: tyro.conf.Positional[tuple[str, ...]] = ()
    run: Annotated[Run, tyro.conf.arg(name="")] = field(default_factory=Run)
    stall_torque: float = 1.0
    preset: str = ""
    force: bool = False
    jobs: int = 1


def spelled(text):
    def there():
        remember(Options())
        return spell(text)

    return copy_context().run(there)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("`stall_torque` is 0.", "--stall-torque is 0."),
        ("`stall_torque_nm` is 0.", "--stall-torque is 0."),
        ("`workers` is 0.", "--jobs is 0."),
        ("Add `force=True`.", "Add --force."),
        ("`preset='paper'` has an mlp.", "--preset paper has an mlp."),
        ("Lower `learning_rate`.", "Lower --learner.learning-rate."),
        ("`recordings` is empty, `position_rad`, `walk.csv`, `pupper-sysid doctor`", None),
        ("preset and force are words", None),
    ],
)
def test_arguments_become_the_options_of_the_running_command(text, expected):
    assert spelled(text) == (expected or text)
    assert spell(text) == text, "without a command it stays as the library wrote it"


OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]+")


def options_in_strings(path):
    """Options in the strings of a module, but for docstrings and those with a line to type."""
    tree = ast.parse(path.read_text())
    others = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    texts = []
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts = [part for part in node.values if isinstance(part, ast.Constant)]
            others |= {id(part) for part in parts}
            texts.append("{}".join(part.value for part in parts))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            texts += [node.value] * (id(node) not in others)
    for text in texts:
        if not re.search(r"pupper-|pip install", text):
            yield from OPTION.findall(text)


def test_no_message_of_the_library_names_an_option(tmp_path):
    library = (ROOT / room for room in FOLDERS.values() if room != "cli")
    found = {
        path.relative_to(ROOT).as_posix(): options
        for folder in library
        for path in folder.rglob("*.py")
        if OPTION.search(path.read_text()) and (options := list(options_in_strings(path)))
    }
    assert found == {}
    would = tmp_path / "module.py"
    would.write_text('"""A --doc."""\nraise ValueError(f"--jobs is {jobs}; `--out x` is not")\n')
    assert list(options_in_strings(would)) == ["--jobs", "--out"]


# ----- the keys of JSON objects are those of docs/formats.md

SAMPLE = SAMPLES / "sweep.csv"
HIP = object()  # the fixture of that name
WITH_JSON = {
    "sweep": ("--freqs", "4", "--joints", "LF_hip"),
    "plan": (SAMPLE.with_name("calibrated.yaml"), "--joints", "LF_hip"),
    "import": (HIP,),
    "export": ("paper", "--to", "csv"),
    "compare": (HIP, "--models", "paper"),
}


@pytest.mark.usefixtures("unexamined")
def test_keys_of_an_object_are_the_documented_ones(capsys, hip, here):
    for command, given in WITH_JSON.items():
        typed = [hip if word is HIP else word for word in given]
        found = json_of(capsys, command, *typed)
        assert key_line(found) == DOCUMENTED[command], command
