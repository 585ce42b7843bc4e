"""`pupper-analyze`: what a gait is like, where its rhythm comes from, what it withstands."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import tyro
from rich.table import Table

from pupper_sysid.cli import terminal
from pupper_sysid.cli.policy_choice import (
    chosen_actuator,
    policy_at,
    run_folder,
    simulator,
    tell_borrowed,
)
from pupper_sysid.cli.terminal import err, need_positive, out, print_json
from pupper_sysid.cli.user_errors import run_program
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_overwrite

DESCRIPTION = """What a policy's gait is like, where its rhythm comes from, and what it withstands.

gait: frequency, sine fit, phases, duty, jitter. attractor: orbits of actions and hidden states.
delay, ablation: late, noisy, missing and stale observations, in replay and closed loop.
autonomy: does the rhythm go on with inputs frozen, after a push, at another control rate?
terrain, compliance: where it stays up, and whether it goes where it is told.
servo: published PD, fitted PD, LSTM and MLP on a recording (or on a walk of an emulated robot).
claims: all published claims beside what is found here, as a page with pictures.

Example: pupper-analyze gait runs/<name> --command 0.15 0 0
"""

Tries = list[tuple[str, Any, Any]]
"""Name, policy and trial of each."""
Found = tuple[dict[str, Any], Any, Table]
"""For --json, picture, and what is printed."""


@dataclass(frozen=True)
class Analyze:
    """What to look at, and how long."""

    what: Annotated[
        Literal[
            "gait",
            "attractor",
            "delay",
            "ablation",
            "autonomy",
            "terrain",
            "compliance",
            "servo",
            "claims",
        ],
        tyro.conf.Positional,
    ]
    policies: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Runs (`runs/<name>`) or policy folders; for `servo` also recordings."""
    command: tuple[float, float, float] = (0.15, 0.0, 0.0)
    """Forward and sideways speed [m/s], turn rate [rad/s]."""
    robots: int = 16
    """How many robots walk, each with its own servos."""
    seconds: float = 10.0
    """How long; a gait needs 7 s."""
    actuator: str | None = None
    """Calibration, `paper`, `release` or `ideal` instead of what it was trained with."""
    feedback: str | None = None
    """`held`, `ideal` or a calibration instead of what it was trained with."""
    recordings: tuple[Path, ...] = ()
    """For `claims`: sweeps and a playback of a robot."""
    servo: Path | None = None
    """For `claims`: servo model of the emulated robot of --seed, to compare its stack with the
    closed loop."""
    out: Path | None = None
    """Folder for the pictures; by default `analysis`, and `analysis/claims` for `claims`, which has
    pictures of the same names."""
    seed: int = 0
    """Of servos, friction, start and noise."""
    json: bool = False
    """Print one JSON object."""
    force: bool = False
    """Replace existing pictures."""

    @property
    def folder(self) -> Path:
        """Where to write."""
        return self.out or Path("analysis", *(["claims"] if self.what == "claims" else []))


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; ends the process with 0, 2 (bad input, one sentence) or 1."""
    run_program(Analyze, _run, "pupper-analyze", DESCRIPTION, arguments)


def _run(options: Analyze) -> None:
    need_positive("--seconds", options.seconds)
    if not options.policies:
        raise InputError(f"No policy was named: pupper-analyze {options.what} runs/<name>.")
    if options.robots < 1:
        raise InputError(f"--robots is {options.robots}; it must be at least 1.")
    import torch

    from pupper_sysid.common.figure_style import save

    torch.set_num_threads(1)
    if options.what == "claims":
        from reproduction.page import write_claims

        write_claims(options, _tries(options.policies, options))
        return
    picture = options.folder / f"{options.what}.png"
    refuse_overwrite(picture, options.force)
    if options.what == "servo":
        found, figure, table = _servo(options)
    else:
        analysis = _ANALYSES[options.what]
        tries = _tries(options.policies, options)
        found, figure, table = analysis(tries, np.random.default_rng(options.seed))
    save(figure, picture, options.force)
    if options.json:
        print_json(found | {"picture": str(picture)})
    else:
        out.print(table)
        err.print(f"Picture: {picture}", soft_wrap=True)


def _tries(paths: Sequence[Path], options: Analyze) -> Tries:
    """Policies by their short names, and how each is tried."""
    from pupper_sysid.policies.analysis.robustness import Trial

    names = [run_folder(path).name for path in paths]
    twice = next((n for n in names if names.count(n) > 1), None)
    if twice is not None:
        raise InputError(
            f"Two policies are called {twice}, after their run's folder, and results go by these "
            "names: give one of them, or rename a folder."
        )
    tries: Tries = []
    for name, path in zip(names, paths, strict=True):
        policy, run = policy_at(path)
        task, servos = simulator(path, policy, run, options.actuator, options.feedback)
        trial = Trial(
            task, servos, options.command, options.robots, options.seconds, options.seed
        )  # fmt: skip
        tries.append((name, policy, trial))
    tell_borrowed(trial.servos for _, _, trial in tries)
    return tries


def _gait(tries: Tries, rng: np.random.Generator) -> Found:
    from pupper_sysid.policies.analysis.figures import gait_figure
    from pupper_sysid.policies.analysis.gait import describe

    table = terminal.table(
        "Gait (90 % intervals over robots)", "policy", "Hz", "sine R² actions", "of noise",
        "diagonal", "duty", "jitter rad", "robots",
    )  # fmt: skip
    found, figure = {}, None
    for name, policy, trial in tries:
        walked = trial.walk(policy)
        gait = describe(walked, rng)
        figure = figure or gait_figure(walked)
        found[name] = asdict(gait)
        table.add_row(
            name, _interval(gait.frequency_hz, 2), _interval(gait.action_r2, 2),
            terminal.number(gait.null_r2, 2), _interval(gait.diagonal, 2),
            terminal.number(float(np.mean([d.value for d in gait.duty])), 2),
            terminal.number(gait.jitter_rad.value, 3), f"{gait.robots} of {trial.robots}",
        )  # fmt: skip
    return {"gaits": found}, figure, table


def _attractor(tries: Tries, rng: np.random.Generator) -> Found:
    from pupper_sysid.policies.analysis.figures import orbit_figure
    from pupper_sysid.policies.analysis.gait import SETTLE_S
    from pupper_sysid.policies.analysis.rhythm import SHORTEST_S
    from pupper_sysid.policies.analysis.robustness import orbits
    from reproduction.evidence import DELAYS_MS

    table = terminal.table(
        "Orbits at more delay of the joints (replay, as published)", "states", "variance in 3 PCs",
        "dimensions", *(f"closure +{d:g} ms" for d in DELAYS_MS),
        *(f"area +{d:g} ms" for d in DELAYS_MS[1:]),
    )  # fmt: skip
    found, drawn = {}, {}
    for name, policy, trial in tries:
        for states, seen in orbits(policy, trial, DELAYS_MS).items():
            drawn[f"{name} {states}"] = seen.pop("orbits")
            del seen["states"]
            found.setdefault(name, {})[states] = seen
            table.add_row(
                f"{name} {states}", terminal.number(seen["explained_3"], 3),
                terminal.number(seen["participation_ratio"], 1),
                *(terminal.number(c, 2) for c in seen["closure"]),
                *(terminal.number(a, 2) for a in seen["area_ratio"][1:]),
            )  # fmt: skip
    if not drawn:
        raise InputError(
            f"No robot walked for {SETTLE_S + SHORTEST_S:g} s and moved: there is no orbit to look "
            "at. Give a policy that walks, or more --seconds."
        )
    return {"delays_ms": DELAYS_MS, "orbits": found}, orbit_figure(drawn, DELAYS_MS), table


def _delay(tries: Tries, rng: np.random.Generator) -> Found:
    from pupper_sysid.policies.analysis.figures import delay_figure
    from pupper_sysid.policies.analysis.robustness import delay_curve

    curves = {name: delay_curve(policy, trial) for name, policy, trial in tries}
    columns = ("extra_delay_ms", "mode", "survival", "frequency_hz", "amplitude_rad", "mae_vx_m_s")
    return {"curves": curves}, delay_figure(curves), _table("Against more delay", curves, columns)


def _ablation(tries: Tries, rng: np.random.Generator) -> Found:
    from pupper_sysid.policies.analysis.figures import ablation_figure
    from pupper_sysid.policies.analysis.robustness import ablation

    tables = {name: ablation(policy, trial) for name, policy, trial in tries}
    columns = ("channel", "kind", "level", "sigma", "correlation", "survival", "mae_vx_m_s")
    shown = _table("Altered observations", tables, columns)
    return {"ablations": tables}, ablation_figure(tables), shown


def _autonomy(tries: Tries, rng: np.random.Generator) -> Found:
    from pupper_sysid.policies.analysis.figures import autonomy_figure
    from pupper_sysid.policies.analysis.phase_reset import (
        push_response,
        rate_exponent,
        rate_response,
    )
    from pupper_sysid.policies.analysis.robustness import frozen

    tests: dict[str, dict[str, Any]] = {
        name: {
            "frozen": frozen(policy, trial),
            "push": push_response(policy, trial),
            "rate": rate_response(policy, trial),
        }
        for name, policy, trial in tries
    }
    shown = terminal.table(
        "Is the rhythm its own?", "policy", "test", "gait Hz", "share of amplitude", "still up",
        "phase shift", "of it kept",
    )  # fmt: skip
    number = terminal.number
    for name, found in tests.items():
        for r in found["frozen"]:
            shown.add_row(
                name, r["test"], number(r["frequency_hz"], 2), number(r["share"], 2), "", "", ""
            )  # fmt: skip
        for r in found["push"]:
            shown.add_row(
                name, f"push of {r['push_m_s']:g} m/s", "", "", number(r["survival"], 2),
                number(r["shift_late"], 3), number(r["kept"], 2),
            )  # fmt: skip
        for r in found["rate"]:
            shown.add_row(
                name, f"asked at {r['rate_hz']:.4g} Hz", number(r["frequency_hz"], 2), "",
                number(r["survival"], 2), "", "",
            )  # fmt: skip
        found["rate_exponent"] = rate_exponent(found["rate"])
    return {"autonomy": tests}, autonomy_figure(tests), shown


def _terrain(tries: Tries, rng: np.random.Generator) -> Found:
    from pupper_sysid.policies.analysis.figures import terrain_figure
    from pupper_sysid.policies.analysis.robustness import terrain

    tables = {name: terrain(policy, trial) for name, policy, trial in tries}
    columns = ("ground", "survival", "frequency_hz", "mae_vx_m_s", "mae_vy_m_s", "mae_yaw_rad_s")
    return {"terrain": tables}, terrain_figure(tables), _table("On other ground", tables, columns)


def _compliance(tries: Tries, rng: np.random.Generator) -> Found:
    from pupper_sysid.policies.analysis.figures import compliance_figure
    from pupper_sysid.policies.analysis.paths import compliance

    tables = {name: compliance(policy, trial) for name, policy, trial in tries}
    figure = compliance_figure(tables)
    shown = terminal.table(
        "Does it go where it is told? (90 % intervals over robots)", "policy", "direction",
        "still up", "share of speed", "drift m/m", "arc rad/m", "wander m/turn",
    )  # fmt: skip
    for name, rows in tables.items():
        for row in rows:
            del row["path"]
            shown.add_row(
                name, row["direction"], terminal.number(row["survival"], 2),
                *(_interval(row[k], 2) for k in ("share", "drift", "arc_rad_m", "wander_m")),
            )  # fmt: skip
    return {"compliance": tables}, figure, shown


def _servo(options: Analyze) -> Found:
    """Four ways to say where a servo will be, on a recording, or on a policy's emulated walk."""
    from pupper_sysid.sysid.report.servo_figures import compare_figure
    from pupper_sysid.sysid.servo_fit.compare import to_json
    from pupper_sysid.sysid.servo_fit.four_way import four_way

    (path,) = options.policies if len(options.policies) == 1 else (None,)
    if path is None:
        raise InputError("Servo models are compared on one recording or policy at a time.")
    if path.is_dir():
        path = _walked(path, options)
    (recording,) = terminal.load_all([path])
    with terminal.share_progress("fitting") as advance:
        compared = four_way(recording, recording.joints, options.seed, advance)
    found = to_json(compared, options.seed)
    shown = terminal.table(
        "RMS error on unseen readings, mrad, mean of the joints", "model", "one step", "free run",
        "90 % interval",
    )  # fmt: skip
    for name, one in found["models"].items():
        low, high = one["mean"]["rmse_free_run_interval_rad"]
        shown.add_row(
            name, *(terminal.ms(one["mean"][f"rmse_{k}_rad"]) for k in ("one_step", "free_run")),
            f"{terminal.ms(low)} … {terminal.ms(high)}",
        )  # fmt: skip
    still = float(np.nanmean(list(compared.persistence.values())))
    shown.add_row("stays put", terminal.ms(still), "", "")
    return found | {"recording": str(path)}, compare_figure(compared), shown


