"""Calibrate the recordings of many robots at once, on some cores or on a Dask cluster.

    fleet = run_fleet(Path("robots"), Path("fleet"), Calibrations(seed=0), jobs=2)
    fleet.table                   # one row per robot and joint

`ServoModels` fits servo models instead.

One recording is one robot. Each gets its own calibration file, written when it is done, so that an
interrupted run continues: a file made from the same bytes with the same settings is kept. A
recording that cannot be used does not stop the others; the reason is in the table. Servos far from
the same joint's on the other robots are marked as outliers.

A Dask scheduler and its workers execute code, and their answers are unpickled here: whoever
controls that address can run programs on this computer. It is therefore never searched for, and
never taken from Dask's configuration, but only from the caller (`trust`).
"""

from __future__ import annotations

import re
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from pupper_sysid.common.errors import InputError, PupperError, refuse_outside
from pupper_sysid.common.files import hold_output, sha256, write_text
from pupper_sysid.common.joints import STALL_TORQUES_NM
from pupper_sysid.common.processes.workers import Workers
from pupper_sysid.common.reading.content import read_limit, reading_up_to
from pupper_sysid.common.signals import robust_sd
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.servo_models.servo_file import load_servo_model
from pupper_sysid.sysid.fit.calibrate import calibrate
from pupper_sysid.sysid.fit.calibration_file import GIVEN_TORQUE
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.servo_fit.data import servo_data
from pupper_sysid.sysid.servo_fit.fit import EACH_GROUP_IN_TURN, Split, fit_servo

TABLE = "fleet.csv"
OUTLIER = 5.0
"""Distance of an outlier from the median of the same joint on all robots, in robust standard
deviations."""
FEWEST = 5  # robots needed to mark outliers

_CONNECT_S = 10
_ADDRESS = re.compile(r"(tls|tcp)://[A-Za-z0-9_.:\[\]-]+:[0-9]{1,5}")


@dataclass
class Fleet:
    """Results of a fleet."""

    table: pd.DataFrame = field(default_factory=pd.DataFrame)
    """One row per robot and joint: `robot`, `joint`, `QUANTITIES`, `outliers` (names of quantities,
    with semicolons), `problem` (a sentence; then the numbers are empty)."""
    kept: list[str] = field(default_factory=list)
    made: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    """`kept`, `made` and `failed`: robots whose calibration was there already, was made, could not
    be made."""
    problems: dict[str, str] = field(default_factory=dict)
    """Why, by robot."""

    def summary(self, out: Path, elapsed_s: float) -> dict[str, Any]:
        """Object of `--json`."""
        return {
            "table": str(out / TABLE), "made": self.made, "kept": self.kept,
            "failed": self.failed, "elapsed_s": elapsed_s,
        }  # fmt: skip


def robots_in(root: Path) -> dict[Path, str]:
    """Recordings in a folder and the folders in it, and what their robots are called."""
    recordings = sorted(
        path
        for path in root.rglob("*.csv")
        if not path.name.endswith(".truth.csv") and path.name != TABLE
    )
    if not recordings:
        raise InputError(f"{root} holds no recording (.csv). Give the folder of your sweeps.")
    # a robot is called as its file, after its folder where there are folders
    names = ["_".join(path.relative_to(root).with_suffix("").parts) for path in recordings]
    twice = {n for n in names if names.count(n) > 1}
    if twice:
        raise InputError(f"{root}: two recordings would be called {min(twice)}. Rename one.")
    return dict(zip(recordings, names, strict=True))


