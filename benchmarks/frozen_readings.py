"""Frozen readings of joints that move little: how many are found, how soon, and false alarms.

    .venv/bin/python benchmarks/frozen_readings.py --walks 60 --seed 0

Emulated robots, each with servos of its own, walk ten seconds at random commands in virtual time;
one servo's reading freezes at a random moment in two walks of three. `policies.deploy` compares the
readings with a model of the shipped calibration, which is not these servos'.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from contextlib import closing
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.hardware.bus import BusSample
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.policies.deploy.assembly import assemble
from pupper_sysid.policies.deploy.commands import constant
from pupper_sysid.policies.deploy.deployment import deploy
from pupper_sysid.policies.deploy.stacks import STACKS, suited
from pupper_sysid.policies.network.policy_file import load_policy
from pupper_sysid.sim.emulator.robot import draw_robot
from pupper_sysid.sim.walking.bus import WalkingBus

SAMPLES = Path(__file__).resolve().parents[1] / "data/samples"
SECONDS, BEGIN_S = 10.0, 5.5  # standing up and resting take 5 s
MOTIONS = {"forward": (0.15, 0.05, 0.1), "turning": (0.05, 0.05, 0.6), "standing": (0.0, 0.0, 0.0)}


class Freezing(WalkingBus):
    """A robot one of whose servos reports one position from a time on."""

    def __init__(self, rng: np.random.Generator, joint: int, from_s: float):
        super().__init__(draw_robot(rng), rng)
        self.joint, self.from_s, self.last = joint, from_s, 0.0

    def read(self) -> BusSample:
        """See `WalkingBus`."""
        sample = super().read()
        servos = self.limits.servo_angles(sample.position_rad)
        if self.now() < self.from_s:
            self.last = float(servos[self.joint])
            return sample
        servos[self.joint] = self.last
        return replace(sample, position_rad=self.limits.from_servo_angles(servos))


def walk(seed: int, motion: str) -> tuple[str, bool, float, str]:
    """Motion and kind of joint, whether it froze, the time until the end [s], and its reason."""
    rng = np.random.default_rng([seed, len(motion)])
    joint = 3 * int(rng.integers(4)) + seed % 3
    freezes = seed // 3 % 3 != 0
    bus = Freezing(rng, joint, rng.uniform(BEGIN_S, BEGIN_S + 3) if freezes else np.inf)
    policy = load_policy(SAMPLES / "policies" / ("lstm", "mlp")[seed // 9 % 2])
    parts = assemble(
        policy, STACKS[suited(policy.contract)], load_joint_map("mini_pupper_2"),
        str(SAMPLES / "calibrated.yaml"), None,
    )  # fmt: skip
    command = rng.uniform(-1, 1, 3) * MOTIONS[motion]
    if motion == "turning":
        command[2] = rng.choice([-1, 1]) * rng.uniform(0.3, 0.6)
    with closing(GuardedBus(bus)) as guard, tempfile.TemporaryDirectory() as folder:
        outcome = deploy(
            guard, bus, parts.controller, constant(tuple(command)), SECONDS,
            Path(folder) / "walk.csv", parts.header, watchers=[parts.frozen_readings],
        )  # fmt: skip
    kind = JOINT_NAMES[joint].split("_")[1]
    if outcome.stop_reason == "time is up":
        return kind, freezes, np.nan, ""
    return kind, freezes, bus.now() - bus.from_s, outcome.stop_reason


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--walks", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print("| command | joint | frozen | found by the model | by the guard | go on | s: median |"
          " worst | never frozen | false alarms |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|---|")
    for motion in MOTIONS:
        found = [walk(options.seed + k, motion) for k in range(options.walks)]
        for kind in ("hip", "thigh", "calf"):
            own = [f for f in found if f[0] == kind]
            froze, live = [f for f in own if f[1]], [f for f in own if not f[1]]
            model = [f for f in froze if "reported the same" in f[3]]
            guard = [f for f in froze if "did not change once" in f[3]]
            times = [f[2] for f in model + guard] or [np.nan]
            print(
                f"| {motion} | {kind} | {len(froze)} | {len(model)} | {len(guard)} | "
                f"{len(froze) - len(model) - len(guard)} | {np.median(times):.2f} | "
                f"{max(times):.2f} | {len(live)} | {sum(bool(f[3]) for f in live)} |",
                flush=True,
            )
    print(f"\nLoad of the machine: {' '.join(f'{x:.1f}' for x in os.getloadavg())}.")


if __name__ == "__main__":
    main()
