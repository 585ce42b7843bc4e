"""Run a command as a user does, in this process."""

import json
import os
import subprocess
import sys
from pathlib import Path
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


def fresh_python(
    code: str, *words: object, folder: Path | None = None, path: Path | None = None
) -> str:
    """What a new interpreter prints that runs the code in a folder, with modules at a path."""
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    if path is not None:
        environment["PYTHONPATH"] = str(path)
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, words)], cwd=folder, env=environment,
        capture_output=True, text=True, check=False, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
