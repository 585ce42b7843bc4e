"""`plan`: what to record next; and the rounds of `sweep --until`, which record and fit in turn."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.cli.buses import JOINTS_FILE
from pupper_sysid.cli.terminal import Joints, Json, number
from pupper_sysid.common.errors import InputError, refuse_outside
from pupper_sysid.common.files import refuse_overwrite, sha256
from pupper_sysid.common.joints import select_joints
from pupper_sysid.common.results import plain
from pupper_sysid.hardware.joint_map import JointMap, load_joint_map
from pupper_sysid.servo_models.calibration.calibration import InputFile, load_calibration
from pupper_sysid.servo_models.calibration.quantity import unit_of, words_of
from pupper_sysid.sysid.sweep.excitation import LOOP_PERIOD_S, PLANS_S, RATES_HZ

if TYPE_CHECKING:
    from pupper_sysid.sysid.fit.results import JointCalibrationResult
    from pupper_sysid.sysid.plan.plan_file import JointOutcome, Outcome
    from pupper_sysid.sysid.plan.proposal import SweepPlan
    from pupper_sysid.sysid.recordings.recording import Recording
    from pupper_sysid.sysid.sweep.recorder import Request

Record = Callable[[Path, "Request", bool], list[Path]]
"""Records a request, or with True the rest of it, to a file; returns the files written."""


def run_rounds(
    record: Record,
    path: Path,
    request: Request,
    *,
    resume: bool,
    done: bool,
    force: bool,
    as_json: bool,
) -> None:
    """Record the first sweep, or what is left of the last round, and go on to the goal.

    `path` is the first recording, or the one that is continued (`resume`), which may be `done`
    already; `request` is its. `force` replaces the rounds of an earlier sweep.
    """
    started = time.perf_counter()
    from pupper_sysid.sysid.doctor.checks import each_joint
    from pupper_sysid.sysid.fit.joint_fit import fit_joint
    from pupper_sysid.sysid.plan.plan_file import half_width, parse_goal, record_until, save_plan
    from pupper_sysid.sysid.sweep.recorder import request_of

    series = request.until
    assert series is not None
    first = path.with_name(series.first)
    if resume:
        paths = _recorded(first)
        if paths[-1] != path:
            path = paths[-1]
            request, done = request_of(path)
    else:
        paths = [path]
        if force:  # rounds of an earlier sweep of this name
            for old in _recorded(first)[1:]:
                old.unlink()
    written = list(paths)
    if not done:
        written += record(path, request, resume)[1:]

    def record_next(plan: SweepPlan, number: int) -> Path:
        file = _of_round(first, number)
        refuse_overwrite(file)
        plan_file = file.with_suffix(".plan.yaml")
        save_plan(plan, plan_file, force=True)  # may exist, of a round that never began
        again = {
            "plan": str(plan_file), "joints": plan.joints, "loop_period_s": plan.loop_period_s,
            "until": series.model_copy(update={"number": number}),
        }  # fmt: skip
        written.extend([*record(file, request.model_copy(update=again), False), plan_file])
        return file

    def fit(
        recordings: Sequence[Recording], joints: list[str]
    ) -> dict[str, JointCalibrationResult]:
        with terminal.progress("fitting", len(joints)) as advance:
            work = partial(fit_joint, seed=request.seed)
            return each_joint(work, recordings, joints, 2, advance)

    def report(outcomes: dict[str, JointOutcome]) -> None:
        for joint, state in outcomes.items():
            dead = state.dead_time_s
            terminal.err.print(
                f"{joint}: after {state.recorded_s:.0f} s the dead time is "
                f"{terminal.ms(dead.value)} ms ± {terminal.ms(half_width(dead))} ({series.goal}): "
                f"{state.why or 'reached'}."
            )

    try:
        outcome = record_until(
            parse_goal(series.goal), paths, series.joints, fit, record_next,
            most_seconds=series.most_seconds, seed=request.seed, report=report,
        )  # fmt: skip
    except KeyboardInterrupt:
        say_how_to_resume(first)
        raise
    if as_json:
        elapsed = time.perf_counter() - started
        terminal.print_json(outcome.to_dict() | {"written": written, "elapsed_s": elapsed})
    else:
        _print_outcome(outcome, written, series.goal)


def _of_round(first: Path, number: int) -> Path:
    return first if number == 1 else first.with_name(f"{first.stem}_{number}.csv")


def _recorded(first: Path) -> list[Path]:
    """Files of the rounds that were begun."""
    if not first.exists():
        raise InputError(f"{first}, the first recording of this sweep, is missing. Put it back.")
    files, number = [first], 2
    while (path := _of_round(first, number)).exists():
        files.append(path)
        number += 1
    return files


def _print_outcome(outcome: Outcome, written: list[Path], goal: str) -> None:
    terminal.print_table(
        f"Until {goal}", "joint", "rounds", "seconds", "dead time ms", "90 % interval", "goal",
        rows=(
            (
                joint, state.rounds, number(state.recorded_s, 0), terminal.ms(dead.value),
                f"{terminal.ms(dead.low)} … {terminal.ms(dead.high)}",
                "reached" if state.reached else "not reached",
            )
            for joint, state in outcome.joints.items()
            for dead in [state.dead_time_s]
        ),
    )  # fmt: skip
    for joint, state in outcome.joints.items():
        if state.why:
            terminal.warn(f"{joint}: the goal was not reached: {state.why}.")
    for name in written:
        terminal.out.print(f"  {name}")
    following = ("calibrate", *outcome.recordings, "--out", "calibrated.yaml")
    terminal.out.print(f"Next:\n  {terminal.command('pupper-sysid', *following)}")


def say_how_to_resume(path: Path) -> None:
    """Print the command that continues a recording."""
    resuming = terminal.command("pupper-sysid", "sweep", "--resume", path)
    terminal.err.print(f"The recording up to here is in {path}; continue it with\n  {resuming}")


@dataclass(frozen=True)
class Plan:
    """Plan the next sweep: the tones, amplitudes and durations that narrow the intervals most.

    From recordings or a calibration, by simulating their fit; without either, a first sweep for
    unknown servos. Example: pupper-sysid plan recordings/sweep.csv --out plan.yaml
    """

    source: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Recordings, pooled per joint, or one calibration; without any, servos are unknown."""
    out: Path | None = None
    """Plan file to write, for `sweep --plan`."""
    joints: Joints = "all"
    seconds: float | None = None
    """Recorded time per joint [s]; by default as long as the recordings, else 20 s."""
    joint_map: str | None = None
    """Joint map whose limits the excursions keep: a file or a preset. By default the recording's,
    else joints.yaml if it is here, else the Mini Pupper's."""
    rate: float | None = None
    """Control loop [Hz]; by default the recordings', else 52.63 Hz."""
    force: bool = False
    """Replace the plan file if it exists."""
    json: Json = False
    seed: int = 0
    """Seed of the fits and of the drawn servos."""

    def run(self) -> None:
        """Plan, print, write."""
        if self.out is not None:
            refuse_overwrite(self.out, self.force)  # before the work, not after it
        refuse_outside("--seconds", self.seconds, *PLANS_S, "s")
        refuse_outside("--rate", self.rate, *RATES_HZ, "Hz")
        from pupper_sysid.sysid.plan.plan_file import save_plan

        plan = self._plan()
        if self.out is not None:
            save_plan(plan, self.out, self.force)
        if self.json:
            return terminal.print_json(plain(plan) | {"written": self.out})
        show(plan)
        if self.out is not None:
            following = terminal.command("pupper-sysid", "sweep", "--plan", self.out)
            terminal.err.print(f"Wrote {self.out}. Next: {following}")
        else:
            terminal.err.print("Nothing was written; --out plan.yaml keeps it.")

    def _plan(self) -> SweepPlan:
        """The plan from recordings or a calibration, or a first sweep without either."""
        from pupper_sysid.sysid.plan import proposal
        from pupper_sysid.sysid.plan.planner import Setup

        first, *more = self.source or (None,)
        if first is not None and first.suffix not in (".yaml", ".yml"):
            recordings = terminal.load_all(self.source)
            joints = terminal.pick_joints(recordings, self.joints)
            if self.rate is not None:
                raise InputError("--rate: a plan from recordings keeps their rate; leave it out.")
            with terminal.progress("fitting", len(joints)) as advance:
                return proposal.plan_from_recordings(
                    recordings, joints, seconds=self.seconds,
                    margins=margins(self._map(recordings[0]), joints), seed=self.seed,
                    workers=2, progress=advance,
                )  # fmt: skip
        if more:
            raise InputError(f"{first} and {more[0]}: give recordings, or one calibration.")
        period_s = LOOP_PERIOD_S if self.rate is None else 1 / self.rate
        seconds = proposal.SECONDS if self.seconds is None else self.seconds
        if first is not None:
            calibration = load_calibration(first)
            joints = select_joints(self.joints, calibration.joint_names)
            return proposal.plan_from_calibration(
                calibration, InputFile(name=first.name, sha256=sha256(first)), joints,
                seconds=seconds, loop_period_s=period_s,
                margins=margins(self._map(None), joints), seed=self.seed,
            )  # fmt: skip
        joint_map = self._map(None)
        # the Mini Pupper's proxy polls; a serial line answers each read itself
        polled = joint_map.frame == "proxy"
        setup = Setup(
            loop_period_s=period_s,
            quantum_rad=float(1 / joint_map.counts_per_rad().min()),
            **({} if polled else {"poll_period_s": 0.0, "loss": 0.0}),
        )
        return proposal.plan_first_sweep(
            select_joints(self.joints, joint_map.joint_names), setup=setup, seconds=seconds,
            margins=margins(joint_map), seed=self.seed,
        )  # fmt: skip

    def _map(self, recording: Recording | None) -> JointMap:
        """The joint map that is named, the recording's, the one in this folder, or the standard."""
        bus = recording.metadata.get("bus") or {} if recording else {}
        recorded = bus.get("joint_map")
        if self.joint_map is None and recorded:
            try:
                return load_joint_map(recorded)  # a preset; the name inside a file is no path
            except InputError:
                pass
        default = JOINTS_FILE if JOINTS_FILE.exists() else "mini_pupper_2"
        return load_joint_map(self.joint_map or default)


