"""Calibrate the recordings of many robots at once, on some cores or on a Dask cluster.

    fleet = calibrate_fleet(paths, Path("fleet"), Settings(seed=0), jobs=2)
    fleet.table                   # one row per robot and joint

One recording is one robot. Each becomes a calibration file of its own, written when it is done, so
that an interrupted run goes on where it stopped: a file that was made from the same bytes with the
same settings is kept. A recording that cannot be used does not stop the others; its sentence stands
in the table. Servos that are unlike their sisters on the other robots are named.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import numpy as np
import pandas as pd
from joblib import Parallel, delayed, parallel_config

from common.errors import InputError, PupperError
from common.files import sha256, write_text
from servo_models.calibration import Calibration, load_calibration
from sysid.calibrate import calibrate
from sysid.calibration_file import STALL_TORQUE_NM, STALL_TORQUE_SOURCE, to_calibration
from sysid.recording import load

TABLE = "fleet.csv"
UNLIKE = 5.0
"""A servo is named if it is so many robust standard deviations from the median of its sisters."""
FEWEST = 5
"""Robots that it takes to say what is usual."""

QUANTITIES = {
    "lag_ms": lambda joint: _ms(joint.lag.lag_s),
    "delay_ms": lambda joint: _ms(joint.actuator.delay_s),
    "stiffness_per_s2": lambda joint: joint.actuator.ratios_to_armature.stiffness.value,
    "damping_per_s": lambda joint: joint.actuator.ratios_to_armature.damping.value,
    "friction_rad_s2": lambda joint: joint.actuator.ratios_to_armature.friction_loss.value,
    "speed_rad_s": lambda joint: joint.actuator.velocity_limit_rad_s.value,
    "poll_period_ms": lambda joint: _ms(joint.feedback.poll_period_s),
    "loss": lambda joint: joint.feedback.loss.value,
    "offset_rad": lambda joint: joint.feedback.offset_rad.value,
    "fit_percent": lambda joint: joint.scores.fit_percent,
}
"""What the table has of each joint."""


@dataclass(frozen=True)
class Settings:
    """How every recording is calibrated."""

    seed: int = 0
    stall_torque_nm: float = STALL_TORQUE_NM
    source: str = STALL_TORQUE_SOURCE


@dataclass
class Fleet:
    """What became of the recordings.

    Attributes
    ----------
    table : pandas.DataFrame
        One row per robot and joint: `robot`, `joint`, `QUANTITIES`, `unlike` (names of quantities,
        with semicolons), `problem` (a sentence; then the numbers are empty).
    kept, made, failed : list of str
        Robots whose calibration was there already, was made, could not be made.
    """

    table: pd.DataFrame = field(default_factory=pd.DataFrame)
    kept: list[str] = field(default_factory=list)
    made: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)


def recordings_in(folder: Path) -> list[Path]:
    """Recordings in a folder and the folders in it, without the tables that lie beside them.

    Raises
    ------
    InputError
        If there is none, or two would have the same name.
    """
    found = sorted(
        path
        for path in folder.rglob("*.csv")
        if not path.name.endswith(".truth.csv") and path.name != TABLE
    )
    if not found:
        raise InputError(f"{folder} holds no recording (.csv). Give the folder of your sweeps.")
    names = [_name(path, folder) for path in found]
    twice = {n for n in names if names.count(n) > 1}
    if twice:
        raise InputError(f"{folder}: two recordings would be called {min(twice)}. Rename one.")
    return found


def calibrate_fleet(
    root: Path,
    out: Path,
    settings: Settings,
    jobs: int = 1,
    cluster: str | None = None,
    force: bool = False,
    progress: Callable[[str], None] | None = None,
) -> Fleet:
    """Calibrate every recording in `root`.

    Parameters
    ----------
    root : Path
        Folder of recordings.
    out : Path
        Folder for `<robot>.yaml` and the table.
    settings : Settings
    jobs : int
        Processes here; joints of one robot then run one after the other.
    cluster : str, optional
        Address of a Dask scheduler (`tcp://…`) whose workers see the same folders.
    force : bool
        Make calibrations anew that another recording or other settings made.
    progress : callable, optional
        Told each robot that is done.

    Raises
    ------
    InputError
        If there is no recording, or the cluster cannot be reached.
    """
    paths = recordings_in(root)
    targets = {path: out / f"{_name(path, root)}.yaml" for path in paths}
    fleet, todo = Fleet(), []
    for path, target in targets.items():
        if target.exists() and _is_of(target, path, settings):
            fleet.kept.append(target.stem)
        elif target.exists() and not force:
            raise InputError(
                f"{target} was made from another recording or with other settings. Choose another "
                "--out, or add --force to replace it."
            )
        else:
            todo.append((path, target))
    problems: dict[str, str] = {}
    with _backend(cluster) as parallel:
        work = parallel(jobs)(delayed(_one)(path, target, settings) for path, target in todo)
        for name, problem in cast(Iterable[tuple[str, str]], work):
            (fleet.failed if problem else fleet.made).append(name)
            if problem:
                problems[name] = problem
            if progress:
                progress(name)
    fleet.table = _table([t for t in targets.values() if t.exists()], problems)
    # it says nothing that the calibrations do not, so it is made anew with each run
    write_text(out / TABLE, fleet.table.to_csv(index=False, lineterminator="\n"), force=True)
    return fleet


def _name(path: Path, root: Path) -> str:
    """A robot's name: its file's, with its folder's where there are folders."""
    return "_".join(path.relative_to(root).with_suffix("").parts)


