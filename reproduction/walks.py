"""The published claims about the robot's own walks, and deployment stacks side by side.

Walks are judged by the robot's IMU logs. Each stack walks the same robots under the same commands.
A servo model is one robot's, and walks only that one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import mean_of
from pupper_sysid.policies.deploy.assembly import walk_once
from pupper_sysid.policies.deploy.stacks import Stack
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.policies.twin.twin import Gyro, ImuLog, read_imu, spectrum
from pupper_sysid.policies.walks.rollouts import ERRORS
from reproduction.evidence import KINDS, Claim, Finding, NotTestable, claim, holds, span

_YAW = 2
_PAPER_HZ = 2.8
_MEAN_S = 1.0  # longer than a stride: what is left of the accelerations is gravity
_UPRIGHT_DEG = 45.0


@dataclass(frozen=True)
class ImuWalk:
    """One log of a walk."""

    kind: str
    """Architecture of the policy that walked."""
    seconds: float
    gyro: Gyro
    tilt_deg: float
    """Largest angle of the trunk's vertical axis from gravity, averaged over a second; NaN if the
    log has no accelerations."""


def gather(logs: Sequence[str]) -> list[ImuWalk]:
    """Read logs given as `KIND=FILE`."""
    walks = []
    for text in logs:
        kind, equals, name = text.partition("=")
        if not equals or kind not in KINDS:
            raise InputError(
                f"`imu`: {text} does not say which policy walked. Write KIND=FILE, for example "
                f"lstm={name or kind}; kinds are {', '.join(KINDS)}."
            )
        log = read_imu(Path(name))
        gyro = spectrum(log.time_s, [log.rate_rad_s])
        assert gyro is not None  # `read_imu` refuses what is too short for one
        walks.append(ImuWalk(kind, float(log.time_s[-1]), gyro, _largest_tilt(log)))
    return walks


def _largest_tilt(log: ImuLog) -> float:
    known = np.isfinite(log.acceleration_m_s2).all(axis=1)
    acceleration = log.acceleration_m_s2[known]
    if not known.any() or np.ptp(acceleration, axis=0).max() == 0:  # not recorded: constant
        return float("nan")
    rows = max(round(_MEAN_S / float(np.median(np.diff(log.time_s)))), 1)
    sums = np.cumsum(acceleration, axis=0)
    mean = sums[rows:] - sums[:-rows]
    # whether z points up or down is the log's own convention
    share = np.abs(mean[:, 2]) / np.linalg.norm(mean, axis=1)
    return float(np.degrees(np.arccos(share.min())))


def judge(walks: Sequence[ImuWalk]) -> list[Claim]:
    """A row per claim."""
    return [rate(walks), steadiness(walks), transfer(walks)]


@claim(
    "G4", "On hardware the LSTM walks at 2.8 Hz", "2.8 Hz",
    "IMU logs of the robot's walks: strongest sine in the trunk's turn rate after 2 s, 0.5 to "
    "10 Hz, and the share of its variance that it explains.",
)  # fmt: skip
def rate(walks: Sequence[ImuWalk]) -> Finding:
    lstm = [w.gyro.peak_hz[_YAW] for w in _of(walks, "lstm")]
    near = [abs(hz / _PAPER_HZ - 1) < 0.05 for hz in lstm]
    by_kind = {kind: [w.gyro for w in walks if w.kind == kind] for kind in KINDS}
    return Finding(
        "; ".join(
            f"{KINDS[kind]} {span([g.peak_hz[_YAW] for g in gyros], 2)} Hz "
            f"({span([g.peak_share[_YAW] for g in gyros], 2)} of the variance)"
            for kind, gyros in by_kind.items() if gyros
        ),
        None, holds(all(near), any(near)), "Holds if within 5 % of 2.8 Hz in each log.",
    )  # fmt: skip


@claim(
    "G5", "On hardware the LSTM's rhythm is the steadier one",
    "LSTM one rhythm on all joints, MLP erratic",
    "As G4: the share of the turn rate's variance that one sine explains.",
)  # fmt: skip
def steadiness(walks: Sequence[ImuWalk]) -> Finding:
    lstm = [w.gyro.peak_share[_YAW] for w in _of(walks, "lstm")]
    mlp = [w.gyro.peak_share[_YAW] for w in _of(walks, "mlp")]
    return Finding(
        f"LSTM {span(lstm, 2)}, MLP {span(mlp, 2)}", None,
        holds(min(lstm) > max(mlp), bool(np.mean(lstm) > np.mean(mlp))),
        "Holds if it is larger in each of the LSTM's logs, partly if on average.",
    )  # fmt: skip


@claim(
    "N5", "The policy transfers to the physical robot", "shown in a video",
    "IMU logs of the robot's walks: whether its trunk stays upright while it moves.",
)  # fmt: skip
def transfer(walks: Sequence[ImuWalk]) -> Finding:
    seen = [w for w in walks if np.isfinite(w.tilt_deg)]
    if not seen:
        raise NotTestable("Give IMU logs with accelerations with --imu.")
    ours = "; ".join(
        f"{KINDS[w.kind]} {w.seconds:.0f} s, trunk within {w.tilt_deg:.0f}° of upright, turn rate "
        f"{w.gyro.deviation_rad_s[_YAW]:.1f} rad/s (standard deviation)"
        for w in seen
    )
    upright = [w.tilt_deg < _UPRIGHT_DEG for w in seen]
    return Finding(
        ours, None, holds(False, all(upright)),
        "Partly if all stay upright: a log of the IMU does not tell whether the robot follows "
        "its commands.",
    )  # fmt: skip


def _of(walks: Sequence[ImuWalk], kind: str) -> list[ImuWalk]:
    mine = [w for w in walks if w.kind == kind]
    if not mine:
        raise NotTestable(f"Give IMU logs of a robot that the {KINDS[kind]} walked with --imu.")
    return mine


@dataclass(frozen=True)
class Walker:
    """One robot for one round of walks: its seed, its servo model, and the seed of the noise."""

    seed: int
    servo: Path | None = None
    noise: int = 0


def compare_stacks(
    policy: Policy,
    stacks: Mapping[str, Stack],
    walkers: Sequence[Walker],
    commands: Sequence[tuple[float, float, float]],
    seconds: float,
    actuator: str,
    progress: Callable[[str], None] = lambda what: None,
) -> list[dict[str, Any]]:
    """Walk each robot with each stack.

    The commands are walked one after the other for `seconds` each, and a walker's errors are means
    over them. Rows have `stack`, `falls` (share of walks), `mae_vx_m_s`, `mae_vy_m_s`,
    `mae_yaw_rad_s` as Interval over walkers, and from the second stack on `less_...`: this stack's
    error less the first one's, walker by walker.
    """
    rows: list[dict[str, Any]] = []
    first: np.ndarray | None = None
    for name, stack in stacks.items():
        errors, falls = [], []
        for walker in walkers:
            progress(f"{name}, robot {walker.seed}, round {walker.noise}")
            servo = walker.servo if stack.observer == "servo-model" else None
            each = []
            for command in commands:
                outcome, score = walk_once(
                    policy, stack, command, seconds, walker.seed, actuator, servo,
                    noise=walker.noise,
                )  # fmt: skip
                falls.append(outcome.fell)
                summary = score.summary()
                each.append([summary[key] for key in ERRORS])
            errors.append(np.mean(np.array(each, float), axis=0))
        table = np.array(errors)
        row: dict[str, Any] = {"stack": name, "falls": float(np.mean(falls))}
        parts = [("", table)] + ([] if first is None else [("less_", table - first)])
        for prefix, errors_of in parts:
            row |= {prefix + k: mean_of(x) for k, x in zip(ERRORS, errors_of.T, strict=True)}
        first = table if first is None else first
        rows.append(row)
    return rows
