"""Published models of the STS3215 and our own on unseen motions of an SO-101 arm.

    .venv/bin/python benchmarks/which_sts3215.py

Prints the tables of docs/which_sts3215.md, and writes them into it, into which_sts3215.json beside
this file, and as docs/pictures/which_sts3215.png. Recordings (isaac-sim2real/sage, Apache-2.0) are
found through PUPPER_REAL_DATA, else in ../shared/real.

Every model is a servo card. It runs freely from the first reading on, at the recordings' P gain
where the card knows its own, at the card's supply voltage, and with the arm as its load: inertia
and gravity of each joint, which no recording states, and the offset are fitted to the first 40 s of
three motions, for every model alike. Scored is what was not fitted: the rest of these, and
`frequency_sweep`. The limit on the set-point's acceleration, which our card has, may be another in
the PRBS: the share that suits its first 40 s best.

What is wrong with a model is asked in three ways: what the best shift in time and the best gain
leave of its error; which lag per speed and which dead band it shows in slow motion, beside the
robot's; and how its error changes when one term is exchanged for ours. Terms are compared per
stiffness (inertia, damping, friction and largest torque over stiffness), which needs no scale of
torques.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from real_recordings import FITTED_S, HERE, JOINTS, MOTIONS, REAL, first
from scipy.optimize import least_squares

from pupper_sysid.servo_models.cards.card import ServoCard
from pupper_sysid.servo_models.cards.files import load_card
from pupper_sysid.servo_models.delayed_pd import FRICTION_IMPEDANCE
from pupper_sysid.servo_models.loaded_servo import COLUMNS
from pupper_sysid.sysid.compare.under_load import slewed
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice, find_poll_lattice
from pupper_sysid.sysid.loaded import kernel
from pupper_sysid.sysid.loaded.kernel import OFFSET, WIDTH
from pupper_sysid.sysid.loaded.runs import RAMP_SHARES, Run, at_steps, prepare, simulate
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Trial

PAGE = HERE.parent / "docs" / "which_sts3215.md"
PICTURE = HERE.parent / "docs" / "pictures" / "which_sts3215.png"
FILE = HERE / "which_sts3215.json"
OURS = "pupper-sysid"
MODELS = {
    "BAM M6": "sts3215-bam-m6",
    "K-Scale M1": "sts3215-kscale-m1",
    "SO-ARM100": "sts3215-soarm100",
    "Open Duck": "sts3215-open-duck",
    "AnchorBench": "sts3215-anchorbench",
    OURS: "sts3215-12v",
}
"""Cards by their name in tables."""
SPECIMENS = {
    "Rotation": "shoulder_pan", "Pitch": "shoulder_lift", "Elbow": "elbow_flex",
    "Wrist_Pitch": "wrist_flex", "Wrist_Roll": "wrist_roll",
}  # fmt: skip
"""Our recordings' joints in a card that names them as LeRobot does."""
P_GAIN = 16.0
SLOW_UNTIL_S = 60.0
"""Up to where `frequency_sweep` is below 0.6 Hz."""
SHOWN = "Wrist_Roll"
"""Joint of the picture's jump."""
DUTY, DUTY_S, STALL, EMF, ARMATURE, DRY = range(6)
RAMP = COLUMNS.index("acceleration_limit")
TORQUE_LIMIT = COLUMNS.index("torque_limit")
QUADRATIC = COLUMNS.index("load_friction_quadratic")
OTHER_RAMP = "prbs_excitation"
"""Where the set-point's acceleration has another limit, as whole recordings show."""
TITLES = {
    "frequency_sweep": "frequency sweep", "prbs_excitation": "PRBS after 40 s",
    "step_response": "steps after 40 s", "chirp_sweep": "chirp after 40 s",
}  # fmt: skip
COLOURS = ("#4477aa", "#66ccee", "#ccbb44", "#ee6677", "#aa3377", "#228833")
TERMS = ("stiffness", "inertia", "damping", "friction", "largest torque", "dead time", "ramp")