def _is_of(target: Path, path: Path, settings: Settings) -> bool:
    """Whether a calibration was made from these bytes with these settings."""
    try:
        made = load_calibration(target)
    except InputError:
        return False
    scales = {j.actuator.scale.value_nm for j in made.joints.values()}
    return (
        [i.sha256 for i in made.inputs] == [sha256(path)]
        and made.seed == settings.seed
        and scales == {settings.stall_torque_nm}
    )


def _one(path: Path, target: Path, settings: Settings) -> tuple[str, str]:
    """Calibrate one robot; its name, and what went wrong or nothing."""
    try:
        recording = load(path)
        results = calibrate([recording], None, settings.seed, workers=1)
        made = to_calibration(
            results, [recording], settings.seed, settings.stall_torque_nm, settings.source
        )
        made.save(target, force=True)
    except PupperError as error:
        return target.stem, str(error)
    except Exception as error:  # a defect that one robot's log brings out must not cost the others
        at = traceback.extract_tb(error.__traceback__)[-1]
        return target.stem, f"{type(error).__name__}: {error} ({Path(at.filename).name})"
    return target.stem, ""


@contextmanager
def _backend(cluster: str | None) -> Iterator[Callable[[int], Parallel]]:
    """How to run in parallel: processes here, or a cluster's workers."""

    def here(jobs: int) -> Parallel:
        return Parallel(n_jobs=jobs, return_as="generator_unordered")

    if cluster is None:
        yield here
        return
    try:
        from distributed import Client
    except ImportError:
        raise InputError(
            "--cluster needs Dask, which is not installed: `pip install 'pupper-sysid[dask]'`."
        ) from None
    try:
        client = Client(cluster, timeout=10)
    except (OSError, ValueError) as error:
        raise InputError(
            f"--cluster {cluster}: no Dask scheduler answers there ({error}). Start one with "
            "`dask scheduler`, and workers with `dask worker ADDRESS`."
        ) from None
    with client, parallel_config(backend="dask"):
        yield lambda jobs: Parallel(n_jobs=-1)


def _table(files: Sequence[Path], problems: dict[str, str]) -> pd.DataFrame:
    """Every joint of every robot, outliers named, then what went wrong."""
    rows = []
    for path in files:
        calibration: Calibration = load_calibration(path)
        rows += [
            {"robot": path.stem, "joint": name}
            | {key: value(joint) for key, value in QUANTITIES.items()}
            for name, joint in calibration.joints.items()
        ]
    table = pd.DataFrame(rows, columns=["robot", "joint", *QUANTITIES])
    table["unlike"] = _unlike(table)
    table["problem"] = ""
    lost = pd.DataFrame([{"robot": n, "problem": p} for n, p in sorted(problems.items())])
    return pd.concat([table, lost], ignore_index=True) if len(lost) else table


def _unlike(table: pd.DataFrame) -> list[str]:
    """Per row the quantities that are far from the same joint's on the other robots."""
    found: list[list[str]] = [[] for _ in range(len(table))]
    for _, rows in table.groupby("joint").groups.items():
        if len(rows) < FEWEST:
            continue
        for key in QUANTITIES:
            values = table.loc[rows, key].to_numpy(float)
            middle = np.nanmedian(values)
            # 1.4826 makes the median deviation that of a normal distribution
            spread = 1.4826 * np.nanmedian(np.abs(values - middle))
            if not spread > 1e-9 * max(abs(middle), 1e-12):
                continue
            for row, value in zip(rows, values, strict=True):
                if abs(value - middle) > UNLIKE * spread:
                    found[row].append(key)
    return [";".join(names) for names in found]


def _ms(quantity) -> float:
    return float("nan") if quantity is None else 1e3 * quantity.value
