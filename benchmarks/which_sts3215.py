"""Published models of the STS3215 and our own on unseen motions of an SO-101 arm.

    .venv/bin/python benchmarks/which_sts3215.py

Prints the tables of docs/which_sts3215.md, and writes them into it, into which_sts3215.json beside
this file, and as docs/pictures/which_sts3215.png. Recordings (isaac-sim2real/sage, Apache-2.0) are
found through PUPPER_REAL_DATA, else in ../shared/real.

Every model is a servo card. It runs freely from the first reading on, at the recordings' P gain
where the card knows its own, at the card's supply voltage, and with the arm as its load: inertia
and gravity of each joint, which no recording states, and the offset are fitted to the first 40 s of
three motions, for every model alike. Scored is what was not fitted: the rest of these, and
`frequency_sweep`. The limit on the set-point's acceleration is the card's, in every motion.

What is wrong with a model is asked in three ways: what the best shift in time and the best gain
leave of its error; which lag per speed and which dead band it shows in slow motion, beside the
robot's; and how its error changes when one term is exchanged for ours. Terms are compared per
stiffness (inertia, damping, friction and largest torque over stiffness), which needs no scale of
torques.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from shared import REAL, ROOT  # isort: skip

import numpy as np
import tyro
from real_recordings import FITTED_S, JOINTS, MOTIONS, first

from pupper_sysid.servo_models.cards.card import ServoCard
from pupper_sysid.servo_models.cards.files import load_card
from pupper_sysid.servo_models.kernel import COLUMNS
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice, find_poll_lattice
from pupper_sysid.sysid.fit.run import Run, at_steps, prepare, simulate
from pupper_sysid.sysid.fit.search import Problem, evolve, local
from pupper_sysid.sysid.fit.structure import Parameter, Structure, loaded_columns
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Trial

PAGE = ROOT / "docs/which_sts3215.md"
PICTURE = ROOT / "docs/pictures/which_sts3215.png"
FILE = ROOT / "benchmarks/which_sts3215.json"
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
AT = {name: place for place, name in enumerate(COLUMNS)}
NOISE_RAD, ITERATIONS, DIFFERENCE = 0.005, 25, 0.005
"""Where the loss of the arm's fit bends, and its local fit."""
GRAVITY_NM = 50.0
"""Unit of the gravity: the local fit moves what is no logarithm by 0.02 in a step, so 1 N·m."""
LEAST_DEAD_TIME_S = 1e-4
"""For cards without one: the fits of the engine take its logarithm."""
TITLES = {
    "frequency_sweep": "frequency sweep", "prbs_excitation": "PRBS after 40 s",
    "step_response": "steps after 40 s", "chirp_sweep": "chirp after 40 s",
}  # fmt: skip
COLOURS = ("#4477aa", "#66ccee", "#ccbb44", "#ee6677", "#aa3377", "#228833")
TERMS = ("stiffness", "inertia", "damping", "friction", "largest torque", "dead time", "ramp")


@dataclass(frozen=True)
class Model:
    """A servo with its load at the P gain of the recordings.

    `columns` are those of `servo_models.kernel.COLUMNS`, the stiffness in N·m/rad.
    """

    columns: np.ndarray
    dead_time_s: float

    @property
    def stiffness(self) -> float:
        """[N·m/rad]."""
        return float(self.columns[AT["stiffness"]])

    def changed(self, **values: float) -> Model:
        """The model with other values in some columns."""
        columns = self.columns.copy()
        for name, value in values.items():
            columns[AT[name]] = value
        return replace(self, columns=columns)

    def track(self, run: Run) -> np.ndarray:
        """Positions at the edges of the steps [rad]."""
        return simulate(self.columns[None], np.array([self.dead_time_s]), run)[:, 0]


def card_model(name: str, joint: str) -> Model:
    """A card's numbers for one joint, without a load."""
    card = load_card(name)
    specimen = next((s for s in (joint, SPECIMENS[joint]) if s in card.specimens), card.default)
    servo, own_gain = card.loaded(specimen)
    numbers = card.specimens[specimen]
    gain = own_gain if numbers.model == "delayed_pd" else P_GAIN
    dead_time_s = max(float(np.asarray(servo.dead_time_s)), LEAST_DEAD_TIME_S)
    model = Model(loaded_columns(servo), dead_time_s)
    slowest = getattr(numbers, "velocity_limit_rad_s", None)
    limit = np.inf if slowest is None else slowest.value
    return model.changed(stiffness=gain * model.stiffness, velocity_limit=limit)


