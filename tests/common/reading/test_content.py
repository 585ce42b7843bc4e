"""Whatever a name stands for, only regular files are read, and nothing is waited for."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from pupper_sysid.common.border import read_bytes
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import sha256, write_text


def refusal(function, *given) -> str:
    with pytest.raises(InputError) as refused:
        function(*given)
    return str(refused.value)


@pytest.fixture
def odd(tmp_path) -> dict[str, Path]:
    """Names that are no regular files."""
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "link").symlink_to("/dev/zero")
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(tmp_path / "socket"))
    return {
        "fifo": tmp_path / "fifo", "link to a device": tmp_path / "link",
        "socket": tmp_path / "socket", "folder": tmp_path, "device": Path("/dev/zero"),
    }  # fmt: skip


def test_what_is_no_regular_file_is_refused_at_once_and_never_replaced(odd):
    for kind, path in odd.items():
        if not path.exists():
            continue
        for reads in (read_bytes, sha256):
            assert f"{path} is not a file" in refusal(reads, path), kind
        if kind != "folder":
            before = os.lstat(path)
            assert "is not a file" in refusal(write_text, path, "x", True), kind
            assert os.lstat(path) == before


def test_names_that_lead_nowhere_are_refused(tmp_path):
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for name in ("a\0b", "a" * 5000, "nothing", "loop"):
        assert refusal(read_bytes, tmp_path / name).startswith(str(tmp_path / name))


def test_a_file_that_tells_no_size_is_read_up_to_the_limit():
    if not Path("/proc/kallsyms").exists():
        pytest.skip("no /proc on this system")
    assert "has more than 1,000 bytes" in refusal(read_bytes, Path("/proc/kallsyms"), 1000)


def test_a_file_that_gives_nothing_is_not_waited_for():
    if not os.access("/proc/kmsg", os.R_OK):
        pytest.skip("no readable /proc/kmsg on this system")
    assert "/proc/kmsg cannot be read" in refusal(read_bytes, Path("/proc/kmsg"), 1e9)
