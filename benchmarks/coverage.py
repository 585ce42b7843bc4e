"""Do the 90 % intervals of a calibration hold the truth? Random robots of three worlds, one table.

    .venv/bin/python benchmarks/coverage.py --world emulated --robots 240
    .venv/bin/python benchmarks/coverage.py --world live --robots 120
    .venv/bin/python benchmarks/coverage.py --world real --robots 120

`emulated`: robots of the emulator on a polled bus, one joint swept, compared with their truth.
`live`: servos of `benchmarks/twins.py` (Stribeck friction, backlash and command jitter beyond the
model, half with a set-point of limited rate, half with back-EMF) whose every row is a read, at 30,
50, 100 and 200 Hz. `real`: the recordings in `$PUPPER_REAL_DATA` played by such servos whose
numbers are draws from the recording's own posterior, half of each structure, with the recording's
command jitter, poll and losses. A quantity counts where the calibration calls it identified.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import warnings
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from multiprocessing import get_context
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import twins
from random_robots import sweep_random_robot

from pupper_sysid.common.errors import InputError
from pupper_sysid.sysid.compare.truth import truth_table
from pupper_sysid.sysid.identify.calibrate import CalibrationResult, calibrate
from pupper_sysid.sysid.identify.candidates.models import candidate_model
from pupper_sysid.sysid.identify.posterior import posterior
from pupper_sysid.sysid.identify.preparation import prepare_joint
from pupper_sysid.sysid.identify.search import SIMULATED
from pupper_sysid.sysid.recordings.files import load

REAL = Path(
    os.environ.get("PUPPER_REAL_DATA") or Path(__file__).resolve().parents[2] / "shared" / "real"
)
SWEEPS = ("real_motor_0_LF_hip_amp0.3.csv", "real_motor_1_LF_thigh_amp0.3.csv",
          "mini_pupper_full_band/thigh_1-10hz.csv")  # fmt: skip
LINEAR = ("dead_time_s", "offset_rad", "poll_period_s", "loss", "mean_age_s", "lag_s",
          "command_jitter_s", "back_emf")  # fmt: skip


@dataclass(frozen=True)
class Row:
    """One quantity of one robot."""

    quantity: str
    low: float
    high: float
    identified: bool
    truth: float


def emulated(seed: int) -> list[Row]:
    """Rows of one robot of the emulator."""
    rng = np.random.default_rng([20261122, 7, seed])
    loss, noise = float(rng.uniform(0.0, 0.5)), float(rng.uniform(0.002, 0.008))
    robot = sweep_random_robot(rng, loss, noise, "1,2,4,8")
    made = calibrate(robot.recording, [robot.joint])
    table = truth_table(made, robot.bus.truth(), robot.recording)
    return [
        Row(r.quantity, r.found.low, r.found.high, r.identified != "no", r.truth)
        for r in table.quantities
        if r.found is not None and np.isfinite([r.found.low, r.found.high]).all()
    ]


def of_twin(own: twins.Servo, made: CalibrationResult) -> Iterator[Row]:
    """Rows of one synthetic servo."""
    joint = made.calibration.joint(twins.JOINT)
    ratios, f = joint.actuator.ratios_to_armature, joint.feedback
    speed = own.velocity_limit if np.isfinite(own.velocity_limit) else 1000.0
    for name, q, truth in (
        ("dead_time_s", joint.actuator.dead_time_s, own.truth()["dead_time_s"]),
        ("stiffness", ratios.stiffness, own.stiffness),
        ("damping", ratios.damping, own.damping),
        ("friction_loss", ratios.friction_loss, own.friction),
        ("effort_limit", ratios.effort_limit, own.effort),
        ("velocity_limit_rad_s", joint.actuator.velocity_limit_rad_s, speed),
        ("back_emf", ratios.back_emf, own.back_emf),
        ("command_jitter_s", joint.actuator.command_jitter_s, own.command_jitter_s),
        ("offset_rad", f.offset_rad, own.offset_rad),
        ("poll_period_s", f.poll_period_s, own.poll_s),
        ("loss", f.loss, own.loss),
        ("mean_age_s", f.mean_age_s, own.poll_s * (0.5 + own.loss / (1 - own.loss))),
    ):
        if q.low is not None and q.high is not None:
            yield Row(name, q.low, q.high, q.identified != "no", truth)


def live(seed: int) -> list[Row]:
    """Rows of one servo that answers every read."""
    own, recording = twins.twin(10_000 + seed, ("slew", "back-EMF")[seed % 2], False, True)
    return list(of_twin(own, calibrate(recording)))


@lru_cache
def of_recording(name: str) -> tuple:
    """A real sweep, its joint, and the posterior of each structure."""
    recording = load(REAL / name)
    joint = recording.joints[0]
    ready = prepare_joint(joint, tuple(recording.trials(joint)), 0)
    drawn = {
        s: posterior(
            candidate_model(s), ready.data, ready.noise_rad, ready.first[s], ready.fit_rng()
        ).values
        for s in SIMULATED
    }
    return recording, joint, ready.lag.feedback, drawn


def real(seed: int) -> list[Row]:
    """Rows of one synthetic servo in the place of a real one."""
    rng = np.random.default_rng([20261122, 8, seed])
    recording, joint, lattice, drawn = of_recording(SWEEPS[seed % len(SWEEPS)])
    structure = SIMULATED[seed % 2]
    model, draws = candidate_model(structure), drawn[structure]
    v = dict(zip(model.names, draws[rng.integers(len(draws))], strict=True))
    effort = v["effort_rad_s2"]
    own = twins.Servo(
        dead_time_s=v["dead_time_s"], stiffness=v["stiffness_per_s2"], damping=v["damping_per_s"],
        friction=v["friction_rad_s2"], effort=effort,
        velocity_limit=v.get("velocity_limit_rad_s", np.inf),
        back_emf=effort / v["no_load_speed_rad_s"] if "no_load_speed_rad_s" in v else 0.0,
        command_jitter_s=float(rng.uniform(0.0, 0.003)), offset_rad=float(rng.normal(0, 0.005)),
        quantum_rad=np.pi / 550, noise_rad=float(rng.uniform(0.001, 0.005)),
        poll_s=lattice.poll_period_s, loss=lattice.loss, poll_jitter_s=0.0008,
    )  # fmt: skip
    commands = [
        (t.frequency_hz, t.send_time_s - t.send_time_s[0], t.command_rad)
        for t in recording.trials(joint)
    ]
    return list(of_twin(own, calibrate(twins.record(own, commands, rng))))


def _quietly(world: str, seed: int) -> list[Row] | None:
    """Rows of one robot; None where `calibrate` refuses it, such as one that cannot move."""
    warnings.simplefilter("ignore")
    try:
        return {"emulated": emulated, "live": live, "real": real}[world](seed)
    except InputError:
        return None


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--world", choices=("emulated", "live", "real"), default="emulated")
    parser.add_argument("--robots", type=int, default=40)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    found: dict[str, list[Row]] = defaultdict(list)
    with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
        results = pool.map(partial(_quietly, options.world), range(options.robots))
        done = refused = 0
        with contextlib.suppress(KeyboardInterrupt):  # Ctrl-C: the table of what is done
            for done, rows in enumerate(results, 1):  # noqa: B007
                refused += rows is None
                for row in rows or ():
                    found[row.quantity].append(row)
        pool.shutdown(wait=False, cancel_futures=True)
    print(f"{done} robots, {options.world}, {refused} refused")
    print("| quantity | identified | holds the truth | median width | not identified: holds |")
    print("|" + "---|" * 5)
    for quantity, rows in found.items():
        known = [r for r in rows if r.identified]
        others = [r for r in rows if not r.identified]

        def held(some: list[Row]) -> str:
            # a quantisation step has no width, but that of its last digits
            slack = [1e-6 * abs(r.truth) for r in some]
            inside = sum(
                r.low - d <= r.truth <= r.high + d for r, d in zip(some, slack, strict=True)
            )
            return f"{inside} ({100 * inside / len(some):.0f} %)" if some else "–"

        width = "–"
        if known and quantity in LINEAR:
            width = f"{np.median([r.high - r.low for r in known]):.2g}"
        elif known:
            width = f"× {np.median([r.high / max(r.low, 1e-12) for r in known]):.2f}"
        print(f"| {quantity} | {len(known)} of {len(rows)} | {held(known)} | {width} | "
              f"{held(others)} |")  # fmt: skip


if __name__ == "__main__":
    main()
