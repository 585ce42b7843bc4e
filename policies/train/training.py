"""A training run: a folder with its settings, curves, checkpoints and policies.

`train` begins or resumes one. Its folder holds `run.yaml` (settings, seed, hashes, versions),
`progress.csv` and TensorBoard events (one row per update), `last.pt` and `best.pt` (checkpoints,
see `policies.train.learner`), and `policy_last/`, `policy_best/` (see
`policies.network.policy_file`). The best has the highest score so far (`policies.train.selection`),
imitation alone included; that is also kept as `policy_imitated/`, so that PPO's share can be
measured. The last is written with every checkpoint and at every stop. A run that learns from a
teacher of its own has that teacher's run in `teacher/`, which has no policies: they would see what
no robot can.
"""

from __future__ import annotations

import csv
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from pupper_sysid.common.border import read_text
from pupper_sysid.common.errors import InputError, PupperError
from pupper_sysid.common.files import write_text
from pupper_sysid.common.processes.stop import finishing
from pupper_sysid.common.processes.workers import keep_freed_memory
from pupper_sysid.common.reading.content import refuse_more
from pupper_sysid.common.reading.dialect import whole_number
from pupper_sysid.policies.network.policy_file import write_policy
from pupper_sysid.policies.train.imitation import (
    LearnedTeacher,
    Teacher,
    TrotTeacher,
    imitate,
    load_teacher,
)
from pupper_sysid.policies.train.learner import Learner, Ranks, WalkingVecEnv
from pupper_sysid.policies.train.run_file import (
    LARGEST_CURVES_BYTES,
    OWN,
    PROGRESS,
    RUN_FILE,
    TROT,
    Run,
    refuse_taken,
    resume_run,
    save_run,
    teacher_of,
)
from pupper_sysid.policies.train.selection import Judge
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.servo_ranges import ServoRanges, servo_model_of, servo_ranges

LAST, BEST = "last.pt", "best.pt"
_TEACHER, _POLICY_LAST = "teacher", "policy_last"
_SAVE_EVERY = 10
_UNDONE_WARNS, _UNDONE_END = 10, 50  # updates in a row that are taken back
_IMITATING, _FEWEST_ROUNDS = 0.75, 3  # of the time after a first round; rounds of imitation
_JUDGE_EVERY = 50


@dataclass(frozen=True)
class Progress:
    """Progress of a run, for its watcher."""

    phase: Literal["teacher", "imitation", "ppo"]
    done: int
    total: int
    elapsed_s: float
    row: dict[str, float]
    left_s: float


def make_env(run: Run, ranks: Ranks) -> PupperEnv:
    """The environment of a run (of this process)."""
    threads = threads_of(run, ranks)
    return PupperEnv(
        run.task, servo_ranges(run.actuator, run.feedback, run.task.body),
        run.environments, run.seed + 7919 * ranks.rank, threads,
        servo_model_of(run.actuator, run.task.control_step_s),
        device={"cpu": None, "warp-cpu": "cpu"}.get(run.device, _local(run.device, ranks)),
    )  # fmt: skip


def learner_device(run: Run, ranks: Ranks) -> str:
    """Torch's name of the device on which the networks of this process learn."""
    chosen = run.device if run.learner_device == "as-device" else run.learner_device
    if chosen != "cuda":
        return "cpu"
    if not torch.cuda.is_available():
        raise InputError(
            "torch finds no CUDA device here. Leave `device` and `learner_device` at cpu, or "
            "install a build of torch for CUDA on a machine that has one."
        )
    return _local(chosen, ranks)


def _local(device: str, ranks: Ranks) -> str:
    """The device of this process among those of its machine, which processes may share."""
    if ranks.size == 1:
        return device
    return f"{device}:{ranks.local_rank % max(torch.cuda.device_count(), 1)}"


def threads_of(run: Run, ranks: Ranks) -> int:
    """Number of threads of physics and of torch, each in turn."""
    return run.threads or (1 if ranks.size > 1 else os.cpu_count() or 1)


def make_learner(run: Run, ranks: Ranks) -> Learner:
    """Environment, policy, critic and PPO of a run."""
    torch.set_num_threads(threads_of(run, ranks))
    keep_freed_memory()
    env = make_env(run, ranks)
    return Learner(
        WalkingVecEnv(env, action_history(run, env.servos), learner_device(run, ranks)),
        run.architecture, run.learner, run.seed, ranks,
    )  # fmt: skip


