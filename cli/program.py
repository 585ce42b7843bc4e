"""What every program does: parse its words, run, and end with 0, 2 for bad input or 1 otherwise.

`run_program` parses the options of a program without subcommands and runs it. A program with them
has a table of `Command`s, by word: `run_command` imports only the module of the one that the first
argument names; without one it prints the table, grouped.

Ctrl-C, SIGTERM and SIGHUP end a program at once with one line, "Stopped.", and 130, 143 or 129 (see
`common.processes.stop`); its worker processes end with it. Programs that hold a robot call
`end_politely`, and park it first. An error is one sentence; `--debug` shows the traceback. The
options that every program has are here: `--debug`, `--read-limit`, `--version` and
`--install-completion`.
"""

from __future__ import annotations

import difflib
import errno
import functools
import io
import operator
import os
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, suppress
from dataclasses import fields, replace
from importlib import import_module
from pathlib import Path
from traceback import walk_tb
from types import NoneType
from typing import Annotated, Any, NamedTuple, NoReturn, TypeVar, get_args

import tyro
from rich.text import Text
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from pupper_sysid.cli.help_page import ALL, HELP, correction, help_page
from pupper_sysid.cli.terminal import err, forget, out, remember, spell
from pupper_sysid.common.errors import InputError, PupperError
from pupper_sysid.common.files import holding_outputs, versions
from pupper_sysid.common.processes.stop import STOPPED, Stop, end_politely, stoppable
from pupper_sysid.common.reading.content import reading_up_to
from pupper_sysid.common.reading.dialect import decimal, whole_number

_COMPLETIONS = {"bash": ".local/share/bash-completion/completions/{}", "zsh": ".zfunc/_{}"}
_READ_LIMIT = "--read-limit"
LARGEST_SEED = 2**63 - 1
"""The largest that every generator takes: torch's are seeded with 64 bits."""
CONFIG = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff)

_MAKE_ROOM = "Make room, or choose another file or folder."
_CURES = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), "Make room there."),
    errno.EROFS: "Make it writable.",
    **dict.fromkeys((errno.EACCES, errno.EPERM), "Give this user the permission."),
    errno.EMFILE: "Raise the limit of open files (`ulimit -n`).",
    errno.ENFILE: "Close other programs.",
    errno.ENOMEM: "Free memory.",
    **dict.fromkeys((errno.ENAMETOOLONG, errno.EISDIR, errno.ENOTDIR), _MAKE_ROOM),
}
"""Refusals of the system that are the user's to mend, and what helps where it names no file."""
_SHARED, _POOLS = "multiprocessing.synchronize", ("concurrent.futures", "multiprocessing.pool")
_OUTPUT, _ERRORS = "standard output", "standard error"

NUMERALS = ConstructorRegistry()
"""Rules for `tyro.cli`: numbers as in files, optional values by their type alone. Its own rules
take `4_1` for 41 and the digits of every script, and show an optional value as `{None}|STR`."""

_READERS: dict[Any, Callable[[str], float]] = {int: whole_number, float: decimal}

Options = TypeVar("Options")


def run_program(
    options: type[Options],
    work: Callable[[Options], None],
    program: str,
    description: str,
    arguments: Sequence[str] | None = None,
) -> None:
    """Parse a program's arguments into `options` and run `work`.

    Ends the process with 0, 2 (bad input, one sentence) or 1.
    """
    words_typed = list(sys.argv[1:] if arguments is None else arguments)
    with user_errors(words_typed, program) as rest:
        parsed = parse(options, rest, program, description)
        begin_work()
        work(parsed)


def parse(
    options: Any, arguments: Sequence[str], program: str, description: str | None = None,
    **keywords: Any,
) -> Any:  # fmt: skip
    """Parse `arguments` into the dataclass `options` (or a union of some), within `user_errors`.

    `keywords` are further ones of `tyro.cli`.
    """
    settings = {"config": CONFIG, "description": description, "registry": NUMERALS} | keywords
    known = {key: value for key, value in settings.items() if key != "description"}
    if {*HELP, ALL} & {*arguments}:
        print(help_page(options, arguments, program, settings["description"], **known))
        sys.exit(0)
    refusal = io.StringIO()
    try:
        with redirect_stderr(refusal):
            parsed = tyro.cli(options, args=arguments, prog=program, **settings)
    except SystemExit:
        text = refusal.getvalue()
        if text and (hint := correction(options, arguments, program, text, **known)):
            raise InputError(hint) from None
        sys.stderr.write(text)
        raise
    remember(parsed)
    seed = getattr(parsed, "seed", 0)
    if not 0 <= seed <= LARGEST_SEED:
        raise InputError(
            f"--seed is {str(seed)[:24]}; it must be a whole number from 0 on, at most "
            f"{LARGEST_SEED}."
        )
    for field in fields(parsed):
        if getattr(parsed, field.name) == "" != field.default:
            raise InputError(f"`{field.name}` is empty. Write a value, or leave it out.")
    return parsed


