"""How an STS3215 moves its set-point: laws tried on the motions of an SO-101 arm.

    .venv/bin/python benchmarks/set_point_laws.py

The last 20 s of `chirp_sweep` move as if the set-point's acceleration was limited, the jumps of
`prbs_excitation` do not. Each law moves the set-point of one servo model (position loop in duty, DC
motor, dry friction that grows with the motor's torque, gravity, dead time), fitted to chirp, PRBS
and steps of each joint together; `frequency_sweep` is left out. Printed is the RMS error [mrad],
mean over joints. With `--alone`, each recording is fitted alone, and its dead time is printed.
Recordings are found through PUPPER_REAL_DATA, else in ../shared/real.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from loaded_real import JOINTS, MOTIONS, REAL
from numba import njit
from scipy.optimize import least_squares

from pupper_sysid.sysid.feedback.poll_lattice import find_poll_lattice
from pupper_sysid.sysid.loaded.runs import Run, prepare
from pupper_sysid.sysid.recordings.files import load

STEP_S = 0.002
NOISE_RAD = 0.005
NO_LIMIT = 1e9
PARTS = {
    "chirp, first 100 s": ("chirp_sweep", 0, 100), "chirp, last 20 s": ("chirp_sweep", 100, 121),
    "PRBS": ("prbs_excitation", 0, 121), "steps": ("step_response", 0, 121),
    "frequency sweep": ("frequency_sweep", 0, 121),
}  # fmt: skip
FITTED = (
    ("chirp_sweep", 0, 40), ("chirp_sweep", 40, 100), ("chirp_sweep", 100, 121),
    ("prbs_excitation", 0, 60), ("step_response", 0, 60),
)  # fmt: skip
# laws by number; see `_set_point`
AT_ONCE, LIMITED, RESTART_MOVING, RESTART_AT_REST, KEEP_AT_REST, KEEP_SPEED = range(6)
BRAKING, SPEEDING_UP, FROM_REST, FAR = range(6, 10)


@dataclass(frozen=True)
class Law:
    """A law of the set-point, and what is fitted beside the servo."""

    number: int
    fitted: tuple[str, ...] = ("limit",)
    on_write: bool = False
    """Whether it restarts at every write, not at every changed goal."""
    free: tuple[str, ...] = ()
    """Motions in which it does not apply."""


LAWS = {
    "the command at once": Law(AT_ONCE, ()),
    "limited acceleration (sqrt braking), one limit": Law(LIMITED),
    "the same, and D gain on the error's rate": Law(LIMITED, ("limit", "damping", "forward")),
    "limited, a changed goal restarts at measured position and speed": Law(RESTART_MOVING),
    "limited, a write restarts at measured position and speed": Law(RESTART_MOVING, on_write=True),
    "limited, a changed goal restarts at measured position, at rest": Law(RESTART_AT_REST),
    "limited, a changed goal restarts the set-point at rest": Law(KEEP_AT_REST),
    "limited, a changed goal restarts at measured position, same rate": Law(KEEP_SPEED),
    "only braking is limited": Law(BRAKING),
    "only speeding up is limited": Law(SPEEDING_UP),
    "limited, but not from rest": Law(FROM_REST),
    "limited, but not beyond a distance": Law(FAR, ("limit", "distance")),
    "limited in all recordings but PRBS": Law(LIMITED, free=("prbs_excitation",)),
    "the same, and a later start in PRBS": Law(
        LIMITED, ("limit", "later in PRBS"), free=("prbs_excitation",)
    ),
    "a limit for each recording": Law(LIMITED, ("limit", "limit of PRBS", "limit of steps")),
}
BASE = {
    "dead time": (0.012, 1e-3, 0.06), "stiffness": (300, 30, 1e4), "stall": (120, 20, 3000),
    "speed": (4.5, 1.5, 60), "friction": (3, 1e-2, 100), "load friction": (0.1, 1e-3, 0.9),
}  # fmt: skip
"""Start and bounds of logarithmic parameters, per inertia."""
MORE = {
    "limit": (40, 15, 4000), "limit of PRBS": (1000, 15, 4000), "limit of steps": (100, 15, 4000),
    "damping": (5, 1e-2, 500), "forward": (0.7, 0.05, 3), "distance": (0.1, 0.005, 0.3),
    "later in PRBS": (0.015, 1e-3, 0.05),
}  # fmt: skip
LINEAR = {"offset": (0.0, -0.1, 0.1), "sine": (0.0, -100, 100), "cosine": (0.0, -100, 100)}


@njit(cache=True)
def _simulate(p, command, changed, start, law, out):
    """Positions of the servo after each step; `p` as `_vector` makes it."""
    dead, stiff, stall, speed, rub, rub_motor, limit, damping, forward, far_off = p[:10]
    offset, sine, cosine = p[10], p[11], p[12]
    y, v, s, rate = start - offset, 0.0, command[0], 0.0
    whole = int(dead)
    part, pad = dead - whole, len(command) - len(out) + 1
    out[0] = start
    for k in range(len(out) - 1):
        at = k + pad - whole
        c = command[at] * (1 - part) + command[at - 1] * part
        if law == AT_ONCE or limit >= 5e3:
            rate, s = (c - s) / STEP_S, c
        else:
            if changed[at]:
                if law in (RESTART_MOVING, RESTART_AT_REST, KEEP_SPEED):
                    s = y
                if law == RESTART_MOVING:
                    rate = v
                elif law in (RESTART_AT_REST, KEEP_AT_REST):
                    rate = 0.0
            way = c - s
            furthest = np.sqrt(2 * limit * abs(way))
            direct = way / STEP_S
            wanted = min(max(direct, -furthest), furthest)
            change = min(max(wanted - rate, -limit * STEP_S), limit * STEP_S)
            same = wanted * rate >= 0
            if law == BRAKING and (
                (same and abs(wanted) >= abs(rate)) or abs(rate) <= limit * STEP_S
            ):
                change = wanted - rate
            elif law == SPEEDING_UP and (not same or abs(wanted) < abs(rate)):
                change = wanted - rate if same else -rate
            elif (law == FROM_REST and changed[at] and abs(rate) < 1e-9) or (
                law == FAR and abs(way) > far_off
            ):
                change = direct - rate
            rate += change
            s += rate * STEP_S
        wanted_duty = (stiff * (s - y) + damping * (forward * rate - v)) / stall
        duty = min(max(wanted_duty, -1.0), 1.0)
        motor = stall * duty - stall / speed * v
        force = motor - sine * np.sin(y) - cosine * np.cos(y)
        most = rub + rub_motor * abs(motor)
        force += min(max(-(v / STEP_S + force), -most), most)
        inside = damping if duty == wanted_duty else 0.0
        v += force * STEP_S / (1 + STEP_S * (stall / speed + inside))
        y += v * STEP_S
        out[k + 1] = y + offset


def names(law: Law) -> list[str]:
    """Fitted parameters."""
    return [*BASE, *law.fitted, *LINEAR]


def _vector(law: Law, x: np.ndarray, motion: str) -> np.ndarray:
    own = {n: v if n in LINEAR else float(np.exp(v)) for n, v in zip(names(law), x, strict=True)}
    limit = own.get("limit", NO_LIMIT)
    limit = NO_LIMIT if motion in law.free else limit
    if "limit of PRBS" in own:
        limit = {
            "prbs_excitation": own["limit of PRBS"],
            "step_response": own["limit of steps"],
        }.get(motion, limit)
    late = own.get("later in PRBS", 0.0) if motion == "prbs_excitation" else 0.0
    return np.array([
        (own["dead time"] + late) / STEP_S, own["stiffness"], own["stall"], own["speed"],
        own["friction"], own["load friction"], limit, own.get("damping", 0.0),
        own.get("forward", 0.0), own.get("distance", np.inf), own["offset"], own["sine"],
        own["cosine"],
    ])  # fmt: skip


def errors(law: Law, x: np.ndarray, motion: str, run: Run, changed: np.ndarray) -> np.ndarray:
    """Model minus readings [rad]."""
    out = np.empty(run.held.shape[1] - run.rest + 1)
    _simulate(_vector(law, x, motion), run.held[0], changed, run.start_rad, law.number, out)
    return np.interp(run.sample_step, np.arange(len(out)), out) - run.sample_rad


def fit(
    law: Law,
    runs: dict[str, Run],
    starts: int,
    rng: np.random.Generator,
    parts: Sequence[tuple[str, float, float]] = FITTED,
) -> np.ndarray:
    """Least squares over `parts`, each with the same weight, from a few starts."""
    goals = {m: _goals(r, law.on_write) for m, r in runs.items()}

    def left(x: np.ndarray) -> np.ndarray:
        found = []
        for motion, run in runs.items():
            if not any(own == motion for own, _, _ in parts):
                continue
            error = errors(law, x, motion, run, goals[motion])
            time = run.sample_step * run.step_s
            for own, begin, end in parts:
                if own == motion:
                    part = error[(time >= begin) & (time < end)]
                    found.append(30 * part / NOISE_RAD / np.sqrt(len(part)))
        return np.clip(np.nan_to_num(np.concatenate(found), nan=1e4), -1e4, 1e4)

    table = BASE | {n: MORE[n] for n in law.fitted}
    nominal, low, high = np.log(np.array(list(table.values()), float)).T
    ends = np.array(list(LINEAR.values()), float).T
    nominal, low, high = (np.append(a, b) for a, b in zip((nominal, low, high), ends, strict=True))
    spread = np.append(np.full(len(table), 0.5), [0.002, 15.0, 15.0])
    best = None
    for n in range(starts):
        x0 = nominal + (n > 0) * spread * rng.standard_normal(len(nominal))
        x0 = np.clip(x0, low + 1e-6, high - 1e-6)
        found = least_squares(
            left, x0, bounds=(low, high), loss="soft_l1", max_nfev=80, diff_step=1e-4, x_scale="jac"
        )
        best = found if best is None or found.cost < best.cost else best
    assert best is not None
    return best.x


def _goals(run: Run, every_write: bool) -> np.ndarray:
    """Steps at which a goal is written, or at which it changes."""
    command = run.held[0]
    changed = np.append(False, np.abs(np.diff(command)) > 1e-9)
    if not every_write:
        return changed
    written = np.zeros(len(command), bool)
    written[run.rest :: round(0.02 / STEP_S)] = True
    return written


def part_error(law: Law, x: np.ndarray, run: Run, part: tuple[str, float, float]) -> float:
    """RMS error of a part of a recording [mrad]."""
    motion, begin, end = part
    error = errors(law, x, motion, run, _goals(run, law.on_write))
    now = run.sample_step * run.step_s
    return 1e3 * float(np.sqrt(np.mean(error[(now >= begin) & (now < end)] ** 2)))


def alone(joint: str, runs: dict[str, Run], starts: int, seed: int) -> None:
    """Dead time of each part of the recordings, fitted alone."""
    for name, part in PARTS.items():
        said = []
        for law in ("the command at once", "limited acceleration (sqrt braking), one limit"):
            x = fit(LAWS[law], runs, starts, np.random.default_rng(seed), (part,))
            error = part_error(LAWS[law], x, runs[part[0]], part)
            said.append(f"{law}: {1e3 * np.exp(x[0]):.1f} ms (error {error:.1f} mrad)")
        print(f"  {joint}, {name}: {'; '.join(said)}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--joints", nargs="+", choices=JOINTS, default=JOINTS)
    parser.add_argument("--alone", action="store_true", help="each recording alone")
    parser.add_argument("--starts", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    rows: dict[str, list[list[float]]] = {name: [] for name in LAWS}
    extras: dict[str, list[list[float]]] = {name: [] for name in LAWS}
    begun = time.process_time()
    for joint in asked.joints:
        trials = {m: load(REAL / "sage_so101" / m).trials(joint)[0] for m in MOTIONS}
        lattice = find_poll_lattice(tuple(trials.values()), np.random.default_rng(0))
        runs = {m: r for m, t in trials.items() if (r := prepare(t, lattice)) is not None}
        if asked.alone:
            alone(joint, runs, asked.starts, asked.seed)
            continue
        for name, law in LAWS.items():
            x = fit(law, runs, asked.starts, np.random.default_rng(asked.seed))
            row = [part_error(law, x, runs[part[0]], part) for part in PARTS.values()]
            rows[name].append(row)
            extras[name].append([float(np.exp(x[names(law).index(n)])) for n in law.fitted])
            print(f"  {joint}, {name}: {' '.join(f'{v:.1f}' for v in row)}", flush=True)
    if not asked.alone:
        print(f"| law | {' | '.join(PARTS)} | fitted, range over joints |")
        print(f"|---{'|---' * (len(PARTS) + 1)}|")
        for name, each in rows.items():
            mean = " | ".join(f"{v:.1f}" for v in np.mean(each, axis=0))
            low, high = np.min(extras[name], axis=0), np.max(extras[name], axis=0)
            own = ", ".join(
                f"{n} {a:.3g}–{b:.3g}" for n, a, b in zip(LAWS[name].fitted, low, high, strict=True)
            )
            print(f"| {name} | {mean} | {own or 'none'} |")
    print(f"{time.process_time() - begun:.0f} s of processor time")


if __name__ == "__main__":
    main()