def with_load(
    model: Model,
    runs: Sequence[Run],
    inertia: bool = True,
    stiffness: bool = False,
    starts: int = 3,
) -> Model:
    """The model with gravity, offset and by choice inertia of the arm, fitted to runs.

    The fit starts from the model's gravity and offset. `inertia` adds one to the armature,
    `stiffness` fits that, too; both have up to three `starts`.
    """
    own = {name: model.columns[place] for name, place in AT.items()}
    arm = [
        Parameter("dead_time_s", *[model.dead_time_s] * 3),  # the card's
        Parameter("gravity_sin", 0.0, -np.inf, np.inf),
        Parameter("gravity_cos", 0.0, -np.inf, np.inf),
        *([Parameter("inertia", 1e-4, 1e-6, 10.0)] if inertia else []),
        *([Parameter("stiffness", 1.0, 1e-4, 20.0)] if stiffness else []),
        Parameter("offset_rad", 0.0, -1.0, 1.0),
    ]
    names = [p.name for p in arm]

    def columns_of(values: np.ndarray) -> np.ndarray:
        by_name = dict(zip(names, values.T, strict=True))
        columns = np.repeat(model.columns[None], len(values), axis=0)
        gravity = GRAVITY_NM * (by_name["gravity_sin"] + 1j * by_name["gravity_cos"])
        columns[:, AT["gravity_nm"]] = np.abs(gravity)
        columns[:, AT["hanging_rad"]] = np.angle(gravity)
        columns[:, AT["offset_rad"]] = by_name["offset_rad"]
        columns[:, AT["armature"]] += by_name.get("inertia", 0.0)
        columns[:, AT["stiffness"]] *= by_name.get("stiffness", 1.0)
        return columns

    gravity = own["gravity_nm"] / GRAVITY_NM * np.exp(1j * own["hanging_rad"])
    first = np.array([model.dead_time_s, gravity.real, gravity.imag, own["offset_rad"]])
    guesses = {"inertia": (1e-4, 2.5e-3, 0.02), "stiffness": (1.0, 0.22, 0.05)}
    start = np.repeat(first[None], starts, axis=0)
    for name, guess in guesses.items():
        if name in names:
            start = np.insert(start, -1, guess[:starts], axis=1)
    structure = Structure("arm", tuple(arm), columns_of=columns_of)
    problem = Problem(structure, tuple(runs), (NOISE_RAD,) * len(runs))
    fits = local(problem, structure.encode(start), ITERATIONS, DIFFERENCE)
    fit = evolve(problem, fits, np.random.default_rng(0), short=True)
    best = structure.decode(fit.point)
    return replace(model, columns=columns_of(best[None])[0])


def exchanged(model: Model, ours: Model, term: str) -> Model:
    """The model with one of our terms, per stiffness."""
    if term == "dead time":
        return replace(model.changed(velocity_limit=np.inf), dead_time_s=ours.dead_time_s)
    own, share = dict(zip(COLUMNS, ours.columns, strict=True)), model.stiffness / ours.stiffness
    if term == "friction":  # with the gravity: it rubs with the load
        plain = ("stribeck_speed", "load_friction_motor", "load_friction_load",
                 "load_friction_static", "dead_zone_rad", "start_duty", "hanging_rad")  # fmt: skip
        scaled = ("friction_loss", "stribeck_friction", "gravity_nm")
        quadratic = own["load_friction_quadratic"] / share
        values = {"load_friction_quadratic": quadratic} | {name: own[name] for name in plain}
        return model.changed(**values, **{name: own[name] * share for name in scaled})
    if term == "ramp":
        return model.changed(acceleration_limit=own["acceleration_limit"])
    scaled = {
        "inertia": ("armature",), "damping": ("damping", "back_emf"),
        "largest torque": ("effort_limit", "torque_limit"), "stiffness": (),
    }[term]  # fmt: skip
    return model.changed(**{name: own[name] * share for name in scaled})


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
    fitted = [_run(first(trials[m]), lattice) for m in MOTIONS[:3]]
    bare = {name: card_model(card, joint) for name, card in MODELS.items()}
    loaded = {name: with_load(model, fitted) for name, model in bare.items()}
    ours, sweep = loaded[OURS], runs[MOTIONS[3]]
    still = {m: rms((_command(r) - r.row_rad)[scored(r, m)]) for m, r in runs.items()}
    models = {name: described(model, runs) for name, model in loaded.items()}
    for name, model in loaded.items():
        if name != OURS:
            models[name]["terms"] = terms(model, bare[name], ours, fitted, runs)
    free = bare[OURS].changed(acceleration_limit=np.inf)
    return {
        "command": still,
        "robot": slow_motion(sweep, sweep.row_rad),
        "without ramp": score(with_load(free, fitted), runs),
        "models": models,
    }


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
        changed, fit_stiffness = exchanged(model, ours, term), term == "stiffness"
        if term != "inertia":
            changed = changed.changed(armature=bare.columns[AT["armature"]])
        changed = with_load(
            changed, fitted, term != "inertia", fit_stiffness, 3 if fit_stiffness else 1
        )
        found[term] = score(changed, runs)
        if term == "stiffness":
            found["best stiffness"] = changed.stiffness
    return found


def _run(trial: Trial, lattice: PollLattice) -> Run:
    """A run of unit P gain: the stiffness of the models holds at that of the recordings."""
    return replace(prepare(trial, lattice), p_gain=1.0)


def _command(run: Run) -> np.ndarray:
    """Command at the time of each row."""
    return run.command[np.minimum(run.row_step.astype(int), run.steps - 1)]


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
    """Errors by motion, and slow motion."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(8, 4.2), layout="constrained")
    first, second = drawn.subplots(1, 2)
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
    drawn.legend(
        *first.get_legend_handles_labels(), loc="outside lower center", ncols=3,
        fontsize="small",
    )  # fmt: skip
    drawn.savefig(PICTURE, dpi=130)


def main(joints: tuple[str, ...] = JOINTS, print_only: bool = False) -> None:
    """Print the tables, and write page, file and picture."""
    found = {}
    for joint in joints:
        begun = time.process_time()
        found[joint] = _plain(evaluate(joint))
        print(f"{joint}: {time.process_time() - begun:.0f} s of processor time", flush=True)
    inputs = {m: load(REAL / "sage_so101" / m).sha256 for m in MOTIONS}
    cards = {card: numbers_hash(load_card(card)) for card in MODELS.values()}
    publish({"recordings": inputs, "cards": cards, "joints": found}, write=not print_only)


if __name__ == "__main__":
    tyro.cli(main)
