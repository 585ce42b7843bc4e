"""A training run: a folder with its settings, curves, checkpoints and policies.

`train` begins or resumes one. Its folder holds `run.yaml` (settings, seed, hashes, versions),
`progress.csv` and TensorBoard events (one row per update), `last.pt` and `best.pt` (checkpoints,
see `policies.learner`), and `policy_last/`, `policy_best/` (see `policies.policy_file`).
"""

from __future__ import annotations

import csv
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from common.errors import InputError, PupperError
from common.files import write_text
from common.memory import keep_freed_memory
from policies.imitation import imitate
from policies.learner import Learner, Ranks
from policies.policy_export import write_policy
from policies.run_file import Run, load_run, save_run
from policies.vec_env import WalkingVecEnv
from sim.servo_ranges import ServoRanges, servo_model_of, servo_ranges
from sim.walking_env import PupperEnv

LAST, BEST, PROGRESS = "last.pt", "best.pt", "progress.csv"
_SMOOTHED = 0.1  # weight of the newest update in the mean reward that decides what is best


@dataclass(frozen=True)
class Progress:
    """Where a run stands; handed to whoever watches it."""

    phase: Literal["imitation", "ppo"]
    done: int
    total: int
    elapsed_s: float
    row: dict[str, float]
    left_s: float


def make_env(run: Run, ranks: Ranks, servos: ServoRanges | None = None) -> PupperEnv:
    """The environment of a run (of this process)."""
    threads = threads_of(run, ranks)
    return PupperEnv(
        run.task, servos or servo_ranges(run.actuator, run.feedback), run.environments,
        run.seed + 7919 * ranks.rank, threads,
        servo_model_of(run.actuator, run.task.control_step_s),
    )  # fmt: skip


def threads_of(run: Run, ranks: Ranks) -> int:
    """How many threads physics and torch may use, each in turn."""
    return run.threads or (1 if ranks.size > 1 else os.cpu_count() or 1)


def make_learner(run: Run, ranks: Ranks) -> Learner:
    """Environment, policy, critic and PPO of a run."""
    torch.set_num_threads(threads_of(run, ranks))
    keep_freed_memory()
    env = make_env(run, ranks)
    return Learner(
        WalkingVecEnv(env, action_history(run, env.servos), ranks.device), run.architecture,
        run.learner, run.seed, ranks,
    )  # fmt: skip


def action_history(run: Run, servos: ServoRanges) -> int:
    """How many past actions make the delayed system Markov: those still on their way, and one."""
    if run.architecture.kind != "mlp-actions":
        return 0
    return int(np.ceil(servos.longest_delay_s / run.task.control_step_s)) + 1