def action_history(run: Run, servos: ServoRanges) -> int:
    """Number of past actions that make the delayed system Markov: those under way, and one."""
    if run.architecture.kind != "mlp-actions":
        return 0
    return int(np.ceil(servos.longest_dead_time_s / run.task.control_step_s)) + 1


def train(
    folder: Path,
    run: Run | None,
    watch: Callable[[Progress], None] | None = None,
    iterations: int | None = None,
    minutes: float | None = None,
    notice: Callable[[str], None] = lambda text: None,
    stopping: Callable[[str], None] = lambda text: None,
    spent_s: float = 0.0,
) -> Learner:
    """Begin a run in an empty folder, or (with `run` None) resume the one in it.

    Ctrl-C, and the end of the run's minutes, end it after the present update, with everything
    saved; a second Ctrl-C ends it at once (KeyboardInterrupt). So does a termination signal if the
    update ends in time; else the process ends within a second. A round of imitation is left at
    once, and repeated when the run is resumed. The run can be resumed from its last checkpoint, and
    its last policy can be played.

    `iterations` and `minutes` are a new end of a resumed run; `spent_s` counts towards the minutes
    of one that begins. `watch` is called after each update, `notice` with a sentence where a run
    does not go on exactly or its time is short, `stopping` after the first Ctrl-C with what it
    does.

    It is an error if the folder is in use or holds no run to resume, and if a value is no longer
    finite; the networks before are then saved.
    """
    resumed = run is None
    settings = resume_run(folder, iterations, minutes) if run is None else run
    with finishing(stopping) as stop_requested:
        session = _Session(folder, settings, resumed, watch, spent_s, notice)
        if not session.learner.exact and session.ranks.rank == 0:
            notice(
                f"{folder} was begun with another model of the robot, by an older version: it goes "
                "on with the present one, from its networks and poses, not exactly as it would "
                "have."
            )
        session.go(stop_requested)
    return session.learner


