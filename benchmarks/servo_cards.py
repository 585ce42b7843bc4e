"""Servo cards of this project's own fits, from public recordings of servos under load.

    .venv/bin/python benchmarks/servo_cards.py
    .venv/bin/python benchmarks/servo_cards.py --only xl330-m288

The recordings are those of `$PUPPER_REAL_DATA`, else `../shared/real`: a Dynamixel XL330 on a
pendulum (Rhoban/bam, Apache-2.0), the STS3215 of an SO-101 arm (isaac-sim2real/sage, Apache-2.0)
and RobStride drives of a KBot's leg (kscalelabs/ktune, MIT). Each card is written to
`servo_models/cards/data`, with hashes of its recordings.

Of the SO-101 only the first 40 s of three motions are fitted, so that the rest, and all of
`frequency_sweep`, is left for scores (`which_sts3215.py`).
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

from shared import REAL, ROOT  # isort: skip

import numpy as np
import tyro
from card_of_fits import to_card, to_drive_card
from real_recordings import FITTED_S, JOINTS, MOTIONS, first, loaded_fit, track

from pupper_sysid.servo_models.cards.card import Gains, ServoCard, Source
from pupper_sysid.sysid.fit.results import LoadedFit
from pupper_sysid.sysid.fit.run import at_steps
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Trial

OUT = ROOT / "servo_models" / "cards" / "data"


def xl330(seed: int) -> ServoCard:
    """Dynamixel XL330-M288 on a pendulum, four P gains."""
    recordings = [load(path) for path in sorted((REAL / "bam_xl330").glob("*.json"))]
    (joint,) = recordings[0].joints
    fit = loaded_fit(joint, [t for r in recordings for t in r.trials(joint)], seed)
    return to_card(
        "xl330-m288", "Dynamixel XL330-M288", {"servo": fit}, recordings,
        Source(
            title="Pendulum recordings of an XL330-M288, Rhoban",
            url="https://github.com/Rhoban/bam", file="bam/data.bak",
            commit="af2260462471ff45ac18af159b1327ea51d8db15", licence="Apache-2.0",
        ),
        "pendulum of 0.49 kg at 0.1 m, P 100 to 800", supply_v=7.4, gains=Gains(i=0.0, d=0.0),
    )  # fmt: skip


ACCELERATION = 254
"""Register `acceleration` of the SO-101's servos, which the recordings do not state: what LeRobot
writes. One limit for all motions."""


def so101(seed: int) -> ServoCard:
    """STS3215 of an SO-101 arm at P 16, five joints."""
    recordings = [load(REAL / "sage_so101" / name) for name in MOTIONS[:3]]
    fits = {}
    for joint in JOINTS:
        trials = []
        for recording in recordings:
            (trial,) = recording.trials(joint)
            setup = trial.servo.model_copy(update={"registers": {"acceleration": ACCELERATION}})
            trials.append(replace(first(trial), servo=setup))
        fits[joint] = loaded_fit(joint, trials, seed)
    return to_card(
        "sts3215-12v", "Feetech STS3215", fits, recordings,
        Source(
            title="SAGE, motions of an SO-101 arm", url="https://github.com/isaac-sim2real/sage",
            file="output/real/so101/custom", commit="4ffd2627df9d23e279b35712a67e629ce0c0dfa7",
            licence="Apache-2.0",
        ),
        "the arm itself, its other joints moving, too", supply_v=12.0, gains=Gains(i=0.0, d=32.0),
        notes=(
            f"Fitted to the first {FITTED_S:g} s of {', '.join(MOTIONS[:3])}. The rest of them, "
            f"and all of {MOTIONS[3]}, is left out, for scores.",
            "The limit on the set-point's acceleration is that of the register `acceleration` at "
            f"{ACCELERATION}, which LeRobot writes. The recordings do not state it.",
        ),
    )  # fmt: skip


ROBSTRIDE = {"02": (45,), "03": (42, 43), "04": (41, 44)}
"""Actuators of the leg by type, as its joints are named."""


def robstride(kind: str, seed: int) -> ServoCard:
    """RobStride drives of a KBot's leg, whose gains are in N·m/rad.

    The collector sends a velocity with each position, and the drive's D gain acts on the velocity's
    error. That is the same as a position that leads by D gain over P gain times the velocity.
    """
    fits, drives, recordings, notes_of_joints = {}, {}, [], []
    for path in sorted((REAL / "ktune_robstride").glob("*.json")):
        log = json.loads(path.read_text())
        config = log["config"]
        if config["actuator_id"] not in ROBSTRIDE[kind]:
            continue
        recordings.append(load(path))
        (joint,) = recordings[-1].joints
        (trial,) = recordings[-1].trials(joint)
        lead = config["kd"] / config["kp"] * np.gradient(trial.command_rad, trial.send_time_s)
        led = replace(trial, command_rad=trial.command_rad + lead)
        fits[joint] = loaded_fit(joint, [led], seed)
        drives[joint] = config["kp"], config["max_torque"]
        reported = np.array([row["torque"] for row in log["data"]])
        slope, together = torques(fits[joint], led, config["kp"], reported)
        notes_of_joints.append(
            f"{joint}: P gain {config['kp']:g} N·m/rad, D gain {config['kd']:g} N·m·s/rad as set. "
            f"The drive reports up to {np.abs(reported).max():.1f} N·m, {slope:.2f} times the "
            f"torque of these numbers (correlation {together:.2f})."
        )
    return to_drive_card(
        f"robstride-{kind}", f"RobStride {kind}", fits, drives, recordings,
        Source(
            title="ktune, chirps of a KBot's leg", url="https://github.com/kscalelabs/ktune",
            licence="MIT",
        ),
        "the leg itself, one joint at a time",
        notes=(
            *notes_of_joints,
            "The type is that in the names of the robot's joints: the logs, of branch rs_tune, "
            "state an actuator's number only.",
            "The D gain acts on the difference to the commanded velocity, which was sent, too: "
            "with positions alone the joint lags by D gain over P gain more.",
            "Missing: torque limit, speed limit and rotor inertia. A chirp of 5° reaches no limit, "
            "and the leg's inertia is not known.",
        ),
    )  # fmt: skip


def torques(
    fit: LoadedFit, trial: Trial, p_gain: float, reported_nm: np.ndarray
) -> tuple[float, float]:
    """Slope and correlation of the torques that a drive reports over those of its fit."""
    (run,) = fit.runs
    servo, position = fit.servo.arrays(), track(fit, run)
    late = trial.read_time_s - float(servo["dead_time_s"])
    offset = fit.numbers["offset_rad"].value
    error = np.interp(late, trial.send_time_s, trial.command_rad) + offset
    error = error - at_steps(position, run.row_step)
    speed = at_steps(np.gradient(position, run.step_s), run.row_step)
    per = fit.numbers["stiffness_nm_per_rad"].value
    own = p_gain * (error - float(servo["back_emf"]) / per * speed)
    return float(np.polyfit(own, reported_nm, 1)[0]), float(np.corrcoef(own, reported_nm)[0, 1])


CARDS: dict[str, Callable[[int], ServoCard]] = {
    "xl330-m288": xl330,
    "sts3215-12v": so101,
    **{f"robstride-{kind}": partial(robstride, kind) for kind in ROBSTRIDE},
}


def main(only: Literal["", *CARDS] = "", seed: int = 0, out: Path = OUT) -> None:
    """Fit and write all cards, or `only` one."""
    for name in [only] if only else CARDS:
        begun = time.monotonic()
        card = CARDS[name](seed)
        card.save(out / f"{name}.yaml", force=True)
        print(f"{name}: {time.monotonic() - begun:.0f} s")
        for score in card.scores:
            print(f"  {1e3 * score.value:6.1f} mrad  {score.what}")


if __name__ == "__main__":
    tyro.cli(main)
