"""What is written is read back: recordings of any joints, times, readings and header texts."""

import math
import tempfile
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.sysid.recordings.files import RecordingWriter, load

ANGLE_DECIMALS, TIME_DECIMALS = 7, 6
angles = st.floats(-2.0, 2.0)
texts = st.text(max_size=20)
plain_data = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | texts | st.floats(-1e9, 1e9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=6,
)


@st.composite
def logs(draw):
    """Rows of a few trials: joint, number, tone, and arrays of times, commands and readings."""
    trials = []
    clock = draw(st.floats(0.0, 1e5))
    for number in range(draw(st.integers(1, 3))):
        rows = draw(st.integers(30, 50))
        times = clock + np.cumsum(draw(arrays.arrays(float, rows, elements=st.floats(0.004, 0.1))))
        position = draw(arrays.arrays(float, rows, elements=angles | st.just(math.nan)))
        position[0] = draw(angles)  # a trial without any reading is refused
        trials.append(
            {
                "joint": draw(st.sampled_from(JOINT_NAMES)),
                "trial": number,
                "frequency_hz": draw(st.just(math.nan) | st.integers(1, 20)),
                "send_time_s": times,
                "read_time_s": times + draw(st.floats(0.0, 0.003)),
                "command_rad": draw(arrays.arrays(float, rows, elements=angles)),
                "position_rad": position,
                "position_count": np.arange(rows) if draw(st.booleans()) else None,
            }
        )
        clock = times[-1] + 1.0
    return trials


def write(path: Path, trials, metadata) -> None:
    counted = all(trial["position_count"] is not None for trial in trials)
    with RecordingWriter(path, metadata) as writer:
        for trial in trials:
            for row in range(len(trial["send_time_s"])):
                cells = {k: v[row] if isinstance(v, np.ndarray) else v for k, v in trial.items()}
                if not counted:
                    del cells["position_count"]
                writer.append(cells)
        writer.close({"rows": sum(len(t["send_time_s"]) for t in trials)})


@settings(max_examples=15)
@given(trials=logs(), note=plain_data)
def test_what_the_writer_writes_is_loaded_to_the_last_decimal_and_saved_unchanged(trials, note):
    with tempfile.TemporaryDirectory() as folder:
        first, second = Path(folder) / "first.csv", Path(folder) / "second.csv"
        write(first, trials, {"note": note})
        loaded = load(first)
        loaded.save(second)
        again = load(second)
    assert again.metadata["note"] == loaded.metadata["note"] == note
    assert sorted(loaded.joints) == sorted({trial["joint"] for trial in trials})
    for wanted in trials:
        (found,) = [t for t in loaded.trials(wanted["joint"]) if t.number == wanted["trial"]]
        for name, decimals in (
            ("send_time_s", TIME_DECIMALS), ("read_time_s", TIME_DECIMALS),
            ("command_rad", ANGLE_DECIMALS), ("position_rad", ANGLE_DECIMALS),
        ):  # fmt: skip
            np.testing.assert_allclose(
                getattr(found, name), wanted[name], rtol=0, atol=0.5001 * 10**-decimals
            )
        np.testing.assert_equal(found.frequency_hz, float(wanted["frequency_hz"]))
    np.testing.assert_array_equal(again.table.index, loaded.table.index)
    for column in loaded.table:
        np.testing.assert_array_equal(again.table[column], loaded.table[column])
