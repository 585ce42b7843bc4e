"""A program that drives a served robot, in a process of its own, with its watchdog."""

import subprocess
import sys

from support.package import ROOT

PATIENT = """
from pupper_sysid.hardware.serial_servos import line
line.REPLY_TIMEOUT_S = 0.1
"""
"""Servos that share a busy machine with their driver answer too late."""
DRIVER = f"""{PATIENT}
import sys, time
import numpy as np
from pupper_sysid.hardware.address import parse_address
from pupper_sysid.hardware.safety.guard import open_guarded
bus = open_guarded(parse_address(sys.argv[1]))
pose = bus.read().position_rad
while not np.isfinite(pose).all():
    pose = bus.read().position_rad
bus.torque(True)
start = bus.now()
print("driving", bus._watchdog._process.pid, flush=True)
mode = sys.argv[2] if len(sys.argv) > 2 else ""
while True:
    if mode == "hold":  # without a reading, which another program might take
        bus.write(bus.sent)
    else:
        bus.write(pose + 0.3 * np.sin(2 * np.pi * 0.5 * (bus.now() - start)))
        bus.read()
    bus.sleep_until(bus.now() + 0.02)
    if mode == "hang" and bus.now() - start > 0.5:  # farthest out
        bus.bus.torque = lambda on: time.sleep(100)
        bus.limp()
"""


def drive(address: str, mode: str = "") -> tuple[subprocess.Popen, int]:
    """A driver that moves the robot, and the process id of its watchdog.

    With `mode` hold it only holds the pose; with hang it hangs when it should go limp.
    """
    process = subprocess.Popen(
        [sys.executable, "-c", DRIVER, address, mode], stdout=subprocess.PIPE, cwd=ROOT
    )
    assert process.stdout is not None
    word, watchdog = process.stdout.readline().split()
    assert word == b"driving"
    return process, int(watchdog)