class _Session:
    """One session of a run: from its beginning, or from a checkpoint, until its end or a stop."""

    def __init__(
        self,
        folder: Path,
        run: Run,
        resumed: bool,
        watch: Callable[[Progress], None] | None,
        spent_s: float = 0.0,
        notice: Callable[[str], None] = lambda text: None,
    ):
        self.notice, self.undone = notice, 0  # updates in a row that were taken back
        begun = time.monotonic()
        self.ranks = Ranks.join()
        self.folder, self.run, self.watch = folder, run, watch
        self.learner = make_learner(run, self.ranks)
        env = self.learner.env.env
        self.judge = Judge(
            run.task, env.servos, run.seed, threads_of(run, self.ranks),
            servo_model_of(run.actuator, run.task.control_step_s), action_history(run, env.servos),
            self.learner.env.device,
        )  # fmt: skip
        self.counters: dict[str, Any] = {
            "elapsed_s": spent_s, "imitated": 0, "best": None, "scores": {},
        }  # fmt: skip
        if resumed:
            self.counters = self.learner.load(folder / _rank_file(LAST, self.ranks))
        else:
            self._begin()
        self.done_before = {
            "imitation": self.counters["imitated"], "ppo": self.learner.iteration,
        }  # fmt: skip
        self.writer = CurveWriter(folder, self.done_before) if self.ranks.rank == 0 else None
        self.started = begun - self.counters["elapsed_s"]
        self.phase_began = self.started

    def _begin(self) -> None:
        """Write a first checkpoint, then the settings: from then on the run can be resumed."""
        if self.run.imitation.iterations and self.run.imitation.teacher not in (TROT, OWN):
            # refuse an unreadable file before the folder is made
            with torch.random.fork_rng(devices=[]):
                teacher = Path(self.run.imitation.teacher)
                load_teacher(teacher, BEST, self.run, self.learner.observations)
        if self.ranks.rank == 0:
            refuse_taken(self.folder)
        self.ranks.any(False)  # no process writes before that
        self.save(LAST)
        self.ranks.any(False)  # all have a checkpoint before there is a run to resume
        if self.ranks.rank == 0:
            save_run(self.folder, self.run)

    def go(self, stop_requested: Callable[[], bool]) -> None:
        """All that remains of the run, until its end or a stop; then everything is saved."""

        def ends() -> bool:
            """Whether to stop; all processes agree."""
            late = time.monotonic() - self.started >= 60 * self.run.minutes
            return self.ranks.any(stop_requested() or late)

        if self.learn_first_gait(ends):
            self.improve(ends)
            self.save(LAST)
        self.write_policy(_POLICY_LAST)
        if self.writer:
            self.writer.close()

    def learn_first_gait(self, ends: Callable[[], bool]) -> bool:
        """The remaining rounds of imitation; whether all that was learned is in a checkpoint."""
        learner = self.learner
        if self.counters["imitated"] >= self.rounds or ends():
            return True
        teacher = self.teacher(ends)
        self.phase_began = time.monotonic()
        while teacher and self.counters["imitated"] < self.rounds and not ends():
            before, begun = learner.networks(), time.monotonic()
            settings = replace(self.run.imitation, iterations=self.rounds)
            error = imitate(learner, teacher, settings, self.counters["imitated"], ends)
            if error is None:
                self.refuse_nan(before, [])
                return False
            self.refuse_nan(before, [error])
            self.counters["imitated"] += 1
            self.counters["teacher"] = teacher.state
            if self.counters["imitated"] == 1:
                self.plan_rounds(time.monotonic() - begun)
            self.report("imitation", self.counters["imitated"], self.rounds, {"difference": error})
            self.save(LAST)
            self.write_policy(_POLICY_LAST)
        return True

    @property
    def rounds(self) -> int:
        """Rounds of imitation; fewer than the run's where its minutes are too few for them."""
        return self.counters.get("rounds", self.run.imitation.iterations)

    def plan_rounds(self, round_s: float) -> None:
        """After the first of its rounds, plan as many as most of the time is enough for.

        The learning rate falls to 0 with the last round: one that was cut off would walk worse than
        one of fewer rounds.
        """
        rounds = self.run.imitation.iterations
        remaining_s = 60 * self.run.minutes - (time.monotonic() - self.started)
        fit = 1 + int(_IMITATING * remaining_s / max(self.ranks.mean(round_s), 1e-9))
        planned = int(self.ranks.mean(max(fit, _FEWEST_ROUNDS)))
        if planned < rounds:
            self.counters["rounds"] = planned
            self.notice(
                f"A round of the first gait takes {round_s:.0f} s, so that {planned} of {rounds} "
                f"are made within {self.run.minutes:g} minutes."
            )

    def teacher(self, ends: Callable[[], bool]) -> Teacher | None:
        """What shows the first gait; a teacher of the run itself is trained first, or to its end.

        None if a stop came first.
        """
        learner, teacher = self.learner, self.run.imitation.teacher
        state = self.counters.get("teacher")
        if teacher == TROT:
            return TrotTeacher(learner.env, state)
        # a resumed run is to draw what it would have drawn
        with torch.random.fork_rng(devices=[]):
            folder = Path(teacher) if teacher != OWN else self._train_teacher(ends)
        if ends():
            return None
        with torch.random.fork_rng(devices=[]):
            network = load_teacher(folder, BEST, self.run, learner.observations)
        return LearnedTeacher(learner.env, network, state)

    def _train_teacher(self, ends: Callable[[], bool]) -> Path:
        folder = self.folder / _TEACHER
        begun = (folder / RUN_FILE).is_file()
        teacher = resume_run(folder, None, None) if begun else teacher_of(self.run)
        watch = self.watch
        watcher = watch and (lambda progress: watch(replace(progress, phase="teacher")))
        session = _Session(folder, teacher, begun, watcher)
        session.go(ends)
        self.ranks.any(False)  # after the first process has written it
        # its time counts for this run, also after a kill
        now = time.monotonic()
        elapsed = max(now - self.started, session.counters["elapsed_s"])
        self.counters["elapsed_s"], self.started = elapsed, now - elapsed
        return folder

    def improve(self, ends: Callable[[], bool]) -> None:
        """Updates of PPO, until they are done, time is up or a stop is requested."""
        if self.counters["imitated"] < self.rounds or ends():
            return
        learner, episodes = self.learner, EpisodeMeans(self.learner.env.num_envs)
        if not self.counters["scores"]:
            self.counters["scores"] = self.judge(learner.averaged)
            self.keep_best()  # of imitation alone, so that PPO must be better
            if self.run.imitation.iterations:
                self.write_policy("policy_imitated")
        self.phase_began = time.monotonic()
        while learner.iteration < self.run.iterations and not ends():
            begun = time.perf_counter()
            learner.rollout(episodes)
            collected = time.perf_counter()
            before = learner.networks()
            losses = learner.update()
            ended = time.perf_counter()
            self.refuse_nan(before, losses.values())
            row = episodes.row() | {
                "value_loss": losses["value"],
                **{name: losses[name] for name in ("kl", "clip_fraction")},
                "std": learner.std,
                "learning_rate": learner.ppo.learning_rate,
                "nan_resets": learner.env.env.nan_resets,
                "samples": learner.samples,
                "collect_s": collected - begun,
                "update_s": ended - collected,
            }
            judged = learner.iteration % _JUDGE_EVERY == 0
            if judged:
                self.counters["scores"] = self.judge(learner.averaged)
            self.report(
                "ppo", learner.iteration, self.run.iterations, row | self.counters["scores"]
            )
            if judged:
                self.keep_best()
            if self.stuck():
                return
            if learner.iteration % _SAVE_EVERY == 0:
                self.save(LAST)  # after the best, or a resumed run would not know its best
                self.write_policy(_POLICY_LAST)

    def stuck(self) -> bool:
        """Whether PPO's updates are taken back again and again, so that the policy stays as it is.

        A notice follows when they repeat, and advice when the run ends because of it.
        """
        self.undone = self.undone + 1 if self.learner.taken_back else 0
        if self.undone not in (_UNDONE_WARNS, _UNDONE_END):
            return False
        ends = self.undone == _UNDONE_END
        kl = self.run.learner.desired_kl
        self.notice(
            f"The last {self.undone} updates of PPO were taken back, because each changed the "
            "actions too much: the policy stays as it is. "
            + ("The run ends here. " if ends else f"The run ends after {_UNDONE_END} of them. ")
            + f"Begin one with a larger step per update, `learner.desired_kl` {2 * kl:g}, or with "
            "more noise, `learner.exploration.std`."
        )
        return ends

    def keep_best(self) -> None:
        """Save the policy if it walks better than those before."""
        score, best = self.ranks.mean(self.counters["scores"]["score"]), self.counters["best"]
        if best is None or score > best:
            self.counters["best"] = score
            self.save(BEST)
            self.write_policy("policy_best")

    def save(self, name: str) -> None:
        """Write a checkpoint."""
        self.learner.save(self.folder / _rank_file(name, self.ranks), self.counters)

    def write_policy(self, name: str) -> None:
        """Write a policy folder."""
        if self.ranks.rank != 0 or self.run.architecture.privileged_actor:
            return  # a policy that sees privileged observations cannot run on a robot
        servos = self.learner.env.env.servos
        about = {
            "iteration": self.learner.iteration, "imitation_rounds": self.counters["imitated"],
            **self.counters["scores"], "seed": self.run.seed, "samples": self.learner.samples,
            "elapsed_s": self.counters["elapsed_s"],
        }  # fmt: skip
        # new networks draw their weights, which must not change what the run draws
        with torch.random.fork_rng(devices=[], enabled=name == _POLICY_LAST):
            write_policy(
                self.folder / name, self.learner.averaged.state_dict(), self.run, servos,
                action_history(self.run, servos), about,
                command_share=self.learner.env.env.level["commands"],
            )  # fmt: skip

    def report(
        self, phase: Literal["imitation", "ppo"], done: int, total: int, row: dict[str, float]
    ) -> None:
        """Write one row of the curves and call the watcher."""
        now = time.monotonic()
        elapsed = self.counters["elapsed_s"] = now - self.started
        row = {"elapsed_s": elapsed, **row}
        if self.writer:
            self.writer.write(phase, done, row)
        if self.watch and self.ranks.rank == 0:
            steps = max(done - self.done_before[phase], 1)
            remaining_s = (total - done) * (now - self.phase_began) / steps
            remaining_s = min(remaining_s, 60 * self.run.minutes - elapsed)
            self.watch(Progress(phase, done, total, elapsed, row, max(remaining_s, 0.0)))

    def refuse_nan(self, before: dict[str, Any], numbers: Iterable[float]) -> None:
        """Raise if any value is not finite; the networks `before` are then saved."""
        learner, last = self.learner, self.folder / LAST
        fine = all(np.isfinite(x) for x in numbers) and learner.finite
        if not self.ranks.any(not fine):
            return
        learner.take_back(before)
        if self.ranks.any(not learner.finite):
            raise PupperError(
                f"The simulation gave observations that are not numbers after update "
                f"{learner.iteration}. Nothing was saved; {last} is what it was before."
            )
        # a resumed run then collects other data with the networks from before
        self.save(LAST)
        raise PupperError(
            f"The policy's numbers are not finite after update {learner.iteration}. The "
            f"networks before that are in {last}: `resume={self.folder}` goes on "
            "from them; if it happens again, start a run with a lower `learning_rate`."
        )


