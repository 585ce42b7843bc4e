"""Run a command as a user does, in this process."""

from __future__ import annotations

import json
from types import ModuleType
from typing import Any

from pupper_sysid.cli.programs import pupper_sysid


def run(capsys, *arguments) -> tuple[int, str, str]:
    """Exit code, stdout, and stderr on one line, of one command of pupper-sysid."""
    return run_program(capsys, pupper_sysid, *arguments)


def run_program(capsys, module: ModuleType, *arguments) -> tuple[int, str, str]:
    """The same of the program in a module of `cli`."""
    try:
        module.main([str(a) for a in arguments])
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    printed = capsys.readouterr()
    return code, printed.out, " ".join(printed.err.split())


def refused(capsys, module: ModuleType, *arguments) -> str:
    """Message for input that cannot be used: exit code 2, no traceback, no mention of a defect."""
    code, out, err = run_program(capsys, module, *arguments)
    assert code == 2, err
    assert out == "" and "Traceback" not in err and "defect" not in err
    return err


def ran(capsys, *arguments, program: ModuleType = pupper_sysid) -> tuple[str, str]:
    """Stdout, and stderr on one line, of a command that ends well."""
    code, out, err = run_program(capsys, program, *arguments)
    assert code == 0, err
    return out, err


def json_of(capsys, *arguments, program: ModuleType = pupper_sysid) -> Any:
    """What a command prints with `--json`."""
    return json.loads(ran(capsys, *arguments, "--json", program=program)[0])
