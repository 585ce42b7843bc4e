"""Search for the reference trot: smallest errors of speed and turn rate with calibrated servos.

CMA-ES over the fields of `Trot`. All candidates of a generation walk at once, each with the same
robots and the same constant commands (six directions and random ones), in the physics of
evaluation, with a clock and without feedback. The cost is the mean over the three axes of the error
at each instant, half of that over a stride, each over what it should be, and the errors of the
gains in the six directions. Other robots and commands judge what was found.

Needs `pip install cma`:

    python benchmarks/trot_search.py --minutes 10 --seed 0
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from pupper_sysid.policies.walks.conditions import DIRECTIONS, RANDOM, evaluation_task
from pupper_sysid.policies.walks.tracking import planar_velocity, stride_errors
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sim.walking.config import PRESETS
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.servo_ranges import servo_ranges
from pupper_sysid.sim.walking.shared_draws import Twins

# A foot is lifted over small steps of the ground, and the trunk keeps its distance from it, which
# this cost does not ask for.
# field, start, scale of the search, lowest, highest
SEARCHED = (
    ("frequency_hz", 3.2, 0.3, 2.0, 5.0),
    ("lift_m", 0.012, 0.002, 0.011, 0.02),
    ("duty", 0.7, 0.05, 0.5, 0.85),
    ("crouch_m", 0.005, 0.003, -0.005, 0.010),
    ("spread_m", 0.001, 0.002, -0.005, 0.012),
    ("even_swing", 0.3, 0.3, 0.0, 1.0),
    ("gain", 0.95, 0.05, 0.5, 1.5),
    ("turn_gain", 0.85, 0.08, 0.5, 1.5),
    ("turn_dead_band_rad_s", 0.1, 0.04, 0.0, 0.3),
)
NAMES = [row[0] for row in SEARCHED]
START, SCALE, LOW, HIGH = np.array([row[1:] for row in SEARCHED]).T
WALKING = np.array([c for c in DIRECTIONS.values() if any(c)])
INSTANT, STRIDE = np.array([0.015, 0.013, 0.10]), np.array([0.008, 0.008, 0.05])
SECONDS, BEGIN_S = 3.0, 0.8


class Bench:
    """The same robots and commands for a number of candidates."""

    def __init__(self, candidates: int, robots: int, seed: int, calibration: str, threads: int):
        self.candidates, self.robots = candidates, robots
        rng = np.random.default_rng(seed)
        low, high = np.array([RANDOM.forward_m_s, RANDOM.sideways_m_s, RANDOM.yaw_rad_s]).T
        more = rng.uniform(low, high, (robots - len(WALKING), 3))
        self.command = np.concatenate([WALKING, more])
        twins = Twins(np.tile(np.arange(robots), candidates), robots)
        task = evaluation_task(PRESETS["fast"], SECONDS + 1)
        self.step_s = task.control_step_s
        self.env = PupperEnv(
            task, servo_ranges(calibration), candidates * robots, seed, threads, twins=twins
        )
        self.env.set_command(np.tile(self.command, (candidates, 1)))
        self.start = self.env.state

    def walk(self, trots: list[Trot]) -> dict[str, np.ndarray]:
        """Errors of candidates: `instant` and `stride` (k, 3), `gain` (k, 6), `falls` (k,)."""
        env, velocity, alive = self.env, [], []
        env.restore(self.start)
        up = np.ones(env.environments, bool)
        for step in range(round(SECONDS / self.step_s)):
            joints = [
                t.joints(np.full(self.robots, 2 * np.pi * t.frequency_hz * step * self.step_s),
                         self.command)
                for t in trots
            ]  # fmt: skip
            result = env.step((np.concatenate(joints) - env.default) / env.config.action_scale)
            up = up & ~result.done
            velocity.append(planar_velocity(result.facts))
            alive.append(up)
        first = round(BEGIN_S / self.step_s)
        shape = (len(velocity) - first, self.candidates, self.robots)
        v = np.array(velocity)[first:].reshape(*shape, 3)
        on = np.array(alive)[first:].reshape(shape)
        v = np.where(on[..., None], v, 0.0)
        command = np.broadcast_to(self.command, (shape[0], self.robots, 3))
        stride = [
            stride_errors(v[:, k], command, on[:, k], ~on[-1, k],
                          np.full(self.robots, 1 / t.frequency_hz), self.step_s).mean(axis=0)
            for k, t in enumerate(trots)
        ]  # fmt: skip
        mean = v.mean(axis=0)[:, : len(WALKING)]
        gain = (mean * WALKING).sum(axis=2) / (WALKING**2).sum(axis=1)
        return {
            "instant": np.abs(v - self.command).mean(axis=(0, 2)), "stride": np.array(stride),
            "gain": gain, "falls": 1 - on[-1].mean(axis=1),
        }  # fmt: skip

    def cost(self, trots: list[Trot]) -> np.ndarray:
        """Of each candidate."""
        found = self.walk(trots)
        cost = (found["instant"] / INSTANT).mean(axis=1)
        cost += 0.5 * (found["stride"] / STRIDE).mean(axis=1)
        return cost + np.abs(found["gain"] - 1).mean(axis=1) + 10 * found["falls"]


def trot_of(scaled: np.ndarray) -> Trot:
    values = np.clip(START + SCALE * scaled, LOW, HIGH)
    return Trot(**dict(zip(NAMES, values.tolist(), strict=True)))


def search(minutes: float, seed: int, calibration: str, candidates: int, robots: int) -> Trot:
    import cma  # no dependency of the project

    bench = Bench(candidates, robots, seed, calibration, 0)
    bounds = [((LOW - START) / SCALE).tolist(), ((HIGH - START) / SCALE).tolist()]
    es = cma.CMAEvolutionStrategy(
        np.zeros(len(NAMES)), 0.5,
        {"popsize": candidates, "seed": seed + 1, "verbose": -9, "bounds": bounds},
    )  # fmt: skip
    begun, generation = time.monotonic(), 0
    while time.monotonic() - begun < 60 * minutes:
        asked = es.ask()
        es.tell(asked, bench.cost([trot_of(x) for x in asked]).tolist())
        generation += 1
        if generation % 10 == 0:
            print(generation, f"best {es.result.fbest:.3f}", shown(trot_of(es.mean)), flush=True)
    return trot_of(es.mean)


def shown(trot: Trot) -> str:
    return " ".join(f"{name} {getattr(trot, name):.4g}" for name in NAMES)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--calibration", default="data/samples/calibrated.yaml")
    given = parser.parse_args()
    trots = {
        "default": Trot(),
        "found": search(given.minutes, given.seed, given.calibration, 12, 20),
    }
    other = Bench(1, 100, given.seed + 1000, given.calibration, 0)
    print("| trot | vx, vy, yaw | over a stride | gains | falls | cost |")
    print("|---|---|---|---|---|---|")
    for name, trot in trots.items():
        found = {key: value[0] for key, value in other.walk([trot]).items()}
        errors = [" / ".join(f"{e:.4f}" for e in found[key]) for key in ("instant", "stride")]
        gains = " ".join(f"{g:.2f}" for g in found["gain"])
        cost = f"{other.cost([trot])[0]:.2f}"
        print(f"| {name} | {errors[0]} | {errors[1]} | {gains} | {found['falls']:.2f} | {cost} |")
    print("Found: " + shown(trots["found"]))


if __name__ == "__main__":
    main()
