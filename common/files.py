"""How this project writes files: never over something else, never half, always with provenance."""

from __future__ import annotations

import hashlib
import os
import tempfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from common.errors import FileExistsRefusal, InputError

PACKAGE = "pupper-sysid"


def refuse_overwrite(path: Path, force: bool = False) -> None:
    """Raise unless `path` is free, or `force` was given."""
    if path.exists() and not force:
        raise FileExistsRefusal(
            f"{path} exists already. Choose another name, or add --force to replace it."
        )


def write_text(path: Path, text: str, force: bool = False) -> None:
    """Write `text` to `path` in one atomic step, so that no reader ever sees half of it."""
    write_bytes(path, text.encode(), force)


def write_bytes(path: Path, data: bytes, force: bool = False) -> None:
    """Write `data` to `path` in one atomic step, so that no reader ever sees half of it."""
    refuse_overwrite(path, force)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(data)
            os.chmod(temporary, 0o644)  # mkstemp makes it private; results are meant to be shared
            os.replace(temporary, path)
        except BaseException:
            os.unlink(temporary)
            raise
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror or error}.") from error


def sha256(path: Path) -> str:
    """Hexadecimal SHA-256 of the file at `path`."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def versions(*more: str) -> dict[str, str]:
    """Versions of this project and of the libraries that shape its numbers, `more` included."""
    found = {}
    for name in (PACKAGE, "numpy", "scipy", "mujoco", *more):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