def begin_work() -> None:
    """Have a stop unwind from now on; before, nothing has to be undone."""
    with stoppable() as stop:
        stop.phase = "work"


@contextmanager
def user_errors(arguments: Sequence[str], program: str) -> Iterator[list[str]]:
    """Yield the arguments without those of every program; an exception becomes a sentence."""
    with stoppable() as stop:
        try:
            with _sentences(arguments, program, stop) as rest:
                yield rest
            if stop.number:  # all work was done before the signal took effect
                _stopped(stop)
        finally:
            stop.phase = "start" if stop.ends_process else "work"
            forget()


@contextmanager
def _sentences(arguments: Sequence[str], program: str, stop: Stop) -> Iterator[list[str]]:
    debug = "--debug" in arguments
    # a stream that was closed before leads to /dev/null, or the next file would take its number
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))
    streams = sys.stdout, sys.stderr
    output: Any = _Stream(sys.stdout, _OUTPUT)
    errors: Any = _Stream(sys.stderr, _ERRORS)
    sys.stdout, sys.stderr = output, errors
    try:
        try:
            if "--version" in arguments:
                tool, *rest = versions().items()
                out.print(f"{program} {tool[1]} ({', '.join(f'{k} {v}' for k, v in rest)})")
                sys.exit(0)
            if "--install-completion" in arguments:
                arguments = _completion(program)
            times, rest = _read_limit([a for a in arguments if a != "--debug"])
            with reading_up_to(times), holding_outputs():
                yield rest
        finally:  # also what help printed, which ends the program by itself
            sys.stdout.flush()
    except KeyboardInterrupt:
        _stopped(stop)
    except PupperError as error:
        if debug:
            raise
        _print_error(spell(str(error)))
        sys.exit(error.exit_code)
    except Exception as error:
        stream = error.filename if isinstance(error, OSError) else None
        if stream in (_OUTPUT, _ERRORS):  # flushing its buffer at the exit would fail again
            _silence(sys.stdout if stream == _OUTPUT else sys.stderr)
        if stop.number and (stop.phase != "robot" or _is_interrupt(error)):
            _stopped(stop)
        if stream in (_OUTPUT, _ERRORS) and isinstance(error, BrokenPipeError):
            sys.exit(0)  # `| head` closed its end: no error
        if debug:
            raise
        if isinstance(error, OSError) and error.errno in _CURES:
            _print_error(_of_the_system(error))
            sys.exit(InputError.exit_code)
        _print_error(
            f"{type(error).__name__}: {error}. This is a defect of {program}; run again with "
            "--debug and report what it prints."
        )
        sys.exit(1)
    finally:
        sys.stdout, sys.stderr = streams


