"""Servo models of every kind with random weights, saved with a contract."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.servo_models.networks import CommandNetwork
from pupper_sysid.servo_models.servo_file import (
    SavedModel,
    input_names,
    load_servo_model,
    save_servo_model,
)

P = 0.02
JOINTS = ("LF_hip", "RB_calf", "RF_thigh")
TAPS, UNITS, MEMBERS = 5, 4, 2
KINDS = ("fir", "mlp", "mlp with feedback", "lstm", "lstm with feedback", "delayed-pd", "sindy")

Arrays = dict[str, NDArray]


def arrays(kind: str, seed: int = 0) -> Arrays:
    """Random parameters of a model for `JOINTS`."""
    rng = np.random.default_rng(seed)
    n = len(JOINTS)
    if kind == "delayed-pd":
        values = DelayedPDParameters(
            stiffness=rng.uniform(1e3, 4e3, n), damping=rng.uniform(40, 90, n),
            friction_loss=rng.uniform(0, 20, n), armature=np.ones(n),
            effort_limit=np.full(n, np.inf), velocity_limit=rng.uniform(5, 9, n),
            dead_time_s=rng.uniform(0.01, 0.05, n), back_emf=np.zeros(n),
        )  # fmt: skip
        return {k: np.asarray(v) for k, v in vars(values).items()} | {
            "offset_rad": 0.01 * rng.normal(size=n)
        }
    if kind == "sindy":
        return {
            "stiffness_per_s2": rng.uniform(1e3, 4e3, n),
            "damping_per_s": rng.uniform(40, 90, n),
            "dead_time_s": rng.uniform(0.01, 0.05, n),
            "offset_rad": 0.01 * rng.normal(size=n),
        }
    feedback = int("feedback" in kind)
    taps = 1 if kind == "lstm with feedback" else TAPS
    found: Arrays = {
        "command_center": rng.normal(size=n), "command_scale": rng.uniform(0.2, 0.6, n),
        "position_center": rng.normal(size=n), "position_scale": rng.uniform(0.2, 0.6, n),
        # the published networks, which see their last position, have no bound
        "bound": np.full(n, np.inf) if feedback else rng.uniform(0.2, 0.4, n),
        "fir": 0.3 * rng.normal(size=(n, taps)), "fir_bias": 0.1 * rng.normal(size=n),
    }  # fmt: skip
    if kind.startswith("mlp"):
        sizes = (TAPS + feedback, UNITS, UNITS, 1)
        for layer, (a, b) in enumerate(pairwise(sizes)):
            found[f"weight_{layer}"] = rng.normal(size=(n, a, b)) / np.sqrt(a)
            found[f"bias_{layer}"] = 0.1 * rng.normal(size=(n, b))
    if kind.startswith("lstm"):
        found |= {
            "weight_input": rng.normal(size=(n, MEMBERS, 1 + feedback, 4 * UNITS)),
            "weight_hidden": 0.5 * rng.normal(size=(n, MEMBERS, UNITS, 4 * UNITS)),
            "bias": 0.1 * rng.normal(size=(n, MEMBERS, 4 * UNITS)),
            "weight_out": 0.5 * rng.normal(size=(n, MEMBERS, UNITS)),
            "bias_out": 0.1 * rng.normal(size=(n, MEMBERS)),
        }
    return {k: v.astype(np.float32) for k, v in found.items()}


def contract(kind: str, parameters: Arrays) -> dict[str, Any]:
    feedback = "feedback" in kind
    joint = {"scores": {"rmse_free_run_rad": 0.01, "repeatability_rad": None}, "readings": 900}
    joint |= {"band_noise_rad": 0.004, "band_timing_s": 0.002}
    return {
        "arch": kind.split()[0], "preset": "paper" if feedback else "default",
        "created": "2026-11-21T12:00:00Z", "time_step_s": P,
        "inputs": input_names(parameters, feedback), "feedback": feedback,
        "warm_up": 8 if kind == "lstm" else 0, "joints": dict.fromkeys(JOINTS, joint),
        "readings_counted": dict.fromkeys(JOINTS, "fresh"), "split": "by hand",
        "choices": {"ridge": 0.1}, "recordings": [{"name": "a.csv", "sha256": "0" * 64}],
        "seed": 0, "versions": {"numpy": "2"}, "notes": ["Ein Hüftgelenk, # and \"quotes\"."],
    }  # fmt: skip


def saved(folder: Path, kind: str = "mlp", seed: int = 0) -> SavedModel:
    parameters = arrays(kind, seed)
    save_servo_model(folder, parameters, contract(kind, parameters))
    return load_servo_model(folder)


def commands(steps: int = 40, joints: int = len(JOINTS)) -> NDArray:
    return 0.4 * np.random.default_rng(9).normal(size=(steps, joints)).cumsum(0) / 4


def linear_filter(
    joints: tuple[str, ...], period_s: float, *fir: float, center: Any = 0.0,
    feedback: float | None = None,
) -> CommandNetwork:  # fmt: skip
    """position = fir · last commands about `center` [rad]; with `feedback`, times the last position
    besides.
    """
    n = len(joints)
    own: Arrays = {
        "command_center": np.zeros(n) + center, "command_scale": np.ones(n),
        "position_center": np.zeros(n) + center, "position_scale": np.ones(n),
        "bound": np.full(n, np.inf), "fir_bias": np.zeros(n), "fir": np.tile(fir, (n, 1)),
    }  # fmt: skip
    if feedback is not None:
        weight = np.zeros((n, len(fir) + 1, 1))
        weight[:, -1] = feedback
        own |= {"weight_0": weight, "bias_0": np.zeros((n, 1))}
    return CommandNetwork(joints, period_s, own, feedback is not None)
