"""An error names what caused it: the stream, the call that was refused, what a loop waited for."""

import errno
import multiprocessing.synchronize
import os
import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.cli.program import _is_interrupt, user_errors
from pupper_sysid.cli.programs import pupper_sysid
from pupper_sysid.common.errors import SafetyStop
from pupper_sysid.data import SAMPLES
from pupper_sysid.hardware.bus import BusSample
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.hardware.loop import BUS, GUARD, IMU, LOG, POLICY, VIEWS, FixedRateLoop
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.policies.deploy import deployment
from pupper_sysid.policies.deploy.assembly import assemble
from pupper_sysid.policies.deploy.deployment import constant
from pupper_sysid.policies.deploy.stacks import STACKS, suited
from pupper_sysid.policies.network.policy_file import load_policy
from pupper_sysid.sim.emulator.robot import draw_robot
from pupper_sysid.sim.walking.robot import WalkingBus
from support.command_line import refused
from support.following_bus import FollowingBus

PERIOD_S, LATE_S = 0.02, 0.055


def said(capsys, work) -> tuple[int, str]:
    """Exit code and message of a program that does `work`."""
    with pytest.raises(SystemExit) as end, user_errors([], "pupper-sysid"):
        work()
    return int(end.value.code or 0), " ".join(capsys.readouterr().err.split())


def test_a_refused_semaphore_is_blamed_on_dev_shm(capsys, monkeypatch):
    def refuse(*_):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr("_multiprocessing.SemLock", refuse)
    code, error = said(capsys, lambda: multiprocessing.get_context("spawn").Lock())
    assert code == 2
    assert error.startswith("error: /dev/shm: the system refused a semaphore")
    assert "Read-only file system" in error and "standard output" not in error


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EMFILE, errno.ENOMEM])
def test_a_refused_file_is_named_and_a_refusal_that_names_none_names_the_call(
    capsys, tmp_path, number
):
    def ask_the_system():
        raise OSError(number, os.strerror(number))

    code, error = said(capsys, ask_the_system)
    assert code == 2 and "ask_the_system" in error and os.strerror(number) in error
    assert "standard output" not in error and "defect" not in error
    code, error = said(capsys, lambda: open(tmp_path / ("a" * 300), "w"))
    assert code == 2 and str(tmp_path) in error and "standard output" not in error


class _Full:
    """A stream that takes nothing."""

    def __init__(self, number: int):
        self.number = number

    def write(self, text: str) -> int:
        raise OSError(self.number, os.strerror(self.number))

    def flush(self) -> None:
        pass


def test_a_reader_that_has_gone_ends_the_program_and_a_broken_pipe_elsewhere_is_an_error(
    capsys, monkeypatch
):
    def elsewhere():
        read, write = os.pipe()
        os.close(read)
        try:
            os.write(write, b"x")
        finally:
            os.close(write)

    code, error = said(capsys, elsewhere)
    assert code == 1 and "BrokenPipeError" in error
    monkeypatch.setattr(sys, "stdout", _Full(errno.EPIPE))
    assert said(capsys, lambda: print("x")) == (0, "")


class _Bus(FollowingBus):
    """One joint that is where it is commanded; an exchange takes as long as it is set to."""

    def __init__(self, exchange_s: float):
        super().__init__()
        self.exchange_s = exchange_s

    def read(self) -> BusSample:
        self.time += self.exchange_s
        return super().read()


CULPRITS = {
    BUS: "the bus answers late. Check its cable",
    IMU: "the IMU answers late",
    POLICY: "the policy takes too long on this host. Use a smaller network",
    LOG: "the disk takes the log too slowly. Write to another disk",
    VIEWS: "what is shown takes too long. Leave the live views out",
    GUARD: "this host is too slow or too busy. Stop other programs",
    "": "this host is too slow or too busy. Stop other programs",
}


@pytest.mark.parametrize("culprit", CULPRITS)
def test_a_late_loop_blames_what_it_waited_for_and_says_how_long(culprit):
    bus = _Bus(exchange_s=0.002)
    guard = GuardedBus(bus)
    loop = FixedRateLoop(guard, PERIOD_S)
    late_ticks = 0
    with pytest.raises(SafetyStop) as stop:
        for elapsed in loop.ticks(3.0):
            late = elapsed > 1.0
            late_ticks += late
            bus.exchange_s = LATE_S if late and culprit == BUS else 0.002
            guard.read()
            with loop.spent.on(POLICY):
                bus.time += 0.003
            if late and culprit not in ("", BUS):
                with loop.spent.on(culprit):
                    bus.time += LATE_S
            elif late and culprit == "":
                bus.time += LATE_S
    text = str(stop.value)
    assert "deadlines of 20.0 ms in a row" in text and CULPRITS[culprit] in text
    assert sum(cure in text for cure in set(CULPRITS.values())) == 1
    each_ms = 1e3 * LATE_S + (3 if culprit == POLICY else 0)
    assert late_ticks >= 5 and f" {late_ticks * each_ms:.0f} ms " in text


