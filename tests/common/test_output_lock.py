"""An output is written by one program at a time, and nothing stays behind that would block one."""

import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from pupper_sysid.cli.programs import pupper_sysid
from pupper_sysid.common.errors import FileExistsRefusal, InputError
from pupper_sysid.common.files import (
    SyncedText,
    hold_output,
    holding_outputs,
    refuse_overwrite,
    write_text,
)
from pupper_sysid.data import SAMPLES
from support.command_line import refused, run

SWEEP = SAMPLES / "sweep.csv"
HOLDER = """
import os, sys, time
from pathlib import Path
from pupper_sysid.common.files import holding_outputs, refuse_overwrite
with holding_outputs():
    refuse_overwrite(Path(sys.argv[1]), force=True)
    print("held", flush=True)
    if sys.argv[2:]:
        child = os.fork()
        if not child:
            print(os.getpid(), flush=True)  # from then on it has let go of the lock
            time.sleep(60)
            os._exit(0)
    sys.stdin.readline()
"""


def held_elsewhere(path: Path, forks: bool = False) -> subprocess.Popen:
    """Another process that holds `path` until a line or a signal reaches it.

    If it `forks`, its child prints its id.
    """
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(path), *["fork"] * forks],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    return process


@pytest.fixture(scope="module")
def held(tmp_path_factory):
    """An output that another process holds, and that process."""
    path = tmp_path_factory.mktemp("held") / "out.csv"
    path.write_text("before")
    process = held_elsewhere(path)
    yield path, process
    process.communicate("\n")
    assert process.returncode == 0
    assert [p.name for p in path.parent.iterdir()] == ["out.csv"]  # no lock file stays


def test_an_output_that_another_process_writes_is_refused_by_name_and_id_also_by_a_link(
    held, tmp_path
):
    path, process = held
    says = rf"out\.csv is being written by another process \({process.pid}\)"
    writes = (
        lambda: refuse_overwrite(path, force=True),
        lambda: write_text(path, "after", force=True),
        lambda: SyncedText(path, force=True),
        lambda: SyncedText(path, append_at=0),
    )
    for write in writes:
        with pytest.raises(InputError, match=says):
            write()
        with pytest.raises(InputError, match=says), holding_outputs():
            write()
    assert path.read_text() == "before"
    (tmp_path / "link.csv").symlink_to(path)
    with pytest.raises(InputError, match=str(process.pid)):
        refuse_overwrite(tmp_path / "link.csv", force=True)


def test_the_second_of_two_commands_on_one_output_is_refused_before_its_work(capsys, held):
    path, process = held
    for words in (
        ("sweep", "--freqs", "1", "--joints", "LF_hip"), ("calibrate", SWEEP), ("import", SWEEP),
        ("export", SWEEP),
    ):  # fmt: skip
        said = refused(capsys, pupper_sysid, *words, "--out", path, "--force")
        assert str(path) in said and str(process.pid) in said
        assert path.read_text() == "before"


def test_a_lock_file_of_a_killed_process_does_not_block(tmp_path):
    path = tmp_path / "out.csv"
    process = held_elsewhere(path)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert [p.name for p in tmp_path.iterdir()] == [".out.csv.lock"]
    with holding_outputs():
        refuse_overwrite(path)
        write_text(path, "after")
    assert [p.name for p in tmp_path.iterdir()] == ["out.csv"]


def test_the_program_that_holds_an_output_writes_it_as_often_as_it_likes(tmp_path):
    path = tmp_path / "new" / "out.csv"
    with holding_outputs():
        refuse_overwrite(path)
        assert (path.parent / ".out.csv.lock").read_text() == f"{os.getpid()}\n"
        write_text(path, "once")
        with holding_outputs():  # a command within a command
            refuse_overwrite(path, force=True)
            SyncedText(path, force=True).close(["twice"])
        with pytest.raises(FileExistsRefusal):
            refuse_overwrite(path)
    assert [p.name for p in path.parent.iterdir()] == ["out.csv"]
    assert path.read_text() == "twice\n"


def test_a_child_process_neither_keeps_nor_removes_the_lock(tmp_path):
    path = tmp_path / "out.csv"
    process = held_elsewhere(path, forks=True)
    child = int(process.stdout.readline())
    try:
        with pytest.raises(InputError, match=str(process.pid)):
            refuse_overwrite(path)
        process.kill()
        process.wait()
        os.kill(child, 0)  # it lives on, as a worker whose parent was killed may
        with holding_outputs():
            refuse_overwrite(path)
    finally:
        os.kill(child, signal.SIGKILL)
        process.communicate()
    assert not list(tmp_path.iterdir())


def test_a_thread_writes_what_its_process_holds_and_a_folder_is_held_beside_it(tmp_path):
    path, folder = tmp_path / "out.csv", tmp_path / "runs" / "a"
    with holding_outputs(), ThreadPoolExecutor(1) as pool:
        refuse_overwrite(path)
        pool.submit(write_text, path, "from a thread").result()
        hold_output(folder)
        assert not folder.exists()
    assert path.read_text() == "from a thread"
    assert list(tmp_path.iterdir()) == [
        path
    ]  # also the folders that were made for the lock are gone
    with holding_outputs(), pytest.raises(InputError, match="cannot be written"):
        refuse_overwrite(path / "out.csv")


@pytest.mark.parametrize("ends", ["refused", "written"])
def test_nothing_but_the_output_stays_after_a_command(capsys, tmp_path, ends):
    out = tmp_path / "deep" / "er" / "out.csv"
    log = SWEEP if ends == "written" else tmp_path / "missing.csv"
    code, _, said = run(capsys, "import", log, "--out", out)
    assert code == (0 if ends == "written" else 2), said
    expected = [out.parent.parent, out.parent, out] if ends == "written" else []
    assert sorted(tmp_path.rglob("*")) == expected
