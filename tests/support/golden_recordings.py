"""The recordings whose figures are frozen: twelve emulated ones, and every shared real one.

An emulated recording is made in this process and in virtual time, from its seed alone: one servo
class, one joint, one motion in short trials. Two recordings of one class and seed are of the same
servo. A real recording is a file, a folder, or several files that are pooled, below the folder of
`support.real_recordings`; each file is held to its SHA-256 in `figures.yaml`.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import pupper_sysid as ps
from pupper_sysid.hardware.joint_map import JointMap, load_joint_map
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.pendulum import Pendulum, PendulumBench, draw_bench, draw_of_map
from pupper_sysid.sim.emulator.robot import draw_robot
from pupper_sysid.sysid.sweep.bench import bench_plan, parse_load
from pupper_sysid.sysid.sweep.excitation import POLL_RATE_HZ, Plan, TrialPlan, plan
from pupper_sysid.sysid.sweep.recorder import playback, record
from support.real_recordings import FOLDER

WALK = Path(__file__).resolve().parents[2] / "data" / "samples" / "walk_commands.csv"
LOAD = "pendulum:0.1kg@0.10m"


def _behind_the_proxy(rng: np.random.Generator, joint: str) -> EmulatedBus:
    """SCS0009 of a Mini Pupper 2 behind its ESP32: polled, stale, 1024 counts over 550/pi."""
    return EmulatedBus(draw_robot(rng, joint_map=_map_of("mini_pupper_2", joint)), rng)


def _direct(preset: str, servo: str | None = None) -> Callable[..., EmulatedBus]:
    """Servos on a serial line, every reading fresh: those of a preset, or others on its bench."""

    def bus(rng: np.random.Generator, joint: str) -> EmulatedBus:
        layout = _map_of(preset, joint)
        if servo is not None:
            layout = replace(layout, file=layout.file.model_copy(update={"servo": servo}))
        robot, plant = draw_of_map(rng, layout)
        return EmulatedBus(robot, rng, plant=plant)

    return bus


def _pendulum(rng: np.random.Generator, joint: str) -> GuardedBus:
    """STS3215 on a bench with a pendulum, registers and all."""
    load = parse_load(LOAD)
    assert load is not None
    robot = draw_bench(
        rng, Pendulum(**load.model_dump()), joint_map=_map_of("bench_sts3215", joint)
    )
    return GuardedBus(EmulatedBus(robot, rng, plant=PendulumBench(robot)))


def _map_of(preset: str, joint: str) -> JointMap:
    return load_joint_map(preset).select([joint])


SERVOS: dict[str, Callable[[np.random.Generator, str], EmulatedBus | GuardedBus]] = {
    "SCS0009, ESP32 proxy": _behind_the_proxy,
    "SCS0009, serial": _direct("mini_pupper_2_direct"),
    "STS3215, serial": _direct("sts3215"),
    "STS3215, serial, pendulum": _pendulum,
    "STS3250, serial": _direct("bench_sts3215", "STS3250"),
    "XL330-M288, serial": _direct("bench_sts3215", "XL330-M288"),
}
"""Servo classes that can be emulated, and their buses."""


@dataclass(frozen=True)
class Emulated:
    """An emulated recording.

    Attributes
    ----------
    servo : str
        Of `SERVOS`.
    motion : {"tones", "chirp", "steps", "walk", "gains"}
    joint : str
    seed : int
        Of the servo and of the noise.
    loop_period_s : float
        Time between commands.
    """

    servo: str
    motion: str
    joint: str
    seed: int = 1
    loop_period_s: float = 0.019

    def record(self) -> ps.Recording:
        """The recording."""
        bus = SERVOS[self.servo](np.random.default_rng(self.seed), self.joint)
        chosen = self._plan(bus)
        loads = {"loads": {self.joint: parse_load(LOAD).model_dump()}}
        with TemporaryDirectory() as folder:
            path = record(
                bus, chosen, Path(folder) / "emulated.csv", loop_period_s=self.loop_period_s,
                metadata={"seed": self.seed} | (loads if self.motion == "gains" else {}),
            )  # fmt: skip
            return ps.load(path)

    def origin(self, recording: ps.Recording) -> dict[str, Any]:
        """What it is, and the SHA-256 of its rows (the file's header has the date)."""
        rows = recording.table.to_csv(index=False, float_format="%.7f")
        return {
            "servo": self.servo, "motion": self.motion, "joint": self.joint, "seed": self.seed,
            "rows": len(recording.table), "rows_sha256": hashlib.sha256(rows.encode()).hexdigest(),
        }  # fmt: skip

    def _plan(self, bus: EmulatedBus | GuardedBus) -> Plan:
        """Trials of the motion, so short that a calibration takes a few seconds."""
        pose = bus.metadata["rest_pose_rad"]
        free = bus.limits.margin(np.array([pose[name] for name in bus.joint_names]))
        margin = dict(zip(bus.joint_names, map(float, free), strict=True))
        joint = self.joint

        def excite(kind: str, amplitude_rad: float, duration_s: float, *tones: float) -> Plan:
            return plan(
                kind, [joint], tones, amplitude_rad, duration_s, self.loop_period_s,
                bus.metadata["speed_limit_rad_s"], POLL_RATE_HZ, margin, pose,
            )  # fmt: skip

        if self.motion == "tones":
            return excite("sine", 0.3, 2.0, 1.2, 2.5, 5.0)
        if self.motion == "chirp":
            return _joined(excite("chirp", size, 3.0, 0.5, 8.0) for size in (0.3, 0.15))
        if self.motion == "steps":
            return _joined(excite("steps", size, 3.0) for size in (0.3, 0.2))
        if self.motion == "walk":
            loop = playback(WALK, [joint])
            (trial,) = loop.trials
            return replace(loop, trials=(replace(trial, duration_s=3.2),) * 2)
        load = parse_load(LOAD)
        return bench_plan(
            joint, load, (16, 32), "sine", frequencies_hz=(1.0, 2.5), duration_s=1.5,
            loop_period_s=self.loop_period_s, start_rad=0.0, margin_rad=margin[joint],
        )  # fmt: skip


def _joined(plans: Any) -> Plan:
    """The trials of several plans, one after the other."""
    every = list(plans)
    trials: tuple[TrialPlan, ...] = tuple(t for p in every for t in p.trials)
    return replace(every[0], trials=trials)


EMULATED = {
    "proxy_scs0009_tones": Emulated("SCS0009, ESP32 proxy", "tones", "LF_hip"),
    "proxy_scs0009_chirp": Emulated("SCS0009, ESP32 proxy", "chirp", "LF_hip"),
    "proxy_scs0009_steps": Emulated("SCS0009, ESP32 proxy", "steps", "LF_hip"),
    "proxy_scs0009_walk": Emulated("SCS0009, ESP32 proxy", "walk", "LF_thigh"),
    "serial_scs0009_tones": Emulated("SCS0009, serial", "tones", "RF_thigh", 2),
    "serial_scs0009_walk": Emulated("SCS0009, serial", "walk", "RF_thigh", 2),
    "serial_sts3215_tones": Emulated("STS3215, serial", "tones", "LB_hip", 3),
    "serial_sts3215_chirp": Emulated("STS3215, serial", "chirp", "LB_hip", 3),
    "serial_sts3215_steps": Emulated("STS3215, serial", "steps", "LB_hip", 3),
    "pendulum_sts3215_gains": Emulated("STS3215, serial, pendulum", "gains", "bench", 4),
    "serial_sts3250_steps": Emulated("STS3250, serial", "steps", "bench", 5),
    "serial_xl330_chirp": Emulated("XL330-M288, serial", "chirp", "bench", 6),
}
"""Emulated recordings by name."""


@dataclass(frozen=True)
class Real:
    """A real recording, or several that are pooled.

    Attributes
    ----------
    pattern : str
        Below the folder of real recordings; a `*` stands for several files.
    calibrated : tuple of str or None
        Joints that are calibrated; None for all of them. The others have lags only.
    calibrated_s : float
        Length of the recording from its start that is calibrated [s]: two minutes of an SO-101's
        joint take three minutes of processor time.
    """

    pattern: str
    calibrated: tuple[str, ...] | None = None
    calibrated_s: float = float("inf")

    @property
    def paths(self) -> list[Path]:
        """Files or folders to load; empty where they are absent."""
        return sorted(FOLDER.glob(self.pattern))

    def record(self) -> list[ps.Recording]:
        """The recordings."""
        return [ps.load(path) for path in self.paths]

    def head(self, recordings: Sequence[ps.Recording]) -> list[ps.Recording]:
        """The part of the recordings that is calibrated."""
        every = [(r, r.table["send_time_s"] - r.table["send_time_s"].min()) for r in recordings]
        return [replace(r, table=r.table[time <= self.calibrated_s]) for r, time in every]

    def origin(self) -> dict[str, Any]:
        """Its files with their SHA-256, and what of them is calibrated."""
        files = [
            file
            for path in self.paths
            for file in (sorted(path.rglob("*")) if path.is_dir() else [path])
            if file.is_file()
        ]
        part: dict[str, Any] = {}
        if self.calibrated is not None:
            part["calibrated_joints"] = list(self.calibrated)
        if np.isfinite(self.calibrated_s):
            part["calibrated_s"] = self.calibrated_s
        return part | {
            "files_sha256": {
                file.relative_to(FOLDER).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest()
                for file in files
            }
        }


REAL = {
    "mini_pupper_hip": Real("real_motor_0_LF_hip_amp0.3.csv"),
    "mini_pupper_thigh": Real("real_motor_1_LF_thigh_amp0.3.csv"),
    "mini_pupper_thigh_full_band": Real("mini_pupper_full_band/thigh_1-10hz.csv"),
    "mini_pupper_playback": Real(
        "playback_lstm_25hz.csv", ("LF_hip", "LF_thigh", "LF_calf", "RB_thigh")
    ),
    "so101_chirp": Real("sage_so101/chirp_sweep", ("Elbow",), 40.0),
    "so101_frequencies": Real("sage_so101/frequency_sweep", ("Elbow",), 40.0),
    "so101_prbs": Real("sage_so101/prbs_excitation", ("Elbow",), 40.0),
    "so101_steps": Real("sage_so101/step_response", ("Elbow",), 40.0),
    "xl330_pendulum": Real("bam_xl330/*.json"),
    "lerobot_so101": Real("lerobot_so101", ("shoulder_pan", "elbow_flex")),
    "robstride_41": Real("ktune_robstride/real_41_*.json"),
    "robstride_42": Real("ktune_robstride/real_42_*.json"),
    "robstride_43": Real("ktune_robstride/real_43_*.json"),
    "robstride_44": Real("ktune_robstride/real_44_*.json"),
    "robstride_45": Real("ktune_robstride/real_45_*.json"),
}
"""Real recordings by name."""
