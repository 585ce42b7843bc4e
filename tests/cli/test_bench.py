"""`sweep --load` from the command line: a bench without a joint map, over both kinds of bus."""

from __future__ import annotations

import json

import numpy as np
import pytest
import yaml

from pupper_sysid.cli.programs import pupper_sysid
from pupper_sysid.hardware.feetech import STS3215
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.sim.emulator.bench import ServoBench
from pupper_sysid.sim.emulator.feetech import FeetechEmulator
from pupper_sysid.sim.emulator.pendulum_bench import (
    BENCH_MAP,
    Pendulum,
    PendulumBench,
    draw_bench,
)
from pupper_sysid.sysid.recordings.files import load
from support.command_line import refused, run
from support.servo_servers import on_a_port

LOAD = "pendulum:0.1kg@0.10m"


pytestmark = pytest.mark.usefixtures("here")


def sweep(capsys, *more: str):
    return run(capsys, "sweep", "--load", LOAD, *more)


def test_an_emulated_bench_needs_no_joint_map_and_its_truth_has_the_load(capsys, tmp_path):
    code, out, err = sweep(capsys, "--gains", "8,32", "--kind", "drop", "--truth", "--json",
                           "--duration", "1", "--out", "a.csv")  # fmt: skip
    assert code == 0, err
    assert json.loads(out)["joints"] == ["bench"] and json.loads(out)["trials"] == 4
    recording = load(tmp_path / "a.csv")
    assert [t.p_gain for t in recording.trials("bench")] == [8.0, 8.0, 32.0, 32.0]
    assert recording.trials("bench")[0].load.mass_kg == 0.1
    assert recording.loop_period_s == pytest.approx(0.01, rel=0.02)
    truth = yaml.safe_load((tmp_path / "a.truth.yaml").read_text())["joints"]["bench"]
    assert truth["loaded_servo"]["mass_kg"] == 0.1


def test_an_interrupted_bench_is_continued_at_its_gain(capsys, tmp_path):
    code, _, err = sweep(
        capsys, "--gains", "8,32", "--kind", "steps", "--duration", "2", "--out", "a.csv"
    )
    assert code == 0, err
    lines = (tmp_path / "a.csv").read_text().splitlines()
    body = [k for k, line in enumerate(lines) if line and line[0] != "#"]
    cut = body[0] + (len(body) * 3) // 4  # within the second trial
    (tmp_path / "a.csv").write_text("\n".join(lines[:cut]) + "\n")
    code, _, err = run(capsys, "sweep", "--resume", "a.csv")
    assert code == 0 and "trial 2 of 2" in err
    gains = [t.p_gain for t in load(tmp_path / "a.csv").trials("bench")]
    assert gains == [8.0, 32.0]


def test_what_makes_no_sense_on_a_bench_is_refused(capsys):
    program = pupper_sysid
    assert "one servo on a bench" in refused(capsys, program, "sweep", "--gains", "8,16")
    assert "one servo on a bench" in refused(capsys, program, "sweep", "--kind", "drop")
    assert "is no load" in refused(capsys, program, "sweep", "--load", "bucket")
    more = ("--load", LOAD, "--joint-map", "sts3215")
    assert "name it with --joints" in refused(capsys, program, "sweep", *more)
    assert "give one of the two" in refused(
        capsys, program, "sweep", "--load", LOAD, "--playback", "x.csv"
    )
    assert "are no P gains" in refused(capsys, program, "sweep", "--load", LOAD, "--gains", "0")


@pytest.mark.wall_clock
def test_a_bench_over_a_serial_line_is_swept_and_its_gain_set_back(capsys, tmp_path):
    rng = np.random.default_rng(2)
    robot = draw_bench(rng, Pendulum(0.1, 0.1))
    plant = PendulumBench(robot)
    bench = ServoBench(robot, load_joint_map(BENCH_MAP), rng.spawn(1)[0], plant=plant)
    with on_a_port(FeetechEmulator(bench, STS3215, rng)) as server:
        code, _, err = sweep(
            capsys, "--gains", "8,16", "--kind", "steps", "--duration", "2", "--rate", "40",
            "--bus", f"feetech:{server.device}", "--out", "a.csv",
        )  # fmt: skip
    assert code == 0, err
    assert plant.register(0, "p") == 32
    assert [t.p_gain for t in load(tmp_path / "a.csv").trials("bench")] == [8.0, 16.0]
