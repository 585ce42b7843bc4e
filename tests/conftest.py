"""Fixtures: recordings of a real robot, where they are at hand, and a policy that walks."""

import gc
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

# modules are compiled once, not by every worker and every program that a test starts
os.environ["PYTHONDONTWRITEBYTECODE"] = ""
# the workers share the cores; networks this small only wait for other threads
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import hypothesis
import pytest

import support.avx2  # noqa: F401
from pupper_sysid.data import SAMPLES
from support.compiled_once import compile_estimator
from support.real_recordings import real_recording

sys.dont_write_bytecode = False
# what is imported stays: to search it for garbage is a fifth of the time of a collection of tests
gc.disable()
# a shell lets what runs in its background ignore Ctrl-C, which tests press
signal.signal(signal.SIGINT, signal.default_int_handler)

# the same examples on every machine; `--hypothesis-profile search` looks for new ones
hypothesis.settings.register_profile("repeatable", deadline=None, derandomize=True, database=None)
hypothesis.settings.register_profile("search", deadline=None, max_examples=1000)
hypothesis.settings.load_profile("repeatable")


def pytest_sessionstart() -> None:
    """The first worker compiles while the others collect: no test begins before both are done."""
    if os.environ.get("PYTEST_XDIST_WORKER") == "gw0":
        compile_estimator()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The slowest file comes first: at the end one worker would wait for the other."""
    items.sort(key=lambda item: item.path.name != "test_docs.py")


def pytest_collection_finish() -> None:
    """From now on garbage is collected, but not searched for in what has been imported."""
    gc.collect()
    gc.freeze()
    gc.unfreeze = lambda: None  # the end of a walk would undo it
    gc.enable()


@pytest.fixture
def fitted_once(monkeypatch) -> None:
    """Recordings that were fitted before in this process are not fitted again."""
    from support.fitted_once import fit_once

    fit_once(monkeypatch)


@pytest.fixture
def unexamined() -> Iterator[None]:
    """The doctor finds nothing, and takes no time."""
    from support import unexamined

    with unexamined.unexamined():
        yield


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    """An empty folder, the working directory of the test."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def proxy_path() -> Iterator[Path]:
    """Of a proxy's socket, which must be short."""
    with TemporaryDirectory(prefix="px", dir="/tmp") as folder:
        yield Path(folder) / "s"


@pytest.fixture
def patient_proxy(monkeypatch, proxy_path) -> Path:
    """The same, of a proxy that shares this process and a busy machine."""
    from pupper_sysid.hardware import esp32

    monkeypatch.setattr(esp32, "TIMEOUT_S", 0.3)
    return proxy_path


@pytest.fixture(scope="session")
def real_sweeps() -> list[Path]:
    """The hip and thigh sweeps of a Mini Pupper 2."""
    names = ("real_motor_0_LF_hip_amp0.3.csv", "real_motor_1_LF_thigh_amp0.3.csv")
    return [real_recording(name) for name in names]


@pytest.fixture(scope="session")
def hip(tmp_path_factory) -> Path:
    """Two tones (2 and 4 Hz) of one joint of the sample sweep: quick to fit."""
    lines = (SAMPLES / "sweep.csv").read_text().splitlines(keepends=True)
    header = [line for line in lines if line[0] == "#" or line.startswith("send_time")]
    rows = [line for line in lines if ",1,LF_hip," in line or ",3,LF_hip," in line]
    path = tmp_path_factory.mktemp("hip") / "hip.csv"
    path.write_text("".join([*header, *rows]))
    return path


@pytest.fixture(scope="session")
def real_playback() -> Path:
    """Three loops of a walking policy's actions on a Mini Pupper 2, at 25 Hz."""
    return real_recording("playback_lstm_25hz.csv")


@pytest.fixture(scope="session")
def walker():
    """The shipped LSTM, and two robots with calibrated servos to walk on."""
    from pupper_sysid.policies.analysis.trial import Trial
    from pupper_sysid.policies.network.policy_file import load_policy
    from pupper_sysid.sim.walking.config import Walking
    from pupper_sysid.sim.walking.servo_ranges import servo_ranges

    trial = Trial(
        Walking(), servo_ranges(SAMPLES / "calibrated.yaml"), robots=2, seconds=7.5, threads=1
    )
    return load_policy(SAMPLES / "policies/lstm"), trial
