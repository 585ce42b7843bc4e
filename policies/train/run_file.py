"""Settings of a training run, and the file in its folder that holds them.

`Run` holds all settings, one table for all architectures; `preset` gives complete ones for a kind
of policy. `save_run` writes `run.yaml` into a run's folder, with hashes and versions; `load_run`
reads and checks it. Nothing here imports torch.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, cast, get_origin, get_type_hints

import tyro
import yaml
from pydantic import BaseModel, ConfigDict, Field, create_model

from pupper_sysid.common.border import read_yaml, refuse_other_version, validated
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import sha256, versions, write_text
from pupper_sysid.common.results import plain
from pupper_sysid.common.strict_yaml import Place
from pupper_sysid.sim.walking.config import (
    CLOCK,
    PRESETS,
    Curriculum,
    Observation,
    Rewards,
    Walking,
    for_robot,
)

Kind = Literal["mlp", "lstm", "gru", "transformer", "mlp-actions"]


@dataclass(frozen=True)
class Architecture:
    """Kind and size of a policy."""

    kind: Annotated[Kind, tyro.conf.Suppress] = "mlp"
    """Kind of network; `--policy` sets it."""
    hidden: tuple[int, ...] = (256, 128, 64)
    """Units of the layers of the head (of the MLP)."""
    memory: int = 128
    """Units of an LSTM or GRU."""
    critic_hidden: tuple[int, ...] = (256, 128, 64)
    """Units of the layers of the critic."""
    privileged_critic: bool = True
    """Whether the critic has the true state beside the observation."""
    privileged_actor: bool = False
    """Whether the policy acts by the clock of the reward and sees, besides, its command, the IMU
    and the trunk's true speed alone: a teacher, which no robot can follow, for policies that can
    (`--start scratch`)."""


@dataclass(frozen=True)
class Exploration:
    """Noise of the actions while a policy learns."""

    std: tuple[float, float] = (0.05, 0.04)
    """Standard deviation at the start and at the end; 1 is `action_scale` radians. A learned one
    starts at the first and never falls below the second."""
    anneal_m_samples: tuple[float, float] = (0.0, 20.0)
    """Millions of samples between which it falls, by equal factors."""
    by_dead_band: bool = True
    """Whether joints of larger dead band (friction over stiffness) get more noise in proportion."""
    learned: bool = False
    """Whether the standard deviation is learned instead of scheduled, as published."""

    def std_at(self, samples: float) -> float:
        """Scheduled standard deviation after so many samples."""
        (first, last), (begin, end) = self.std, self.anneal_m_samples
        share = (1e-6 * samples - begin) / max(end - begin, 1e-9)
        return first * (last / first) ** min(max(share, 0.0), 1.0)


@dataclass(frozen=True)
class Hyperparameters:
    """Of PPO; the same table for all architectures."""

    steps_per_environment: int = 24
    """Control steps between two updates."""
    epochs: int = 4
    """Passes over the data of an update."""
    minibatches: int = 4
    """Parts of the data per pass."""
    learning_rate: float = 1e-6
    """Of the policy, at the start; then adapted to the KL divergence."""
    learning_rates: tuple[float, float] = (1e-7, 1e-3)
    """Smallest and largest learning rate of the policy."""
    critic_learning_rate: float = 1e-3
    """Of the critic."""
    desired_kl: float = 0.01
    """KL divergence per update that the policy's learning rate aims at, of actions given the noise
    before."""
    critic_warmup: int = 0
    """First updates in which only the critic learns."""
    discount: float = 0.99
    """γ."""
    gae_lambda: float = 0.95
    """λ of the generalised advantage estimate."""
    clip: float = 0.2
    """Of the probability ratio and of the change of the value."""
    entropy: float = 0.0
    """Weight of the entropy; without effect unless the standard deviation is learned."""
    value_weight: float = 0.5
    """Weight of the value's error."""
    gradient_norm: float = 1.0
    """Largest norm of a gradient."""
    exploration: Exploration = field(default_factory=Exploration)
    mirror: bool = False
    """Whether every sample is also learned from as its mirror image, left for right; for policies
    without a memory."""
    normalise: bool = True
    """Whether observations are normalised by their running mean and deviation."""
    freeze_normaliser: bool = False
    """Whether that mean and deviation stay what they were at the start of PPO."""
    mixed_precision: bool = False
    """Whether updates are computed in bfloat16; worth it where the processor has it (avx512_bf16,
    amx)."""
    averaging: int = 1
    """Updates over which the weights of the policy that is judged and saved are averaged
    (exponentially), which smooths out the noise of single updates; 1 for the last ones."""