def train(
    folder: Path,
    run: Run | None,
    watch: Callable[[Progress], None] | None = None,
) -> Learner:
    """Begin a run in an empty folder, or (with `run` None) resume the one in it.

    Ctrl-C (or a termination signal) ends it after the present update, with everything saved.

    Parameters
    ----------
    folder : Path
    run : Run or None
    watch : callable, optional
        Called after each update.

    Raises
    ------
    InputError
        If the folder is in use, or holds no run to resume.
    PupperError
        If the numbers stop being numbers; the networks before are saved.
    """
    ranks = Ranks.join()
    resumed = run is None
    if run is None:
        run = load_run(folder)
    learner = make_learner(run, ranks)
    counters: dict[str, Any] = {"elapsed_s": 0.0, "imitated": 0, "smooth": None, "best": None}
    if resumed:
        counters = learner.load(folder / _rank_file(LAST, ranks))
    elif ranks.rank == 0:
        save_run(folder, run)
    done_before = {"imitation": counters["imitated"], "ppo": learner.iteration}
    writer = _Writer(folder, done_before) if ranks.rank == 0 else None
    started = time.monotonic() - counters["elapsed_s"]
    episodes = _Episodes(learner.env.num_envs)

    def save(name: str) -> None:
        learner.save(folder / _rank_file(name, ranks), counters)

    def write(name: str) -> None:
        if ranks.rank == 0:
            history = action_history(run, learner.env.env.servos)
            about = {
                "iteration": learner.iteration, "imitation_rounds": counters["imitated"],
                "reward": counters["smooth"], "seed": run.seed,
                "samples": learner.iteration * samples_per_update,
                "elapsed_s": counters["elapsed_s"],
            }  # fmt: skip
            write_policy(
                folder / name, learner.actor.state_dict(), run, learner.env.env.servos, history,
                about,
            )  # fmt: skip

    samples_per_update = learner.hyper.steps_per_environment * learner.env.num_envs * ranks.size

    def left(phase: str, now: int, total: int) -> float:
        steps = max(now - done_before[phase], 1)
        at_this_pace = (total - now) * (time.monotonic() - phase_began[phase]) / steps
        until_time_is_up = 60 * run.minutes - counters["elapsed_s"]
        return max(min(at_this_pace, until_time_is_up) if phase == "ppo" else at_this_pace, 0.0)

    phase_began: dict[str, float] = {}

    def report(phase: Literal["imitation", "ppo"], done: int, total: int, row: dict) -> None:
        counters["elapsed_s"] = time.monotonic() - started
        row = {"elapsed_s": counters["elapsed_s"], **row}
        if writer:
            writer.write(phase, done, row)
        if watch and ranks.rank == 0:
            remaining = left(phase, done, total)
            watch(Progress(phase, done, total, counters["elapsed_s"], row, remaining))

    def refuse_nan(before: dict[str, Any], numbers: Iterable[float]) -> None:
        fine = all(np.isfinite(x) for x in numbers) and learner.finite
        if not ranks.any(not fine):
            return
        learner.take_back(before)
        if ranks.any(not learner.finite):
            raise PupperError(
                f"The simulation gave observations that are not numbers after update "
                f"{learner.iteration}. Nothing was saved; {folder / LAST} is what it was before."
            )
        # a resumed run then collects other data with the networks from before
        save(LAST)
        raise PupperError(
            f"The policy's numbers stopped being numbers after update {learner.iteration}. The "
            f"networks before that are in {folder / LAST}: pupper-train --resume {folder} goes on "
            "from them; if it happens again, start a run with a lower --learner.learning-rate."
        )

    with _interruptible() as asked:

        def asked_to_stop() -> bool:
            return ranks.any(asked())

        phase_began["imitation"] = time.monotonic()
        while counters["imitated"] < run.imitation.iterations and not asked_to_stop():
            before = learner.networks()
            error = imitate(learner, run.imitation, counters["imitated"])
            refuse_nan(before, [error])
            counters["imitated"] += 1
            if counters["imitated"] == run.imitation.iterations:
                _fresh_optimiser(learner)
            report(
                "imitation", counters["imitated"], run.imitation.iterations, {"difference": error}
            )
            if counters["imitated"] % 10 == 0:
                save(LAST)
        phase_began["ppo"] = time.monotonic()
        if counters["imitated"] >= run.imitation.iterations:
            while learner.iteration < run.iterations and not ranks.any(
                asked() or time.monotonic() - started >= 60 * run.minutes
            ):
                begun = time.perf_counter()
                learner.rollout(episodes)
                collected = time.perf_counter()
                before = learner.networks()
                losses = learner.update()
                ended = time.perf_counter()
                refuse_nan(before, losses.values())
                row = episodes.row() | {
                    "value_loss": losses["value"],
                    "entropy": losses["entropy"],
                    "std": float(learner.actor.output_std.detach().mean()),
                    "learning_rate": learner.ppo.learning_rate,
                    "nan_resets": learner.env.env.nan_resets,
                    "samples": learner.iteration * samples_per_update,
                    "collect_s": collected - begun,
                    "update_s": ended - collected,
                }  # fmt: skip
                smooth, reward = counters["smooth"], ranks.mean(row["reward"])
                counters["smooth"] = (
                    reward if smooth is None else smooth + _SMOOTHED * (reward - smooth)
                )
                report("ppo", learner.iteration, run.iterations, row)
                if learner.iteration % 10 == 0:
                    best = counters["best"]
                    if best is None or counters["smooth"] > best:
                        counters["best"] = counters["smooth"]
                        save(BEST)
                        write("policy_best")
                    save(LAST)  # after that, or a resumed run would not know its best
        save(LAST)
    write("policy_last")
    if writer:
        writer.close()
    return learner


def _rank_file(name: str, ranks: Ranks) -> str:
    """Each rank has environments of its own, so each keeps a checkpoint."""
    return name if ranks.rank == 0 else name.replace(".pt", f".rank{ranks.rank}.pt")


def _fresh_optimiser(learner: Learner) -> None:
    """Forget imitation's momentum, and give PPO its own learning rate."""
    ppo = learner.ppo
    ppo.optimizer = torch.optim.Adam(
        [*ppo.actor.parameters(), *ppo.critic.parameters()], lr=learner.hyper.learning_rate
    )
    ppo.learning_rate = learner.hyper.learning_rate


@contextmanager
def _interruptible() -> Iterator[Callable[[], bool]]:
    """Ctrl-C and termination become a question that is asked between updates."""
    asked = False

    def note(number, frame) -> None:
        nonlocal asked
        asked = True

    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = {n: signal.signal(n, note) for n in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _Episodes:
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


class _Writer:
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
    """A full disk, or a folder that may not be written, is said in a sentence."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror or error}.") from error


def _drop_rows(path: Path, last: int) -> None:
    """Keep a table's header and its rows up to update `last`."""
    if not path.exists():
        return
    with path.open(newline="") as file:
        header, *rows = file.readlines() or [""]
    kept = [r for r in rows if r.split(",")[0].isdigit() and int(r.split(",")[0]) <= last]
    if kept != rows:
        write_text(path, "".join([header, *kept]), force=True)