def _rank_file(name: str, ranks: Ranks) -> str:
    """Name of a rank's checkpoint; each rank has its own environments."""
    return name if ranks.rank == 0 else name.replace(".pt", f".rank{ranks.rank}.pt")


_NUMBER = 40  # characters of a row that may hold its number
MOST_ROWS = 1_000_000


class EpisodeMeans:
    """Means over the steps of an update: reward and its terms, falls, lengths of episodes."""

    def __init__(self, environments: int):
        self._length = np.zeros(environments)
        self._terms: list[dict[str, float]] = []
        self._ended: list[float] = []
        self._falls = self._steps = 0

    def __call__(self, rewards: torch.Tensor, dones: torch.Tensor, extras: dict) -> None:
        done = dones.cpu().numpy().astype(bool)
        self._length += 1
        self._ended += self._length[done].tolist()
        self._length[done] = 0
        self._falls += int(done.sum()) - len(extras["terminal_ids"])
        self._steps += len(done)
        self._terms.append({k: float(v.mean()) for k, v in extras["terms"].items()})

    def row(self) -> dict[str, float]:
        """Means since the last call."""
        names = self._terms[0]
        terms = {k: float(np.mean([t[k] for t in self._terms])) for k in names}
        row = {
            "reward": sum(terms.values()),
            "falls_per_1000_steps": 1000 * self._falls / self._steps,
            "episode_steps": float(np.mean(self._ended)) if self._ended else float("nan"),
            **{f"reward.{k}": v for k, v in terms.items()},
        }
        self._terms, self._ended, self._falls, self._steps = [], [], 0, 0
        return row