@dataclass(frozen=True)
class Model:
    """A servo with its load, as the kernel takes it.

    Attributes
    ----------
    row : ndarray, shape (WIDTH,)
        Columns of the kernel; gravity, hanging position and offset are the arm's.
    dead_time_s, p_gain, slew_rad_s : float
    """

    row: np.ndarray
    dead_time_s: float
    p_gain: float
    slew_rad_s: float

    @property
    def stiffness(self) -> float:
        """[N·m/rad]."""
        return float(self.row[DUTY] * self.p_gain * self.row[STALL])

    def on(self, run: Run) -> Run:
        """A run as this model moves it: its own P gain and rate of the set-point."""
        held = run.held
        if np.isfinite(self.slew_rad_s):
            held = held.copy()
            held[0] = slewed(held[0], self.slew_rad_s * run.step_s, float(held[0, 0]))
        return replace(run, p_gain=self.p_gain, held=held)

    def track(self, run: Run) -> np.ndarray:
        """Positions at the edges of the steps [rad]."""
        return simulate(self.row[None], np.array([self.dead_time_s]), self.on(run))[:, 0]


def card_model(name: str, joint: str) -> Model:
    """A card's numbers for one joint, without a load."""
    card = load_card(name)
    specimen = next((s for s in (joint, SPECIMENS[joint]) if s in card.specimens), card.default)
    servo, gain = card.loaded(specimen)
    numbers = card.specimens[specimen]
    values, row = servo.arrays(), np.zeros(WIDTH)
    row[: len(COLUMNS)] = [float(values[column]) for column in COLUMNS]
    slew = getattr(numbers, "velocity_limit_rad_s", None)
    return Model(
        row, float(values["dead_time_s"]),
        gain if numbers.model == "delayed_pd" else P_GAIN,
        np.inf if slew is None else slew.value,
    )  # fmt: skip


def with_load(
    model: Model,
    runs: Sequence[Run],
    inertia: bool = True,
    stiffness: bool = False,
    starts: int = 3,
) -> Model:
    """The model with gravity, offset and by choice inertia of the arm, fitted to runs.

    Parameters
    ----------
    inertia : bool
        Whether inertia is added to the armature.
    stiffness : bool
        Whether the stiffness is fitted, too.
    """
    factors = [name for name, on in (("inertia", inertia), ("stiffness", stiffness)) if on]
    scale = max(0.2, float(model.row[OFFSET - 2]))
    moved = [model.on(r) for r in runs]

    def models(x: np.ndarray) -> np.ndarray:
        rows = np.repeat(model.row[None], len(x), axis=0)
        rows[:, OFFSET - 2] = np.hypot(x[:, 0], x[:, 1]) * scale
        rows[:, OFFSET - 1] = np.arctan2(x[:, 1], x[:, 0])
        rows[:, OFFSET] = 0.05 * x[:, 2]
        for n, name in enumerate(factors, 3):
            if name == "inertia":
                rows[:, ARMATURE] += np.exp(np.clip(x[:, n], -12, 2))
            else:
                rows[:, DUTY] *= np.exp(np.clip(x[:, n], -9, 3))
        return rows

    def left(x: np.ndarray) -> np.ndarray:
        rows, found = models(x), []
        for run in moved:
            out = np.empty((len(rows), len(run.sample_step)))
            steps = np.full(len(rows), model.dead_time_s / run.step_s)
            kernel.residuals(
                rows, steps, run.held, run.p_gain, run.load, run.ramp_share, run.start_rad,
                run.sample_step, run.sample_rad, run.rest, run.step_s, -FRICTION_IMPEDANCE, out,
            )  # fmt: skip
            found.append(out)
        return np.concatenate(found, axis=1) / 0.005

    def jacobian(x: np.ndarray) -> np.ndarray:
        step = 1e-3 * np.eye(len(x))
        both = left(np.concatenate([x + step, x - step]))
        return ((both[: len(x)] - both[len(x) :]) / 2e-3).T

    own = model.row
    gravity = own[OFFSET - 2] / scale, own[OFFSET - 1], own[OFFSET] / 0.05
    base = [gravity[0] * np.cos(gravity[1]), gravity[0] * np.sin(gravity[1]), gravity[2]]
    first_guess = {"inertia": (-9.0, -6.0, -4.0), "stiffness": (0.0, -1.5, -3.0)}
    best = None
    for n in range(starts):
        x0 = np.array(base + [first_guess[name][n] for name in factors])
        found = least_squares(
            lambda x: left(x[None])[0],
            x0,
            jac=jacobian,  # pyright: ignore[reportArgumentType]
            loss="soft_l1",
            max_nfev=25,
            x_scale="jac",
        )
        best = found if best is None or found.cost < best.cost else best
    assert best is not None
    return replace(model, row=models(best.x[None])[0])


