"""Recordings of real servos: found in a folder, else fetched from their public addresses.

The folder is `$PUPPER_REAL_DATA`, else `../shared/real` beside the repository. A recording whose
licence allows it is fetched where there is a network, is held to its SHA-256 and kept in pooch's
cache; any other is skipped with a sentence.
"""

import hashlib
import os
from pathlib import Path

import pytest

FOLDER = Path(
    os.environ.get("PUPPER_REAL_DATA") or Path(__file__).resolve().parents[3] / "shared" / "real"
)

# verayannn/SpotDMouse, Mini Pupper 2; no licence, so these are not fetched
MINI_PUPPER = {
    "real_motor_0_LF_hip_amp0.3.csv": (
        "dffcc458988c4cadaf618b474ad98622c1fd9db66cafdb03d786269eff527fc9"
    ),
    "real_motor_1_LF_thigh_amp0.3.csv": (
        "db02e3ef87dbdaabcdc67ed45171fbfc53d8f1c979c4ae1c03a3e6ea5f37feea"
    ),
    "playback_lstm_25hz.csv": "ca594638ab1e6c244ef6d853ac2b0c3fd821e3a445f5b80604d5ad2b462efd0e",
    "mini_pupper_full_band/thigh_1-10hz.csv": (
        "ad3c5bc6a97def3f9903f3fe8f4ebef8c5a86bd9d7e6b1b328e7423265a047e8"
    ),
}

# isaac-sim2real/sage, LeRobot SO-101 with STS3215 servos; Apache-2.0
SO101_ADDRESS = (
    "https://raw.githubusercontent.com/isaac-sim2real/sage/"
    "4ffd2627df9d23e279b35712a67e629ce0c0dfa7/output/real/so101/custom/"
)
SO101 = {
    "frequency_sweep/control.csv": (
        "2d599dfffca7ea588e27867575548a0f2eafd8f8a80429f949e3e156609a7562"
    ),
    "frequency_sweep/state_motor.csv": (
        "7cb128578245bfd9b885422b389b438fd67189e0f4c4f0a3a6eeee83ead9e1de"
    ),
}
SHA256 = MINI_PUPPER | {f"sage_so101/{name}": digest for name, digest in SO101.items()}


def real_recording(name: str) -> Path:
    """Path of the recording `name`, a key of `SHA256`; skips the test where it is out of reach."""
    path = FOLDER / name
    if path.exists():
        found = hashlib.sha256(path.read_bytes()).hexdigest()
        assert found == SHA256[name], f"{path} is not the recording that the tests are written for"
        return path
    short = name.removeprefix("sage_so101/")
    if short not in SO101:
        pytest.skip(f"{name} is not in {FOLDER} and may not be fetched (set PUPPER_REAL_DATA)")
    pooch = pytest.importorskip("pooch")
    try:
        fetched = pooch.retrieve(
            SO101_ADDRESS + short, known_hash=f"sha256:{SO101[short]}",
            fname=name.replace("/", "-"), path=pooch.os_cache("pupper-sysid"),
            downloader=pooch.HTTPDownloader(timeout=10),
        )  # fmt: skip
    except OSError as error:  # no network
        pytest.skip(f"{name} is not in {FOLDER} and cannot be fetched ({type(error).__name__})")
    return Path(fetched)


def real_folder(name: str) -> Path:
    """Folder `name` of recordings of real servos; skips the test where it is absent."""
    path = FOLDER / name
    if not path.is_dir():
        pytest.skip(f"{name} is not in {FOLDER} (set PUPPER_REAL_DATA)")
    return path


def case(name: str) -> Path:
    """File `name` of the small inputs with a stated answer; skips the test where it is absent."""
    path = FOLDER.parent / "cases" / name
    if not path.exists():
        pytest.skip(f"{name} is not in {path.parent} (set PUPPER_REAL_DATA)")
    return path
