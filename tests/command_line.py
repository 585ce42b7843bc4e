"""Run a command as a user does, in this process."""

from __future__ import annotations

from cli.pupper_sysid import main


def run(capsys, *arguments) -> tuple[int, str, str]:
    """Exit code, stdout, and stderr on one line, of one command."""
    try:
        main([str(a) for a in arguments])
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    said = capsys.readouterr()
    return code, said.out, " ".join(said.err.split())
