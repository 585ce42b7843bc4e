"""A rehearsal: keys in the emulator's window move limp joints until a joint map is written."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from pupper_sysid.cli.commands.robot.hand import Hand
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.sim.emulator.bench import ServoBench
from pupper_sysid.sim.emulator.robot import draw_robot
from support.servo_servers import wait_until

PROGRAM = [
    sys.executable, "-c", "from pupper_sysid.cli.programs.pupper_sysid import main; main()",
]  # fmt: skip


class Typed:
    """A program whose output is read along, and to which lines and keys are typed."""

    def __init__(self, *arguments: str):
        self.process = subprocess.Popen(
            [*PROGRAM, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, bufsize=0,
        )  # fmt: skip
        self.said = ""
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        while more := self.process.stdout.read(1024):
            self.said += more.decode(errors="replace")

    def heard(self, words: str) -> bool:
        return wait_until(lambda: words in " ".join(self.said.split()), 40.0)

    def type(self, keys: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(keys.encode())

    def end(self) -> int:
        code = self.process.wait(30)
        self._reader.join(5)
        return code


def bench() -> ServoBench:
    rng = np.random.default_rng(0)
    return ServoBench(draw_robot(rng), load_joint_map("sts3215"), rng)


def test_only_limp_joints_move_and_they_stay_where_they_were_put():
    servos = bench()
    hand, before = Hand(servos), [servos.angle(i, 0.0) for i in range(12)]
    assert "holds its position" in hand.press("d")
    for i in range(12):
        servos.torque(i, 0.0, False)
    assert hand.press("D") == "all joints: +0.40 rad" and hand.press("?") == ""
    assert hand.press("n") == "LF_hip: chosen" and hand.press("a") == "LF_hip: +0.35 rad"
    moved = [servos.angle(i, 5.0) - b for i, b in enumerate(before)]
    assert moved == pytest.approx([0.35, *[0.4] * 11], abs=0.02)
    assert hand.press("0") == "LF_hip: +0.00 rad"
    servos.torque(1, 5.0, True)
    assert servos.hand_rad[1] == 0.0


@pytest.mark.slow
def test_a_calibration_of_the_joints_is_rehearsed_to_its_end(tmp_path):
    robot = Typed("emulate", "feetech", "--by-hand", "--ids", "4-6", "--seed", "1")
    try:
        assert robot.heard("Ctrl-C ends it.")
        assert "Keys move limp joints" in robot.said
        bus = re.search(r"--bus (feetech:\S+)", robot.said)
        assert bus
        out = tmp_path / "joints.yaml"
        guide = Typed(
            "calibrate-joints", "--bus", bus[1], "--joints", "LF", "--out", str(out),
            "--joint-map", "sts3215",
        )  # fmt: skip
        for words, keys in (
            ("will go limp", ""), ("Hold it still", ""), ("Step 2 of 3", "DDD0AAA0"),
            ("first position", ""), ("Now move", "DDDddddddd"),
        ):  # fmt: skip
            assert guide.heard(words), guide.said
            for key in keys:
                robot.type(key)
                time.sleep(0.15)
            guide.type("\n")
        assert guide.end() == 0, guide.said
    finally:
        robot.process.send_signal(signal.SIGINT)
        robot.end()
    found, start = load_joint_map(out), load_joint_map("sts3215")
    for name in ("LF_hip", "LF_thigh", "LF_calf"):
        low, high = found.file.joints[name].limits_counts
        whole = 2 * 1.2 * start.file.joints[name].counts_per_rad
        assert found.file.joints[name].source != "preset"
        assert 0.85 * whole < high - low < 1.1 * whole
    assert "which is kept" in " ".join(guide.said.split())