def _walked(folder: Path, options: Analyze) -> Path:
    """A recording of the servos of an emulated robot that a policy walks."""
    from pupper_sysid.policies.deploy.stack_trials import walk_once
    from pupper_sysid.policies.deploy.stacks import STACKS
    from pupper_sysid.sysid.recordings.files import RecordingWriter

    policy, run = policy_at(folder)
    actuator = chosen_actuator(folder, policy, run, options.actuator)
    path = options.folder / f"{run_folder(folder).name}-walk.csv"
    about = {"bus": {"kind": "emulated walking robot", "coordinates": "servo"}}
    with RecordingWriter(path, about | {"policy": str(folder)}, options.force) as rows:
        outcome, _ = walk_once(
            policy, STACKS["closed-loop"], options.command, options.seconds, options.seed, actuator,
            rows=rows,
        )  # fmt: skip
        rows.close({"stop_reason": outcome.stop_reason})
    return path


def _table(title: str, tables: dict[str, list[dict[str, Any]]], columns: Sequence[str]) -> Table:
    made = terminal.table(title, "policy", *columns)
    for name, rows in tables.items():
        for row in rows:
            made.add_row(name, *(terminal.cell(row.get(c), 3) for c in columns))
    return made


def _interval(value: Any, digits: int) -> str:
    low, high = (terminal.number(x, digits) for x in (value.low, value.high))
    return f"{terminal.number(value.value, digits)} ({low}–{high})"


_ANALYSES: dict[str, Callable[[Tries, np.random.Generator], Found]] = {
    "gait": _gait, "attractor": _attractor, "delay": _delay, "ablation": _ablation,
    "autonomy": _autonomy, "terrain": _terrain, "compliance": _compliance,
}  # fmt: skip


if __name__ == "__main__":
    main()
