"""The pool of processes: its results, its errors, and that no process outlives its use."""

import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pupper_sysid.common.errors import PupperError
from pupper_sysid.common.processes.workers import Workers
from support.package import ROOT
from support.stopwatch import wait_until

linux = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")


def alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_work_is_done_whatever_the_number_of_processes_and_more_can_follow():
    factorials = {n: math.factorial(n) for n in range(5)}
    for count in (1, 3):
        done = {}
        with Workers(count) as workers:
            for n in factorials:
                workers.submit(n, math.factorial, n)
            for key, result in workers.results():
                done[key] = result
                if key < 100:
                    workers.submit(100 + key, math.isqrt, result)
        assert done == factorials | {100 + n: math.isqrt(x) for n, x in factorials.items()}


def test_an_error_is_raised_here_with_the_place_where_it_happened():
    with Workers(2) as workers:
        workers.submit("a", math.sqrt, 4.0)
        workers.submit("b", math.sqrt, -1.0)
        with pytest.raises(ValueError) as caught:
            list(workers.results())
    assert "Traceback" in caught.value.__notes__[0]


def test_a_killed_process_is_explained_by_the_memory_and_what_to_do():
    with Workers(2, option="jobs") as workers:
        workers.submit("a", signal.raise_signal, signal.SIGKILL)
        workers.submit("b", time.sleep, 60)
        with pytest.raises(PupperError, match=r"SIGKILL.*memory.*`jobs`"):
            list(workers.results())


def test_work_is_done_in_the_callers_folder_and_a_signal_for_the_group_is_left_to_the_caller(here):
    with Workers(2) as workers:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            workers.submit(number, signal.raise_signal, number)
        assert len(dict(workers.results())) == 3
        workers.submit("a", os.getcwd)
        workers.submit("b", os.getcwd)
        assert set(dict(workers.results()).values()) == {str(here)}


@linux
def test_leaving_the_pool_ends_its_processes_in_the_midst_of_their_work():
    processes = []
    with pytest.raises(KeyboardInterrupt), Workers(2) as workers:
        workers.submit("a", os.getpid)
        workers.submit("b", os.getpid)
        for _, process in workers.results():
            processes.append(process)
            workers.submit("c", time.sleep, 60)
            if len(processes) == 2:
                raise KeyboardInterrupt
    assert wait_until(lambda: not any(map(alive, processes)), 60.0)


@linux
def test_processes_are_forked_from_one_that_has_a_single_thread():
    """Python 3.12 and later warn of deadlocks where this is not so."""
    with Workers(2, "pupper_sysid.sysid.fit.calibrate") as workers:
        workers.submit("a", os.getppid)
        workers.submit("b", os.getppid)
        (server,) = set(dict(workers.results()).values())
        assert server != os.getpid()
        assert len(os.listdir(f"/proc/{server}/task")) == 1


KILLED = """
import os, time
from pupper_sysid.common.processes.workers import Workers
with Workers(2) as workers:
    for _ in range(2):
        workers.submit("", os.getpid)
    for _, process in workers.results():
        print(process, flush=True)
        workers.submit("", time.sleep, 60)
"""


@linux
def test_processes_end_with_the_one_that_uses_them_however_it_ends():
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED], cwd=ROOT, stdout=subprocess.PIPE, start_new_session=True
    )
    assert process.stdout is not None
    with process:
        started = [int(process.stdout.readline()) for _ in range(2)]
        parents = Path(f"/proc/{started[0]}/stat").read_text().rpartition(")")[2].split()[1]
        process.kill()
        process.wait()
        assert wait_until(lambda: not any(map(alive, [*started, int(parents)])), 60.0)