TROT, OWN = "trot", "own"


@dataclass(frozen=True)
class Imitation:
    """Settings of the first gait's imitation."""

    iterations: int = 12
    """Rounds; 0 to start PPO from random weights."""
    teacher: str = TROT
    """`trot`: the open-loop trot; `own`: one that is trained from nothing first, in the run's
    folder `teacher/`; or the folder of a run of `--start teacher`."""
    rollouts: int = 5
    """Rollouts per round, each of as many steps as one of PPO."""
    epochs: int = 10
    """Passes over the data of a round."""
    minibatches: int = 16
    """Parts of each rollout per pass."""
    learning_rate: float = 1e-2
    """Of Muon (matrices) and Adam (biases) at the start; it falls to 0 with the last step."""
    correction_rate: float = 0.3
    """Share of the policy's errors of speed by which the teacher's commands change per round, in
    the second half of the rounds."""


Start = Literal["imitation", "scratch", "teacher"]
"""How a policy comes to its first gait: by imitation of a trot, or of a teacher that was trained
from nothing; or whether it is that teacher."""

Device = Literal["cpu", "cuda", "warp-cpu"]
LearnerDevice = Literal["as-device", "cpu", "cuda"]

RUN_SCHEMA = "pupper-run"
RUN_VERSION = 3
RUN_FILE = "run.yaml"
PROGRESS = "progress.csv"
LARGEST_CURVES_BYTES = 100e6
_OF_TEACHER = (*CLOCK, "clock_duty", "crouch", "spread")  # parameters of its rewards
# settings that say what actions mean
_OF_ACTIONS = ("action_scale", "control_step_s", "knee", "robot", "robot_config")
_TEACHING = 0.6  # of a run's time: the most that its own teacher may take
_DROPPED: dict[type, set[str]] = {
    Observation: {"privileged_critic"},
    Hyperparameters: {"initial_std"},
    Exploration: {"persistence_s"},
    Curriculum: {"on", "stages", "stage_steps", "easiest", "action_scale", "delay"},
    Rewards: {"clock", "flight", "progress_in_time"},
}
"""Settings of older files that say nothing of how a policy walks."""
_OLD_TROT = {"back_gain": 1.0, "side_gain": 1.0}  # before these were settings
_OLD_RAMP = {"first": 1.0, "last": 1.0, "begin": 0.0, "end": 0.0}  # four settings before version 3


@dataclass(frozen=True)
class Run:
    """All settings of a training run."""

    actuator: str = "calibrated.yaml"
    """A calibration (`pupper-sysid calibrate` writes one), `paper`, `release` or `ideal`; or a
    servo model's folder (`pupper-sysid fit-servo`)."""
    feedback: str = "held"
    """`held`: readings as the calibration measured them; `ideal`: fresh and exact; or another
    calibration whose feedback to take."""
    architecture: Architecture = field(default_factory=Architecture)
    task: Walking = field(default_factory=Walking)
    first_gait: Literal["auto", "fit", "keep"] = "auto"
    """`auto`: where the open-loop trot walks badly on the servos, one that suits them is searched
    before the training (a minute on two cores), imitated, and written into `task.trot`; `fit`:
    search in any case; `keep`: take `task.trot` as it is."""
    learner: Hyperparameters = field(default_factory=Hyperparameters)
    imitation: Imitation = field(default_factory=Imitation)
    environments: int = 512
    """Number of robots that learn together (per process)."""
    iterations: int = 400
    """Updates of PPO, after imitation; training ends when they are done."""
    minutes: float = 120.0
    """Training ends after this time, too, of which the first gait and a teacher are parts; the
    policy so far is saved and plays."""
    threads: int = 0
    """Of physics and of torch, each; 0 for all cores (one per process with torchrun)."""
    device: Device = "cpu"
    """Where the physics is computed: `cpu` by MuJoCo; `cuda` by mujoco-warp on a GPU, `warp-cpu`
    by mujoco-warp on one core, to try it (extra `gpu`)."""
    learner_device: LearnerDevice = "as-device"
    """Where the networks learn; by default where the physics is computed."""
    seed: int = 0
    """Of everything that is drawn."""

    def __post_init__(self):
        _refuse_impossible(self)


