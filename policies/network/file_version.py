"""Versions of the files that training and deployment write: what another version says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pupper_sysid.common.errors import InputError


def refuse_other_version(path: Path, version: Any, known: int, oldest: int | None = None) -> None:
    """Refuse a file of another version than the one that this code reads.

    Parameters
    ----------
    path : Path
    version : object
        What the file says of itself, whatever that is.
    known : int

    Raises
    ------
    InputError
        With the advice to upgrade if it is newer.
    """
    if type(version) is int and version > known:
        raise InputError(
            f"{path} was written by a newer version of pupper-sysid (schema_version {version}; "
            f"this one reads {known}). Upgrade pupper-sysid."
        )
    if type(version) is not int or not (oldest or known) <= version <= known:
        raise InputError(
            f"{path} has schema_version {version}; this version reads {known}. Put the file back "
            "as it was written."
        )