def test_ticks_in_time_before_do_not_count_towards_the_culprit():
    """The bus takes most of the ticks in time; the host is what makes the loop late."""
    bus = _Bus(exchange_s=0.018)
    guard = GuardedBus(bus)
    loop = FixedRateLoop(guard, PERIOD_S)
    late_ticks = 0
    with pytest.raises(SafetyStop, match="too slow or too busy") as stop:
        for elapsed in loop.ticks(20.0):
            guard.read()
            bus.time += 0.037 if elapsed > 10.0 else 0.0
            late_ticks += elapsed > 10.0
    shares = f"{37 * late_ticks} ms the rest of the loop, {18 * late_ticks} ms waiting for the bus"
    assert shares in str(stop.value)


class _Faulty(WalkingBus):
    """A walking robot, part of which is late, or broken, from the first tick of the walk on."""

    fault = ""

    def begin(self, fault: str) -> None:
        self.fault = fault

    def wait_if(self, fault: str) -> None:
        if self.fault == fault:
            self._bus._clock.spend(LATE_S)

    def read(self) -> BusSample:
        self.wait_if(BUS)
        return super().read()

    def imu(self):
        sample = super().imu()
        broken = self.fault == "rate_rad_s"
        return replace(sample, rate_rad_s=np.full(3, np.nan)) if broken else sample


def stop_reason(monkeypatch, folder: Path, fault: str) -> str:
    """End of a walk with a fault; standing up and resting are cut short."""
    for name, short in (("STAND_S", 0.1), ("SETTLE_S", 0.1), ("REST_SAMPLES", 20)):
        monkeypatch.setattr(deployment, name, short)
    rng = np.random.default_rng(0)
    bus, policy = _Faulty(draw_robot(rng), rng), load_policy(SAMPLES / "policies/mlp")
    parts = assemble(
        policy, STACKS[suited(policy.contract)], load_joint_map("mini_pupper_2"),
        str(SAMPLES / "calibrated.yaml"), None,
    )  # fmt: skip
    step = parts.controller.step

    def decide(senses):
        bus.wait_if(POLICY)
        return step(senses)

    monkeypatch.setattr(parts.controller, "step", decide)
    with closing(GuardedBus(bus)) as guard:
        return deployment.deploy(
            guard, bus, parts.controller, constant((0.0, 0.0, 0.0)), 1.0, folder / "walk.csv",
            parts.header, watchers=[lambda tick: bus.begin(fault)],
        ).stop_reason  # fmt: skip


@pytest.mark.parametrize("culprit", [BUS, pytest.param(POLICY, marks=pytest.mark.slow)])
def test_a_walk_that_is_late_blames_what_it_waited_for(monkeypatch, tmp_path, culprit):
    assert CULPRITS[culprit] in stop_reason(monkeypatch, tmp_path, culprit)


def test_an_imu_that_returns_no_numbers_is_silent(monkeypatch, tmp_path):
    assert "the IMU has not answered" in stop_reason(monkeypatch, tmp_path, "rate_rad_s")


# ----- what the system refuses is the user's to mend: one sentence, exit code 2


def command(words, **how):
    program = "from pupper_sysid.cli.programs.pupper_sysid import main; main()"
    return subprocess.run([sys.executable, "-c", program, *words], check=False, **how)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_a_full_disk_behind_the_output_is_said_in_a_sentence():
    with open("/dev/full", "w") as full:
        ended = command(["servo", "list"], stdout=full, stderr=subprocess.PIPE, text=True)
    assert ended.returncode == 2
    assert ended.stderr.startswith("error: standard output: No space left on device.")
    assert ended.stderr.count("\n") == 1


@pytest.mark.skipif(sys.platform == "win32", reason="streams are closed by a shell")
def test_a_program_whose_streams_are_closed_ends_as_ever(tmp_path):
    for words, closed, expected in ((["sweep", "--help"], (0, 1, 2), 0), (["nonsense"], (2,), 2)):

        def close(streams=closed) -> None:
            for stream in streams:
                os.close(stream)

        ended = command(words, cwd=tmp_path, preexec_fn=close)
        assert ended.returncode == expected, (words, closed)


@pytest.mark.skipif(not os.path.exists("/proc"), reason="needs a folder that cannot be written")
def test_a_home_that_cannot_be_written_is_said_in_a_sentence(capsys, monkeypatch):
    monkeypatch.setenv("HOME", "/proc")
    monkeypatch.setenv("SHELL", "/bin/bash")
    assert "cannot be made" in refused(capsys, pupper_sysid, "--install-completion")


def test_an_interrupt_that_a_library_passed_on_is_known_beside_a_failing_bus():
    try:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt:
            raise ValueError("model") from None
    except ValueError as error:
        passed_on = error
    assert _is_interrupt(passed_on)
    assert _is_interrupt(TypeError('Error building "literal" validator: KeyboardInterrupt: '))
    assert not _is_interrupt(OSError("the bus does not answer"))
