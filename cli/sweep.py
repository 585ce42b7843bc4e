"""`sweep`: move the joints, write down what happens."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from cli import terminal
from common.errors import InputError
from common.files import refuse_overwrite
from common.joints import select_joints
from sim.emulated_bus import EmulatedBus
from sim.emulated_robot import draw_robot
from sysid import command_playback
from sysid.excitation import parse_frequencies, plan
from sysid.recorder import LOOP_PERIOD_S, record
from sysid.recording import FOLDER


@dataclass(frozen=True)
class Sweep:
    """Record the response of joints to a sweep of tones (or steps, a chirp, …).

    Example: pupper-sysid sweep --freqs 1-10 --joints LF
    """

    freqs: str = "1-10"
    """Frequencies [Hz]: 1-10, 1-10:0.5 or 1,2,4,6.5."""
    joints: str = "all"
    """Names (LF_hip), legs (LF), kinds (hip), several with commas, or all; one after the other."""
    kind: Literal["sine", "chirp", "multisine", "steps", "square"] = "sine"
    """Shape of the motion."""
    playback: Path | None = None
    """Play the commands of this recording or command file instead."""
    amplitude: float = 0.3
    """Largest excursion from the start pose [rad]; less where the speed limit asks for it."""
    duration: float | None = None
    """Length of each trial [s]; by default 5 s or five periods, whichever is longer."""
    rate: float = round(1 / LOOP_PERIOD_S, 2)
    """Control loop [Hz]."""
    out: Path | None = None
    """File to write; by default recordings/<kind>_<date>_<time>.csv."""
    truth: bool = False
    """Also write what the emulated robot really did, beside the recording."""
    real_time: bool = False
    """Let the emulated robot take as long as a real one."""
    force: bool = False
    """Replace files that exist."""
    json: bool = False
    """Print one JSON object and nothing else."""
    seed: int = 0
    """Seed of the emulated robot: its servos, its lost polls, its noise."""

    def run(self) -> None:
        """Plan, record, and say what to run next."""
        terminal.need_positive("--rate", self.rate)
        period = 1.0 / self.rate
        joints = select_joints(self.joints)
        rng = np.random.default_rng(self.seed)
        bus = EmulatedBus(draw_robot(rng), rng, real_time=self.real_time)
        if self.playback:
            chosen = command_playback.playback(self.playback, joints)
        else:
            chosen = plan(
                self.kind, joints, parse_frequencies(self.freqs), self.amplitude, self.duration,
                period, bus.metadata["speed_limit_rad_s"],
            )  # fmt: skip
        terminal.warn(chosen.warnings)
        path = self.out or FOLDER / f"{self._name()}_{time.strftime('%Y-%m-%d_%H%M%S')}.csv"
        if path.suffix != ".csv":
            raise InputError(f"--out {path}: a recording is a .csv file.")
        stem = path.with_suffix("")
        for other in (f"{stem}.truth.yaml", f"{stem}.truth.csv") if self.truth else ():
            refuse_overwrite(Path(other), self.force)
        terminal.err.print(
            "No robot: using the emulated one" + (", in real time." if self.real_time else ".")
        )
        started = time.perf_counter()
        with terminal.seconds_progress("recording", chosen.duration_s) as advance:
            record(
                bus, chosen, path, loop_period_s=period, metadata={"seed": self.seed},
                force=self.force, progress=advance,
            )  # fmt: skip
        written = [path, *(bus.write_truth(stem, self.force) if self.truth else ())]
        elapsed = time.perf_counter() - started
        if self.json:
            terminal.print_json(
                {
                    "recording": str(path),
                    "written": [str(p) for p in written],
                    "joints": joints,
                    "trials": len(chosen.trials),
                    "recorded_s": chosen.duration_s,
                    "elapsed_s": elapsed,
                    "warnings": list(chosen.warnings),
                }
            )
            return
        terminal.out.print(
            f"Recorded {len(chosen.trials)} trials of {len(joints)} joints, "
            f"{chosen.duration_s:.0f} s of motion, in {elapsed:.1f} s.",
            soft_wrap=True,
        )
        for name in written:
            terminal.out.print(f"  {name}", soft_wrap=True)
        terminal.out.print(
            f"Next:\n  pupper-sysid doctor {path}\n  pupper-sysid delay {path}\n"
            f"  pupper-sysid calibrate {path} --out calibrated.yaml",
            soft_wrap=True,
        )

    def _name(self) -> str:
        return "playback" if self.playback else self.kind