def run_fleet(
    root: Path,
    out: Path,
    product: Product,
    jobs: int = 1,
    cluster: str | None = None,
    force: bool = False,
    progress: Callable[[str], None] | None = None,
) -> Fleet:
    """Make the product of every recording in `root`; one per robot in `out`, and the table.

    Joints of one robot run one after the other, robots in `jobs` processes here, or on the workers
    of a Dask scheduler (`cluster`, `tls://HOST:PORT` or `tcp://HOST:PORT`, see `trust`) that see
    the same folders. `force` makes anew what another recording or other settings made. `progress`
    is called with each robot that is done. Problems of single robots are listed, not raised.
    """
    targets = {path: product.target(out, name) for path, name in robots_in(root).items()}
    if jobs < 1:
        raise InputError(f"`jobs` is {jobs}; it must be at least 1.")
    if cluster is not None:
        trust(cluster)
    hold_output(out / TABLE)
    fleet, todo = Fleet(), []
    for path, target in targets.items():
        same = False
        if target.exists():
            with suppress(PupperError):  # one that cannot be read is left to `make`
                same = product.is_of(target, path)
        if same:
            fleet.kept.append(_called(target))
        elif target.exists() and not force:
            raise InputError(
                f"{target} was made from another recording or with other settings. Choose another "
                "`out`, or replace it with `force=True`."
            )
        else:
            todo.append((path, target))
    tasks = [(product, path, target, read_limit()) for path, target in todo]
    for name, problem in _here(tasks, jobs) if cluster is None else _on(cluster, tasks):
        (fleet.failed if problem else fleet.made).append(name)
        if problem:
            fleet.problems[name] = problem
        if progress:
            progress(name)
    # a robot that failed may have an older target: its numbers would not be this recording's
    usable = [t for t in targets.values() if _called(t) in {*fleet.kept, *fleet.made}]
    rows = [
        {"robot": _called(target), "joint": joint} | row
        for target in usable
        for joint, row in product.numbers(target).items()
    ]
    table = pd.DataFrame(rows, columns=["robot", "joint", *product.quantities])
    table["outliers"] = _outliers(table, product.quantities)
    table["problem"] = ""
    lost = pd.DataFrame([{"robot": n, "problem": p} for n, p in sorted(fleet.problems.items())])
    fleet.table = pd.concat([table, lost], ignore_index=True) if len(lost) else table
    # it says nothing that the robots' own files do not, so it is made anew with each run
    text = fleet.table.to_csv(index=False, lineterminator="\n")
    write_text(out / TABLE, text, force=True)
    return fleet


def _called(target: Path) -> str:
    """The robot of a calibration file or of a folder, whose name may have dots."""
    return target.stem if target.suffix == ".yaml" else target.name


def _one(product: Product, path: Path, target: Path, limit: float) -> tuple[str, str]:
    """Make one robot's; its name, and what went wrong or nothing."""
    try:
        with reading_up_to(limit):
            product.make(path, target)
    except PupperError as error:
        return _called(target), str(error)
    except Exception as error:  # a defect that one robot's log brings out must not cost the others
        at = traceback.extract_tb(error.__traceback__)[-1]
        return _called(target), f"{type(error).__name__}: {error} ({Path(at.filename).name})"
    return _called(target), ""


def trust(cluster: str) -> str:
    """What is risked by computing on a cluster (address of a Dask scheduler), as a sentence."""
    address = _ADDRESS.fullmatch(cluster)
    if address is None:
        raise InputError(
            f"`cluster` is '{printable(cluster)[:60]}'; write out the scheduler's address, such as "
            "tls://host:8786. Schedulers are never searched for, since they execute code."
        )
    risk = (
        f"{cluster} is trusted: it executes code, and its answers are unpickled here, so control "
        "of it is enough to run programs on this computer."
    )
    if address[1] == "tls":
        return risk
    return (
        f"{risk} tcp:// neither authenticates nor encrypts: use it within a network of your "
        "own, else tls:// with certificates (docs/exports.md)."
    )


def _here(tasks: Sequence[tuple[Any, ...]], jobs: int) -> Iterator[tuple[str, str]]:
    """Do tasks of `_one` on processes of this computer."""
    with Workers(jobs, option="jobs") as workers:
        for task in tasks:
            workers.submit(None, _one, *task)
        for _, result in workers.results():
            yield result


def _on(cluster: str, tasks: Sequence[tuple[Any, ...]]) -> Iterator[tuple[str, str]]:
    """Do tasks of `_one` on a cluster's workers."""
    try:
        from distributed import Client
    except ImportError:
        raise InputError(
            "`cluster` needs Dask, which is not installed: `pip install 'pupper-sysid[dask]'`."
        ) from None
    from joblib import Parallel, delayed, parallel_config

    try:
        client = Client(cluster, timeout=_CONNECT_S)
    except (OSError, ValueError) as error:
        raise InputError(
            f"`cluster={cluster}`: no Dask scheduler answers there ({error}). Start one with "
            "`dask scheduler`, and workers with `dask worker ADDRESS`."
        ) from None
    with client, parallel_config(backend="dask"):
        results: Any = Parallel(n_jobs=-1)(delayed(_one)(*task) for task in tasks)
        yield from results


def _outliers(table: pd.DataFrame, quantities: Sequence[str]) -> list[str]:
    """Per row the quantities that are far from the same joint's on the other robots."""
    outlying: list[list[str]] = [[] for _ in range(len(table))]
    for _, rows in table.groupby("joint").groups.items():
        if len(rows) < FEWEST:
            continue
        for key in quantities:
            values = table.loc[rows, key].to_numpy(float)
            middle = np.nanmedian(values)
            apart = values - middle
            spread = robust_sd(apart[np.isfinite(apart)])
            if not spread > 1e-9 * max(abs(middle), 1e-12):
                continue
            for row, value in zip(rows, values, strict=True):
                if abs(value - middle) > OUTLIER * spread:
                    outlying[row].append(key)
    return [";".join(names) for names in outlying]