def preset(
    name: Literal["fast", "paper", "release"], kind: Kind, start: Start = "imitation"
) -> Run:
    """Complete settings for one kind of policy.

    `fast` suits a few cores; `paper` and `release` follow the published sizes and always start from
    nothing.
    """
    if name == "fast":
        if start == "teacher":
            return _teacher(kind)
        run = _first_gait_imitated(kind)
        return run if start == "imitation" else _from_scratch(run)
    wide = (512, 256, 128)
    return Run(
        architecture=Architecture(kind, wide, 128, wide, privileged_critic=False),
        task=PRESETS[name],
        learner=Hyperparameters(
            epochs=5, learning_rate=1e-3, value_weight=1.0, normalise=False,
            exploration=Exploration((1.0, 1e-6), by_dead_band=False,
                                    learned=True),
            entropy=0.0025 if kind == "mlp" else 0.005,
        ),
        imitation=Imitation(iterations=0), environments=4096, iterations=20_000, minutes=1e6,
    )  # fmt: skip


def _first_gait_imitated(kind: Kind) -> Run:
    without_memory = kind in ("mlp", "mlp-actions")
    # without a memory, reading the gait's phase off one action takes a wide network
    hidden = (512, 256, 128) if without_memory else (128, 64)
    steps = 8 if without_memory else 16
    return Run(
        architecture=Architecture(kind, hidden, 64, (256, 128, 64)), task=PRESETS["fast"],
        learner=Hyperparameters(
            # many small updates with little white noise: noise that lasts is credited with what it
            # does in the other half of a stride, and more of it loosens dry friction; at a
            # divergence of 0.01 an MLP's score fell by 0.02 in 200 updates, at 0.02 it rose by 0.02
            steps_per_environment=steps, epochs=3, critic_warmup=40, freeze_normaliser=True,
            desired_kl=0.02 if without_memory else 0.01, learning_rate=1e-5, discount=0.97,
            gae_lambda=0.9,
            # with this noise robots are slower and less exact than without, as are policies that
            # learn with it for long
            exploration=Exploration((0.025, 0.008), (0.0, 1.0)),
            mirror=without_memory, averaging=50,
        ),
        # after 8 rounds a policy walks as well as after 12
        imitation=Imitation(8, rollouts=240 // steps, minibatches=4 if without_memory else 16),
        environments=512, iterations=16_000 // steps,
    )  # fmt: skip


def _from_scratch(run: Run) -> Run:
    taught = PRESETS["scratch"]
    pushes = {n: getattr(taught.randomisation, n) for n in ("push_m_s", "push_every_s")}
    # only the teacher's reward of its stance is kept: the others hold a policy to the gait by which
    # the teacher learned to step
    gait = {name: getattr(taught.rewards, name) for name in ("crouch", "spread", *CLOCK)}
    task = replace(
        run.task, rewards=replace(run.task.rewards, stance=0.5 * taught.rewards.stance, **gait),
        randomisation=replace(run.task.randomisation, **pushes),
    )  # fmt: skip
    # a network is learned from more easily than a trot that bends sharply
    rollouts = 64 // run.learner.steps_per_environment
    imitation = replace(run.imitation, teacher=OWN, iterations=16, rollouts=rollouts, epochs=6)
    return replace(run, task=task, imitation=imitation, minutes=90.0)


def _teacher(kind: Kind) -> Run:
    return Run(
        architecture=Architecture(kind, (128, 64), 64, (256, 128, 64), privileged_actor=True),
        task=PRESETS["scratch"],
        learner=Hyperparameters(
            # many small updates: the step size limits learning, not the noise of the gradient
            steps_per_environment=8, epochs=3, learning_rate=1e-3, desired_kl=0.025,
            learning_rates=(1e-6, 2e-3), discount=0.97, gae_lambda=0.9,
            # noise that lasts over half a stride would be rewarded for what it does in the other
            exploration=Exploration((0.06, 0.012), (0.4, 6.0)),
            mirror=True,
        ),
        imitation=Imitation(iterations=0), environments=512, iterations=1700, minutes=60.0,
    )  # fmt: skip


def with_robot(run: Run, robot: str | Path, robot_config: str | Path | None) -> Run:
    """The run for another robot than the Mini Pupper 2, its task scaled by that one's size."""
    task = for_robot(run.task, robot, robot_config)
    mirror = run.learner.mirror and task.body.mirror_joints is not None
    return replace(run, task=task, learner=replace(run.learner, mirror=mirror))


def teacher_of(run: Run) -> Run:
    """Settings of the teacher that a run trains for itself: for the same robot and actions."""
    base = _teacher("mlp")
    if run.task.robot:
        base = with_robot(base, run.task.robot, run.task.robot_config)
    rewards = replace(base.task.rewards, **{n: getattr(run.task.rewards, n) for n in _OF_TEACHER})
    steps = run.task.control_step_s / base.task.physics_step_s
    even = abs(steps - round(steps)) < 1e-6
    task = replace(
        base.task, rewards=rewards,
        physics_step_s=base.task.physics_step_s if even else run.task.physics_step_s,
        **{name: getattr(run.task, name) for name in _OF_ACTIONS},
    )  # fmt: skip
    return replace(
        base, task=task, actuator=run.actuator, feedback=run.feedback, threads=run.threads,
        device=run.device, learner_device=run.learner_device, seed=run.seed,
        minutes=_TEACHING * run.minutes,
    )  # fmt: skip


def check_teacher(folder: Path, run: Run) -> Run:
    """Settings of a teacher's run, which `run` is to learn from."""
    teacher = load_run(folder)
    if not teacher.architecture.privileged_actor:
        raise InputError(
            f"{folder} is not a teacher: its policy acts by no clock. Give the folder "
            "of a run of `pupper-train --start teacher`."
        )
    same = [(f"task.{name}", teacher.task, run.task) for name in _OF_ACTIONS]
    same += [(f"task.rewards.{name}", teacher.task.rewards, run.task.rewards) for name in CLOCK]
    for name, *of in same:
        trained, value = (getattr(part, name.rsplit(".", 1)[1]) for part in of)
        if trained != value:
            raise InputError(
                f"The teacher in {folder} was trained with {name} {trained}, this run has {value}. "
                "Give both the same."
            )
    return teacher


def load_run(folder: Path) -> Run:
    """Settings of the run in `folder`."""
    path = folder / RUN_FILE
    model = create_model("File", settings=(_model_of(Run), ...))
    data, lines = _read(path)
    file: Any = validated(model, data, path, lines)
    return _dataclass_of(Run, file.settings)


def resume_run(folder: Path, iterations: int | None, minutes: float | None) -> Run:
    """Settings of a resumed run, perhaps with a new end, which is written to its file."""
    path, run = folder / RUN_FILE, load_run(folder)
    before, source = _read(path)[0].get("actuator_sha256"), Path(run.actuator)
    if before and not source.is_file():
        raise InputError(
            f"{run.actuator}, with which {folder} was trained, is not there. Put it back, or go to "
            "the folder where the run was begun."
        )
    if before and sha256(source) != before:
        raise InputError(
            f"{run.actuator} is no longer the file with which {folder} was begun. Put that back, "
            "or start a new run with this one."
        )
    longer = replace(
        run,
        iterations=run.iterations if iterations is None else iterations,
        minutes=run.minutes if minutes is None else minutes,
    )
    if longer != run:
        _write(path, longer)
    return longer


def _read(path: Path) -> tuple[dict[str, Any], dict[Place, int]]:
    if not path.exists():
        raise InputError(f"{path.parent} holds no run: there is no {RUN_FILE} in it.")
    content, lines = read_yaml(path)
    if not isinstance(content, dict) or content.get("schema") != RUN_SCHEMA:
        raise InputError(f"{path} is not the settings of a training run.")
    refuse_other_version(path, content.get("schema_version"), RUN_VERSION)
    with suppress(KeyError, TypeError):  # refused later
        task = content["settings"]["task"]
        task["trot"] = {**_OLD_TROT, **task["trot"]}
    if content["schema_version"] < 3:
        with suppress(KeyError, TypeError, AttributeError):  # refused later
            ramps = content["settings"]["task"]["curriculum"]
            for name, ramp in ramps.items():
                if isinstance(ramp, dict):
                    ramps[name] = [{**_OLD_RAMP, **ramp}[key] for key in _OLD_RAMP]
    return content, lines


@cache
def _model_of(kind: type) -> type[BaseModel]:
    """Strict pydantic model with the fields of the dataclass `kind`, none of them required."""
    kinds: dict[str, Any] = dict.fromkeys(_DROPPED.get(kind, ()), Any) | _kinds_of(kind)
    for name, field_type in kinds.items():
        if is_dataclass(field_type):
            kinds[name] = _model_of(cast("type", field_type))
        elif get_origin(field_type) is tuple:
            kinds[name] = Annotated[field_type, Field(strict=False)]  # files have lists
    optional: dict[str, Any] = {name: (field_type, None) for name, field_type in kinds.items()}
    config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
    return create_model(kind.__name__, __config__=config, **optional)


_kinds_of = cache(get_type_hints)


def _dataclass_of(kind: type, settings: Any) -> Any:
    """The dataclass `kind` with `settings`; the others have their defaults."""
    kinds, values = _kinds_of(kind), {}
    for name in settings.model_fields_set & set(kinds):
        value = getattr(settings, name)
        values[name] = _dataclass_of(kinds[name], value) if is_dataclass(kinds[name]) else value
    return kind(**values)


def save_run(folder: Path, run: Run) -> None:
    """Write the settings of a run that begins."""
    refuse_taken(folder)
    _write(folder / RUN_FILE, run)


def refuse_taken(folder: Path) -> None:
    """Raise if the folder holds a run already."""
    if (folder / RUN_FILE).exists():
        raise InputError(
            f"{folder} holds a run already. Go on with it with `resume={folder}`, or give another "
            "`name`."
        )


def _write(path: Path, run: Run) -> None:
    source = Path(run.actuator)
    content = {
        "schema": RUN_SCHEMA,
        "schema_version": RUN_VERSION,
        "settings": plain(run),
        "actuator_sha256": sha256(source) if source.is_file() else None,
        "versions": versions("torch", "rsl-rl-lib"),
    }
    text = "# Settings of a training run, written by pupper-train.\n"
    write_text(path, text + yaml.safe_dump(content, sort_keys=False), force=True)


_LARGEST = 1e9
_MOST_LAYERS = 16
_RANGES: dict[str, tuple[float, float]] = {
    "environments": (1, 1_000_000),
    "iterations": (1, 10_000_000),
    "minutes": (1e-3, 1e8),
    "threads": (0, 4096),
    "architecture.hidden": (1, 8192),
    "architecture.critic_hidden": (1, 8192),
    "architecture.memory": (1, 8192),
    "task.episode_s": (1e-3, 3600),
    "task.physics_step_s": (1e-4, 0.1),
    "task.control_step_s": (1e-3, 1),
    "task.action_scale": (1e-3, 10),
    "learner.steps_per_environment": (1, 10_000),
    "learner.epochs": (1, 1000),
    "learner.minibatches": (1, 1_000_000_000),
    "learner.averaging": (1, 1_000_000),
    "learner.learning_rate": (1e-12, 10),
    "learner.learning_rates": (1e-12, 10),
    "learner.critic_learning_rate": (1e-12, 10),
    "learner.discount": (0, 1),
    "learner.gae_lambda": (0, 1),
    "imitation.iterations": (0, 1_000_000),
    "imitation.rollouts": (1, 1_000),
    "imitation.epochs": (1, 10_000),
    "imitation.minibatches": (1, 1_000_000_000),
    "imitation.learning_rate": (1e-12, 10),
}
"""Smallest and largest value, by the dotted name of a setting."""


def _refuse_impossible(run: Run) -> None:
    """Refuse settings outside their ranges: a misprint, or what fills the memory.

    They come from the command line and from a run's file, which may be damaged or anybody's. The
    ranges are far wider than anything that trains.
    """
    for name, value in _numbers(run, ""):
        low, high = _RANGES.get(name, (-_LARGEST, _LARGEST))
        if name != "seed" and not low <= value <= high:  # NaN is in no range
            text = str(value)[:20]
            raise InputError(f"{name} is {text}; it must be from {low:g} to {high:g}.")
    if not 0 <= run.seed < 2**63:  # what torch's generators take
        raise InputError(f"seed is {str(run.seed)[:24]}; it must be 0 or more, below 2^63.")
    for name in ("hidden", "critic_hidden"):
        layers = len(getattr(run.architecture, name))
        if not layers:
            raise InputError(f"architecture.{name} is empty; give the units of each layer.")
        if layers > _MOST_LAYERS:
            raise InputError(f"architecture.{name} has {layers} layers; at most {_MOST_LAYERS}.")
    if run.architecture.privileged_actor and run.architecture.kind != "mlp":
        raise InputError(
            f"A teacher is an MLP, not a policy of kind {run.architecture.kind}. What learns from "
            "it can be of any kind."
        )
    if not min(run.learner.exploration.std) > 0:
        raise InputError("learner.exploration.std must be positive.")
    samples = run.environments * run.learner.steps_per_environment
    if run.learner.minibatches > samples:
        raise InputError(
            f"learner.minibatches is {run.learner.minibatches}; an update has {samples} samples."
        )


def _numbers(settings: Any, before: str) -> Iterator[tuple[str, float]]:
    for setting in fields(settings):
        value, name = getattr(settings, setting.name), f"{before}{setting.name}"
        if is_dataclass(value):
            yield from _numbers(value, f"{name}.")
            continue
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, int | float) and not isinstance(number, bool):
                yield name, number