def _is_interrupt(error: BaseException | None) -> bool:
    """Whether an error is a KeyboardInterrupt, as a library passed it on: pydantic in its words."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt) or "KeyboardInterrupt" in str(error):
            return True
        error = error.__cause__ or error.__context__
    return False


def _stopped(stop: Stop) -> NoReturn:
    """Say that the program was stopped, and end it."""
    if stop.ends_process and stop.number:
        stop.end()
    err.print(STOPPED)
    sys.exit(stop.exit_code or 130)


def _read_limit(arguments: Sequence[str]) -> tuple[float, list[str]]:
    """Factor of `--read-limit`, and the other arguments."""
    rest, times = list(arguments), 1.0
    for k in [k for k, a in enumerate(rest) if a.partition("=")[0] == _READ_LIMIT][::-1]:
        name, equals, value = rest[k].partition("=")
        values = [value] if equals else rest[k + 1 : k + 2]
        try:
            times = decimal(values[0])
        except (IndexError, ValueError):
            raise InputError(
                f"{name} needs a number: how many times the usual limits of reading to allow, "
                f"such as {name} 4."
            ) from None
        del rest[k : k + (1 if equals else 2)]
    return times, rest


def _of_the_system(error: OSError) -> str:
    """Sentence for what the system refuses: the file or stream, else the call that was refused."""
    name = error.filename
    if name is not None:
        name = os.fsdecode(name) if isinstance(name, bytes) else name
        return f"{name}: {error.strerror}. {_MAKE_ROOM}"
    frames = [(f.f_globals.get("__name__", "?"), f.f_code) for f, _ in walk_tb(error.__traceback__)]
    module, code = frames[-1]
    what = f"the system refused {module}.{code.co_qualname}"
    if _SHARED in dict(frames):  # semaphores are files there, which the error does not name
        what = "/dev/shm: the system refused a semaphore, which processes share"
    elif module.startswith(_POOLS):  # raised there again
        what = "the system refused what a worker process asked for"
    ours = [(n, c) for n, c in frames[:-1] if n.startswith("pupper_sysid.") and n != __name__]
    where = f" (in {ours[-1][0]}.{ours[-1][1].co_qualname})" if ours else ""
    return f"{what}{where}: {error.strerror}. {_CURES[error.errno or 0]}"


class _Stream:
    """A standard stream whose errors carry its name, as those of files do."""

    def __init__(self, stream: Any, name: str):
        self._stream, self._name = stream, name

    def __getattr__(self, attribute: str) -> Any:
        return getattr(self._stream, attribute)

    def write(self, text: str) -> int:
        with self._named():
            return self._stream.write(text)

    def writelines(self, lines: Iterable[str]) -> None:
        with self._named():
            self._stream.writelines(lines)

    def flush(self) -> None:
        with self._named():
            self._stream.flush()

    @contextmanager
    def _named(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            error.filename = self._name
            raise


def _silence(stream: Any) -> None:
    """Send what a stream's buffer holds nowhere: it would fail once more at the exit."""
    with suppress(OSError, AttributeError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _print_error(error: str) -> None:
    try:
        err.print(Text.assemble(("error: ", "red"), error))
    except OSError:  # no stream to print to: the exit code remains
        _silence(sys.stderr)


def _completion(program: str) -> list[str]:
    """Arguments with which tyro writes the completion file of the user's shell."""
    of_user = os.environ.get("SHELL", "")
    shell = Path(of_user).name
    if shell not in _COMPLETIONS:
        raise InputError(
            f"Completion is for {' and '.join(_COMPLETIONS)}; $SHELL is '{of_user}'. `{program} "
            "--tyro-print-completion tcsh` prints another one."
        )
    path = Path.home() / _COMPLETIONS[shell].format(program)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path.parent} cannot be made: {error.strerror}. Check $HOME.") from error
    hint = "Open a new terminal to use it."
    if shell == "zsh":
        hint = f"With `fpath+=({path.parent})` before compinit in ~/.zshrc, open a new terminal."
    err.print(f"Writing {path}. {hint}")
    return ["--tyro-write-completion", shell, str(path)]


# ----- values of the command line