def exchanged(model: Model, ours: Model, term: str) -> Model:
    """The model with one of our terms, per stiffness."""
    if term == "dead time":
        return replace(model, dead_time_s=ours.dead_time_s, slew_rad_s=np.inf)
    row, own, share = model.row.copy(), ours.row, model.stiffness / ours.stiffness
    inside = row[DUTY_S] * row[STALL]
    if term == "ramp":
        row[RAMP] = own[RAMP]
    elif term == "inertia":
        row[ARMATURE] = own[ARMATURE] * share
    elif term == "damping":
        row[DUTY_S] = own[DUTY_S] * own[STALL] * share / row[STALL]
        row[EMF] = own[EMF] * share
    elif term == "friction":
        torques = (DRY, COLUMNS.index("stribeck_friction"))
        plain = (
            "stribeck_speed", "load_friction_motor", "load_friction_load", "load_friction_static",
            "dead_zone_rad", "start_duty",
        )  # fmt: skip
        row[list(torques)] = own[list(torques)] * share
        same = [COLUMNS.index(name) for name in plain]
        row[same] = own[same]
        row[QUADRATIC] = own[QUADRATIC] / share
        row[OFFSET - 2 : OFFSET] = own[OFFSET - 2] * share, own[OFFSET - 1]  # it rubs with the load
    elif term == "largest torque":
        stiffness = model.stiffness
        row[STALL], row[TORQUE_LIMIT] = own[STALL] * share, own[TORQUE_LIMIT] * share
        row[DUTY], row[DUTY_S] = stiffness / (model.p_gain * row[STALL]), inside / row[STALL]
    return replace(model, row=row)


def rms(values: np.ndarray) -> float:
    return 1e3 * float(np.sqrt(np.nanmean(values**2)))


def scored(run: Run, motion: str) -> np.ndarray:
    """Rows that no model was fitted to, nor its load."""
    late = run.row_step * run.step_s > FITTED_S
    return np.isfinite(run.row_rad) & (late | (motion == MOTIONS[3]))


def score(model: Model, runs: Mapping[str, Run]) -> dict[str, float]:
    """RMS error by motion [mrad], of rows that no one fitted."""
    found = {}
    for motion, run in runs.items():
        error = at_steps(model.track(run), run.row_step) - run.row_rad
        found[motion] = rms(error[scored(run, motion)])
    return found


def delayed_and_scaled(model: Model, run: Run) -> tuple[float, float, float, float]:
    """Best shift [ms] and the error after it [mrad], then best gain, and the error after both."""
    track, reading = model.track(run), run.row_rad
    shifts = np.arange(-0.15, 0.1501, 0.001)
    errors = [rms(at_steps(track, run.row_step - s / run.step_s) - reading) for s in shifts]
    best = int(np.argmin(errors))
    moved = at_steps(track, run.row_step - shifts[best] / run.step_s)
    gain, offset = np.polyfit(moved, reading, 1)
    return 1e3 * shifts[best], errors[best], float(gain), rms(gain * moved + offset - reading)


def slow_motion(run: Run, position: np.ndarray) -> tuple[float, float]:
    """Lag per speed [ms] and dead band [mrad] of the slow part of `frequency_sweep`.

    Regression of the command less the position on the command's speed and its sign, position and a
    constant, below 0.6 Hz, where inertia hardly counts.
    """
    time = run.row_step * run.step_s
    command, width = _command(run), 25
    smooth = np.convolve(np.pad(command, width, mode="edge"), np.full(width, 1 / width), "same")
    speed = np.gradient(smooth[width:-width], time)
    use = (time > 5) & (time < SLOW_UNTIL_S) & (np.abs(speed) > 0.01)
    design = np.column_stack([speed, np.sign(speed), command, np.ones(len(time))])[use]
    found = np.linalg.lstsq(design, (command - position)[use], rcond=None)[0]
    return 1e3 * float(found[0]), 1e3 * float(found[1])