class CurveWriter:
    """`progress.csv`, `imitation.csv` and TensorBoard, appended to.

    Rows beyond `done` (by phase) are from after the checkpoint that is resumed, and are dropped.
    """

    def __init__(self, folder: Path, done: dict[str, int]):
        from torch.utils.tensorboard import SummaryWriter

        self._paths = {"ppo": folder / PROGRESS, "imitation": folder / "imitation.csv"}
        for phase, path in self._paths.items():
            with _writing(path):
                _drop_rows(path, done[phase])
        with _writing(folder / "tensorboard"):
            self._board = SummaryWriter(str(folder / "tensorboard"))

    def write(self, phase: str, step: int, row: dict[str, float]) -> None:
        """One row."""
        path = self._paths[phase]
        with _writing(path):
            new = not path.exists()
            with path.open("a", newline="") as file:
                writer = csv.writer(file)
                if new:
                    writer.writerow(["update", *row])
                writer.writerow([step, *(f"{v:.6g}" for v in row.values())])
            for name, value in row.items():
                self._board.add_scalar(f"{phase}/{name}", value, step)

    def close(self) -> None:
        """Finish writing."""
        self._board.close()


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Turn a failed write (full disk, no permission) into an `InputError`."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror or error}.") from error


def _drop_rows(path: Path, last: int) -> None:
    """Keep a table's header and its rows up to update `last`."""
    if not path.exists():
        return
    text = read_text(path, LARGEST_CURVES_BYTES)
    refuse_more(path, text.count("\n"), MOST_ROWS, "rows")
    header, *rows = text.splitlines(keepends=True) or [""]
    rows_before = [row for row in rows if _update(row[:_NUMBER]) <= last]
    if rows_before != rows:
        write_text(path, "".join([header, *rows_before]), force=True)


def _update(row: str) -> float:
    """Number of a row's update; infinite where there is none."""
    with suppress(ValueError):
        return whole_number(row.split(",")[0])
    return math.inf