QUANTITIES = {
    "lag_ms": lambda joint: _ms(joint.lag.lag_s),
    "dead_time_ms": lambda joint: _ms(joint.actuator.dead_time_s),
    "stiffness_per_s2": lambda joint: joint.actuator.ratios_to_armature.stiffness.value,
    "damping_per_s": lambda joint: joint.actuator.ratios_to_armature.damping.value,
    "friction_rad_s2": lambda joint: joint.actuator.ratios_to_armature.friction_loss.value,
    "speed_rad_s": lambda joint: joint.actuator.top_speed_rad_s,
    "poll_period_ms": lambda joint: _ms(joint.feedback.poll_period_s),
    "loss": lambda joint: joint.feedback.loss.value,
    "offset_rad": lambda joint: joint.feedback.offset_rad.value,
    "fit_percent": lambda joint: joint.scores.fit_percent,
}
"""Columns of the table, from each joint's calibration."""


@dataclass(frozen=True)
class Calibrations:
    """A calibration file per robot: what `run_fleet` makes of each recording."""

    seed: int = 0
    stall_torque_nm: float | None = None
    quantities: ClassVar = tuple(QUANTITIES)

    def __post_init__(self):
        refuse_outside("`stall_torque_nm`", self.stall_torque_nm, *STALL_TORQUES_NM, "N·m")

    def target(self, out: Path, robot: str) -> Path:
        """File or folder of what is made, called as the robot is."""
        return out / f"{robot}.yaml"

    def is_of(self, target: Path, path: Path) -> bool:
        """Whether an existing target was made with these settings from this recording."""
        calibration = load_calibration(target)
        scales = [j.actuator.scale for j in calibration.joints.values()]
        torques = {s.value_nm if s.source == GIVEN_TORQUE else None for s in scales}
        return (
            [i.sha256 for i in calibration.inputs] == [sha256(path)]
            and calibration.seed == self.seed
            and torques == {self.stall_torque_nm}
        )

    def make(self, path: Path, target: Path) -> None:
        """Make it; in other processes."""
        result = calibrate(load(path), None, self.seed, self.stall_torque_nm, workers=1)
        result.save(target, force=True)

    def numbers(self, target: Path) -> dict[str, dict[str, float]]:
        """What the table shows, by joint and quantity."""
        joints = load_calibration(target).joints
        return {n: {k: value(j) for k, value in QUANTITIES.items()} for n, j in joints.items()}


def _ms(quantity) -> float:
    return float("nan") if quantity is None else 1e3 * quantity.value


SERVO_QUANTITIES = {
    "free_run_mrad": "rmse_free_run_rad", "held_mrad": "rmse_held_rad",
    "linear_mrad": "linear_rmse_rad", "delayed_pd_mrad": "delayed_pd_rmse_rad",
    "persistence_mrad": "persistence_rmse_rad",
}  # fmt: skip
"""Columns of the table and the scores of the model's contract that they show: unseen data."""


@dataclass(frozen=True)
class ServoModels:
    """A folder of a servo model per robot; the settings are parameters of `fit_servo`."""

    arch: str = "mlp"
    preset: str = "default"
    split: Split = EACH_GROUP_IN_TURN
    readings: str = "auto"
    seed: int = 0
    quantities: ClassVar = tuple(SERVO_QUANTITIES)

    def target(self, out: Path, robot: str) -> Path:
        """See `Calibrations`."""
        return out / robot

    def is_of(self, target: Path, path: Path) -> bool:
        """See `Calibrations`."""
        contract = load_servo_model(target).contract
        data = servo_data([load(path)], list(contract.joints), self.readings, self.seed)
        return (
            [r.sha256 for r in contract.recordings] == [sha256(path)]
            and (contract.arch, contract.preset, contract.seed, contract.split)
            == (self.arch, self.preset, self.seed, self.split.name)
            and contract.readings_counted == data.modes
        )

    def make(self, path: Path, target: Path) -> None:
        """See `Calibrations`."""
        fit_servo(load(path), **vars(self), keep_unfinished=False).save(target, force=True)

    def numbers(self, target: Path) -> dict[str, dict[str, float]]:
        """See `Calibrations`; NaN where a model has no such score."""
        numbers = {}
        for joint, known in load_servo_model(target).contract.joints.items():
            errors = {name: known.scores.get(key) for name, key in SERVO_QUANTITIES.items()}
            numbers[joint] = {k: float("nan") if e is None else 1e3 * e for k, e in errors.items()}
        return numbers


Product = Calibrations | ServoModels