def evaluate(joint: str) -> dict:
    """All figures of one joint."""
    trials = {m: load(REAL / "sage_so101" / m).trials(joint)[0] for m in MOTIONS}
    lattice = find_poll_lattice(tuple(trials.values()), np.random.default_rng(0))
    runs = {m: _run(t, lattice) for m, t in trials.items()}
    early = {m: _run(first(trials[m]), lattice) for m in MOTIONS[:3]}
    bare = {name: card_model(card, joint) for name, card in MODELS.items()}
    share = ramp_share(bare[OURS], early)
    for found in (early, runs):
        found[OTHER_RAMP] = replace(found[OTHER_RAMP], ramp_share=share)
    fitted = list(early.values())
    loaded = {name: with_load(model, fitted) for name, model in bare.items()}
    ours, sweep = loaded[OURS], runs[MOTIONS[3]]
    still = {m: rms((_command(r) - r.row_rad)[scored(r, m)]) for m, r in runs.items()}
    models = {name: described(model, runs) for name, model in loaded.items()}
    for name, model in loaded.items():
        if name != OURS:
            models[name]["terms"] = terms(model, bare[name], ours, fitted, runs)
    free = np.where(np.arange(WIDTH) == RAMP, np.inf, bare[OURS].row)
    return {
        "command": still,
        "robot": slow_motion(sweep, sweep.row_rad),
        "without ramp": score(with_load(replace(bare[OURS], row=free), fitted), runs),
        "models": models,
        "jump": jump(loaded, runs["prbs_excitation"]) if joint == SHOWN else None,
    }


def ramp_share(model: Model, early: Mapping[str, Run]) -> float:
    """Limit of `OTHER_RAMP` over that of the model which leaves the least of the fitted part."""
    left = []
    for share in RAMP_SHARES:
        own = {**early, OTHER_RAMP: replace(early[OTHER_RAMP], ramp_share=share)}
        fitted = with_load(model, list(own.values()), starts=1)
        run = own[OTHER_RAMP]
        left.append(rms(at_steps(fitted.track(run), run.row_step) - run.row_rad))
    return RAMP_SHARES[int(np.argmin(left))]


def described(model: Model, runs: Mapping[str, Run]) -> dict:
    """Errors of one model, and what they consist of."""
    sweep = runs[MOTIONS[3]]
    return {
        "errors": score(model, runs),
        "shift": delayed_and_scaled(model, sweep),
        "slow": slow_motion(sweep, at_steps(model.track(sweep), sweep.row_step)),
        "dead time": 1e3 * model.dead_time_s,
        "stiffness": model.stiffness,
    }


def terms(
    model: Model, bare: Model, ours: Model, fitted: Sequence[Run], runs: Mapping[str, Run]
) -> dict:
    """Errors with one term exchanged, the load fitted again; and the stiffness fitted to it."""
    found = {}
    for term in TERMS:
        changed = exchanged(model, ours, term)
        if term == "inertia":
            changed = with_load(changed, fitted, inertia=False, starts=1)
        else:
            row = changed.row.copy()
            row[ARMATURE] = bare.row[ARMATURE]
            changed = with_load(replace(changed, row=row), fitted, stiffness=term == "stiffness")
        found[term] = score(changed, runs)
        if term == "stiffness":
            found["best stiffness"] = changed.stiffness
    return found


def jump(models: Mapping[str, Model], run: Run) -> dict:
    """One jump that no one fitted: times [s], command, reading and models [rad]."""
    command, time = _command(run), run.row_step * run.step_s
    edges = np.flatnonzero(np.abs(np.diff(command)) > 0.1)
    quiet = [k for k in edges if time[k] > FITTED_S and np.sum(np.abs(edges - k) < 30) == 1]
    rows = slice(quiet[0] - 3, quiet[0] + 22)
    found = {"time": time[rows] - time[quiet[0] + 1], "command": command[rows]}
    found["reading"] = run.row_rad[rows]
    found["models"] = {
        name: at_steps(m.track(run), run.row_step)[rows].tolist() for name, m in models.items()
    }
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in found.items()}


def _run(trial: Trial, lattice: PollLattice) -> Run:
    run = prepare(trial, lattice)
    assert run is not None
    return run