def margins(joint_map: JointMap, joints: Sequence[str] | None = None) -> dict[str, float] | None:
    """Largest excursion of each joint to either side of its rest pose [rad].

    None if the map lacks one of the `joints`, which leaves them to the recording.
    """
    if not {*(joints or ())} <= {*joint_map.joint_names}:
        return None
    servos = joint_map.per_servo()
    margin = servos.position_limits().margin(servos.rest_pose())
    return dict(zip(servos.joint_names, map(float, margin), strict=True))


def show(plan: SweepPlan) -> None:
    """Print a plan's trials, what to expect of them, and its notes."""
    from pupper_sysid.sysid.plan.planner import DEAD_TIME, trial_seconds

    terminal.print_table(
        "Trials to record", "joint", "motion", "Hz", "amplitude rad", "seconds", "for",
        rows=(
            (t.joint, t.kind, number(t.frequency_hz), number(t.amplitude_rad, 3),
             number(trial_seconds(t.duration_s), 1), t.purpose)
            for t in plan.trials
        ),
    )  # fmt: skip
    if plan.predictions:
        rows = []
        for p in plan.predictions:
            scale, unit = (1e3, "ms") if p.quantity == DEAD_TIME else (1.0, unit_of(p.quantity))
            digits = int(np.clip(2 - np.floor(np.log10(scale * p.now.value + 1e-9)), 0, 4))
            value, *ends = (
                number(scale * x, digits)
                for x in (p.now.value, p.now.low, p.now.high, p.after.low, p.after.high)
            )
            now, after = (" … ".join(pair) for pair in (ends[:2], ends[2:]))
            rows.append((p.joint, f"{words_of(p.quantity)}, {unit}", value, now, after))
        terminal.out.print()
        terminal.print_table(
            "90 % intervals, now and to expect", "joint", "quantity", "value", "now", "after",
            rows=rows,
        )  # fmt: skip
    for note in plan.notes:
        terminal.out.print(note)