@NUMERALS.primitive_rule
def numeral(type_info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """How an option of type int or float is read; None for other types."""
    kind: Any = type_info.type
    if kind not in _READERS:
        return None
    return PrimitiveConstructorSpec(
        nargs=1, metavar=kind.__name__.upper(),
        instance_from_str=lambda words: _READERS[kind](words[0]),
        is_instance=lambda value: (
            isinstance(value, (int, kind)) and (not isinstance(value, bool) or kind is float)
        ),
        str_from_instance=lambda value: [str(value)],
    )  # fmt: skip


@NUMERALS.primitive_rule
def optional(type_info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """How an option of a type or None is read: as the type, or `None` as typed."""
    kinds = [kind for kind in get_args(type_info.type) if kind is not NoneType]
    if NoneType not in get_args(type_info.type) or len(kinds) != 1:
        return None
    inner = ConstructorRegistry.get_primitive_spec(
        PrimitiveTypeInfo.make(kinds[0], parent_markers=type_info.markers)
    )
    if not isinstance(inner, PrimitiveConstructorSpec) or inner.nargs != 1:
        return None
    return replace(
        inner,
        instance_from_str=lambda typed: (
            None if typed == ["None"] else inner.instance_from_str(typed)
        ),
        is_instance=lambda value: value is None or inner.is_instance(value),
        str_from_instance=lambda value: (
            ["None"] if value is None else inner.str_from_instance(value)
        ),
    )


_SCREEN = 80
"""Characters of a line of a terminal."""


class Command(NamedTuple):
    """One word of a program."""

    group: str
    summary: str
    """What it does, in one line."""
    where: str
    """`module:Class` below `pupper_sysid.cli.commands`: a dataclass with a method `run`, or a union
    of such dataclasses as subcommands."""
    holds_bus: bool = False
    """Whether it must release a bus before it ends."""

    def load(self) -> Any:
        """Import the class."""
        module, name = self.where.split(":")
        return getattr(import_module(f"pupper_sysid.cli.commands.{module}"), name)


def commands_of(
    summaries: Mapping[str, Mapping[str, str]],
    modules: Mapping[str, str],
    holding_bus: Collection[str] = (),
) -> dict[str, Command]:
    """Commands by word, from their summaries by group; `fit-servo` is a class `FitServo`.

    `modules` has the words of each module below `pupper_sysid.cli.commands`; the module of any
    other word is called as it. Those `holding_bus` must release a bus before they end.
    """
    module_of = {word: module for module, words in modules.items() for word in words.split()}
    return {
        word: Command(
            group, summary, f"{module_of.get(word, word)}:{word.title().replace('-', '')}",
            word in holding_bus,
        )
        for group, words in summaries.items()
        for word, summary in words.items()
    }  # fmt: skip


def run_command(
    program: str,
    description: str,
    commands: Mapping[str, Command],
    arguments: Sequence[str] | None = None,
) -> None:
    """Run the command that the first of the arguments (by default the process's) names.

    Ends the process with 0, 2 (bad input, one sentence) or 1. `description`, what the program is
    for, stands above its table of commands.
    """
    words_typed = list(sys.argv[1:] if arguments is None else arguments)
    with user_errors(words_typed, program) as words_left:
        first, rest = (words_left[0], words_left[1:]) if words_left else ("--help", [])
        if first in (*HELP, ALL):
            print(overview(program, description, commands))
            return
        if first.startswith("--tyro-"):  # completion, of all words and their options
            words = (Annotated[c.load(), tyro.conf.subcommand(w)] for w, c in commands.items())
            every_command: Any = functools.reduce(operator.or_, words)
            tyro.cli(every_command, prog=program, args=words_left, config=CONFIG)
        if first not in commands:
            near = difflib.get_close_matches(first, commands, n=1, cutoff=0.5)
            hint = f" Did you mean `{program} {near[0]}`?" if near else ""
            raise InputError(
                f"{program} has no command {first}.{hint} `{program} --help` lists all."
            )
        chosen = commands[first]
        kind = chosen.load()
        # a union has no docstring, and that of its class in Python would be shown
        described = None if isinstance(kind, type) else chosen.summary
        command = parse(kind, rest, f"{program} {first}", described)
        if chosen.holds_bus:
            end_politely()
        else:
            begin_work()
        command.run()


def overview(program: str, description: str, commands: Mapping[str, Command]) -> str:
    """A program's help: its commands, by group, one line each."""
    group_width = 2 + max(len(c.group) for c in commands.values())
    rows: list[list[str]] = []  # a command without summary is shown with the one before it
    for word, (group, summary, *_) in commands.items():
        if summary:
            rows.append([group, word, summary])
        else:
            rows[-1][1] += f" / {word}"
    width = 2 + max(len(words) for _, words, _ in rows)
    usage, what = f"usage: {program} COMMAND [OPTIONS | --help]", description.strip()
    one_line = f"{usage}   {what}"
    lines, last = ([one_line] if len(one_line) <= _SCREEN else [usage, what]), None
    for group, words, summary in rows:
        lines.append(f"{'' if group == last else group:{group_width}}{words:{width}}{summary}")
        last = group
    return "\n".join(lines)


def words(commands: Mapping[str, Command]) -> list[str]:
    """All commands; subcommands as two words."""
    names = []
    for word, command in commands.items():
        inner = (get_args(kind)[1].name for kind in get_args(command.load()))
        names += [word, *(f"{word} {name}" for name in inner)]
    return names