def _command(run: Run) -> np.ndarray:
    """Command at the time of each row."""
    command = run.held[0, run.rest :]
    return command[np.minimum(run.row_step.astype(int), len(command) - 1)]


def _plain(value: object) -> object:
    """Numbers to three decimals, for the file."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return round(float(value), 3) if isinstance(value, float | np.floating) else value


# ---------------------------------------------------------------------------- tables and page


def publish(found: dict[str, Any], write: bool = True) -> None:
    """Print the tables and, if asked, write file, page and picture."""
    made = {name: table(found["joints"]) for name, table in TABLES.items()}
    for lines in made.values():
        print("\n".join(lines), end="\n\n")
    if not write:
        return
    FILE.write_text(json.dumps(found | {"tables": made}, indent=1) + "\n")
    picture(found["joints"])
    text = PAGE.read_text()
    for name, lines in made.items():
        text = filled(text, name, lines)
    PAGE.write_text(text)


def numbers_hash(card: ServoCard) -> str:
    """SHA-256 of a card's numbers."""
    numbers = card.model_dump(mode="json")["specimens"]
    return hashlib.sha256(json.dumps(numbers, sort_keys=True).encode()).hexdigest()


def filled(page: str, name: str, lines: list[str]) -> str:
    """A page with the table between its two marks replaced."""
    begin, end = f"<!-- table {name} -->\n", "<!-- end -->"
    before, rest = page.split(begin)
    return f"{before}{begin}\n" + "\n".join(lines) + f"\n\n{end}" + rest.split(end, 1)[1]


def mean(joints: Mapping[str, Any], pick: Callable[[Any], Any]) -> np.ndarray:
    """Mean of something over joints."""
    return np.mean([pick(j) for j in joints.values()], axis=0)


def by_motion(joints: Mapping[str, Any], pick: Callable[[Any], Mapping[str, float]]) -> np.ndarray:
    """Mean over joints of the errors of each motion."""
    return mean(joints, lambda j: [pick(j)[m] for m in TITLES])


def _lines(head: list[str], rows: list[list[str]]) -> list[str]:
    return [f"| {' | '.join(r)} |" for r in (head, ["---"] * len(head), *rows)]


def _models(joints: Mapping[str, Any]) -> list[str]:
    return list(next(iter(joints.values()))["models"])


def errors(joints: Mapping[str, Any]) -> list[str]:
    """Error of each model on each motion, mean of joints."""
    rows = [("the command itself", by_motion(joints, lambda j: j["command"]))]
    for name in _models(joints):
        rows.append((name, by_motion(joints, lambda j, n=name: j["models"][n]["errors"])))
    rows.append((f"{OURS}, set-point not limited", by_motion(joints, lambda j: j["without ramp"])))
    return _lines(
        ["RMS, mrad", *TITLES.values(), "mean"],
        [[name, *(f"{v:.1f}" for v in own), f"{np.mean(own):.1f}"] for name, own in rows],
    )


def by_joint(joints: Mapping[str, Any]) -> list[str]:
    """Error of each model on `frequency_sweep`, by joint."""
    rows = []
    for name in _models(joints):
        own = [j["models"][name]["errors"]["frequency_sweep"] for j in joints.values()]
        rows.append([name, *(f"{v:.1f}" for v in own)])
    return _lines(["frequency sweep, RMS, mrad", *joints], rows)


def slow(joints: Mapping[str, Any]) -> list[str]:
    """Lag per speed and dead band in slow motion, dead time; shift and gain on the whole sweep."""
    lag, band = mean(joints, lambda j: j["robot"])
    rows = [["the robot", f"{lag:.0f}", f"{band:.1f}", *["–"] * 4]]
    for name in _models(joints):
        lag, band = mean(joints, lambda j, n=name: j["models"][n]["slow"])
        shift, shifted, gain, both = mean(joints, lambda j, n=name: j["models"][n]["shift"])
        dead = mean(joints, lambda j, n=name: j["models"][n]["dead time"])
        whole = mean(joints, lambda j, n=name: j["models"][n]["errors"]["frequency_sweep"])
        rows.append(
            [name, f"{lag:.0f}", f"{band:.1f}", f"{dead:.0f}", f"{whole:.1f}",
             f"{shifted:.1f} ({shift:+.0f} ms)", f"{both:.1f} ({gain:.2f})"]
        )  # fmt: skip
    return _lines(
        ["", "lag per speed, ms", "dead band, mrad", "dead time, ms", "error, mrad",
         "best shift", "and best gain"],
        rows,
    )  # fmt: skip


