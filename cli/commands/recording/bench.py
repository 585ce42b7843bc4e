"""`sweep`: the emulated bus; the bus and the plan of one servo on a bench (`--load`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pupper_sysid.cli import terminal
from pupper_sysid.cli.buses import connect
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import sha256
from pupper_sysid.hardware.address import EMULATED
from pupper_sysid.hardware.bus import ServoBus
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.hardware.safety.monitor import GuardLimits
from pupper_sysid.sysid.recordings.servo_setup import PendulumLoad
from pupper_sysid.sysid.sweep.bench import bench_plan, parse_load
from pupper_sysid.sysid.sweep.excitation import Plan

BENCH_MAP = "bench_sts3215"
BENCH_RATE_HZ = 100.0
"""One servo answers within a few milliseconds."""
BENCH_LIMITS = GuardLimits(
    speed_rad_s=6.0, acceleration_rad_s2=400.0, gentle_rad_s=0.6, park_within_s=6.0
)
"""Of a swinging mass: slower than a leg, and the way back takes its time."""


def load_of(request: dict[str, Any]) -> PendulumLoad | None:
    """The load that a request names."""
    return parse_load(request["load"]) if request.get("load") else None


def loads_of(request: dict[str, Any]) -> dict[str, Any]:
    """The entry `loads` of the recording's header; empty without a load."""
    load = load_of(request)
    return {"loads": {j: load.model_dump() for j in request["joints"]}} if load else {}


def open_emulated(request: dict[str, Any]) -> ServoBus:
    """The emulated robot: that of the joint map, or a Mini Pupper 2."""
    from pupper_sysid.sim.emulator.bus import EmulatedBus
    from pupper_sysid.sim.emulator.pendulum import draw_of_map, has_registers
    from pupper_sysid.sim.emulator.robot import draw_robot

    rng = np.random.default_rng(request["seed"])
    own = load_joint_map(request["joint_map"]) if request["joint_map"] else None
    robot = f"an emulated one with the servos of {own.file.name}" if own else "the emulated one"
    how = ", in real time" if request["real_time"] else ""
    terminal.err.print(f"No robot: using {robot}{how}.", soft_wrap=True)
    registers = request.get("registers") or {}
    if registers and not (own and has_registers(own)):
        raise InputError(
            "--registers: the servos of this robot have none that act. Give a --joint-map whose "
            "`servo` is STS3215."
        )
    drawn, plant = draw_of_map(rng, own, registers) if own else (draw_robot(rng), None)
    if request.get("plan"):  # the same robot, but not once more the same noise
        noise = int(sha256(Path(request["plan"]))[:12], 16)
        rng = np.random.default_rng([request["seed"], noise])
    return EmulatedBus(drawn, rng, bool(request["real_time"]), plant)


def open_bench(request: dict[str, Any]) -> ServoBus:
    """The bus of a bench, guarded with its limits."""
    if request["bus"] != EMULATED:
        return connect(request["bus"], request["joint_map"], request["joints"], BENCH_LIMITS)
    from pupper_sysid.sim.emulator.bus import EmulatedBus
    from pupper_sysid.sim.emulator.pendulum import Pendulum, PendulumBench, draw_bench

    rng = np.random.default_rng(request["seed"])
    load = load_of(request)
    terminal.err.print(f"No servo: using an emulated STS3215 on a bench, load {request['load']}.")
    robot = draw_bench(
        rng,
        Pendulum(**(load.model_dump() if load else {})),
        joint_map=load_joint_map(request["joint_map"] or BENCH_MAP),
    )
    bus = EmulatedBus(robot, rng, bool(request["real_time"]), PendulumBench(robot))
    return GuardedBus(bus, BENCH_LIMITS)


def plan_of_bench(request: dict[str, Any], bus: ServoBus) -> Plan:
    """The plan that a request describes, within the limits of the bus."""
    (joint,), load = request["joints"], load_of(request)
    pose = dict(bus.metadata["rest_pose_rad"])
    if load:
        pose[joint] = load.hanging_rad
    free = bus.limits.margin(np.array([pose[name] for name in bus.joint_names]))
    return bench_plan(
        joint, load, request["gains"], request["kind"],
        frequencies_hz=request["frequencies_hz"], amplitude_rad=request["amplitude_rad"],
        duration_s=request["duration_s"], loop_period_s=request["loop_period_s"],
        start_rad=pose[joint], margin_rad=float(free[bus.joint_names.index(joint)]),
    )  # fmt: skip