def exchange(joints: Mapping[str, Any]) -> list[str]:
    """Mean error with one term exchanged for ours."""
    names = [n for n in _models(joints) if n != OURS]
    terms = [t for t in next(iter(joints.values()))["models"][names[0]]["terms"] if "best" not in t]
    rows = []
    for name in names:
        own = [float(np.mean(by_motion(joints, lambda j, n=name: j["models"][n]["errors"])))]
        for term in terms:
            found = by_motion(joints, lambda j, n=name, t=term: j["models"][n]["terms"][t])
            own.append(float(np.mean(found)))
        ratio = mean(
            joints,
            lambda j, n=name: np.log(
                j["models"][n]["terms"]["best stiffness"] / j["models"][n]["stiffness"]
            ),
        )
        rows.append([name, *(f"{v:.1f}" for v in own), f"{np.exp(ratio):.2f}"])
    heads = ["stiffness fitted" if t == "stiffness" else t for t in terms]
    return _lines(["mean error, mrad", "as published", *heads, "best stiffness over its own"], rows)


TABLES: dict[str, Callable[[Mapping[str, Any]], list[str]]] = {
    "errors": errors, "joints": by_joint, "slow": slow, "exchange": exchange,
}  # fmt: skip


def picture(joints: Mapping[str, Any]) -> None:
    """Errors by motion, slow motion, and one jump."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(11, 4.2), layout="constrained")
    first, second, third = drawn.subplots(1, 3)
    names = _models(joints)
    for n, (name, colour) in enumerate(zip(names, COLOURS, strict=True)):
        own = by_motion(joints, lambda j, m=name: j["models"][m]["errors"])
        first.plot(own, np.arange(len(TITLES)) + 0.08 * (n - 2.5), "o", color=colour, label=name)
        lags = np.array([j["models"][name]["slow"] for j in joints.values()])
        second.plot(*lags.T, "o", color=colour, ms=5)
    second.plot(*np.array([j["robot"] for j in joints.values()]).T, "k+", ms=10, label="robot")
    first.set_xscale("log")
    first.set_xticks([5, 10, 20, 50], ["5", "10", "20", "50"])
    first.minorticks_off()
    first.set_yticks(range(len(TITLES)), list(TITLES.values()))
    first.invert_yaxis()
    first.set_xlabel("RMS error, mean of joints [mrad]")
    first.grid(axis="x", which="both", lw=0.3)
    second.set_xlabel("lag per speed in slow motion [ms]")
    second.set_ylabel("dead band [mrad]")
    second.legend(fontsize="small")
    jump = next(j["jump"] for j in joints.values() if j["jump"])
    time = 1e3 * np.array(jump["time"])
    third.step(time, jump["command"], color="0.6", where="post", label="command")
    for name, colour in zip(names, COLOURS, strict=True):
        third.plot(time, jump["models"][name], color=colour, lw=1.2)
    third.plot(time, jump["reading"], "k+", ms=6, label="readings")
    third.set_xlabel("time after a jump of the wrist roll [ms]")
    third.set_ylabel("position [rad]")
    third.legend(fontsize="small")
    drawn.legend(
        *first.get_legend_handles_labels(), loc="outside lower center", ncols=len(names),
        fontsize="small",
    )  # fmt: skip
    drawn.savefig(PICTURE, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--joints", nargs="+", choices=JOINTS, default=JOINTS)
    parser.add_argument("--print-only", action="store_true", help="write no files")
    options = parser.parse_args()
    found = {}
    for joint in options.joints:
        begun = time.process_time()
        found[joint] = _plain(evaluate(joint))
        print(f"{joint}: {time.process_time() - begun:.0f} s of processor time", flush=True)
    inputs = {m: load(REAL / "sage_so101" / m).sha256 for m in MOTIONS}
    cards = {card: numbers_hash(load_card(card)) for card in MODELS.values()}
    publish({"recordings": inputs, "cards": cards, "joints": found}, write=not options.print_only)


if __name__ == "__main__":
    main()
