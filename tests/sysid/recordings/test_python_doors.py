"""Python's doors: recordings from memory, and what else stands where one belongs."""

import numpy as np
import pandas as pd
import pytest
import torch

import pupper_sysid as ps
from pupper_sysid.common.errors import InputError
from support.refusals import assert_each_refused

TIME = 0.02 * np.arange(60)
COMMAND = {"knee": 0.3 * np.sin(5 * TIME)}
POSITION = {"knee": 0.3 * np.sin(5 * (TIME - 0.05))}
TABLE = pd.DataFrame({"time": TIME, "knee_cmd": COMMAND["knee"], "knee_pos": POSITION["knee"]})


def test_what_is_no_recording_is_refused_with_what_makes_one():
    cases = [
        ("mine.csv", "pupper_sysid.load('mine.csv')"), (["mine.csv"], "load('mine.csv')"),
        (TABLE, "Recording.from_frame(table)"), (None, "not a NoneType"), (3, "not a int"),
        ([], "the list is empty"), ({"knee": TIME}, "not a dict"),
    ]  # fmt: skip
    doors = (ps.lag, ps.examine, ps.calibrate, ps.frequency_response, ps.backlash)
    for door in doors:
        assert_each_refused(cases, door)
    recording = ps.Recording.from_frame(TABLE)
    assert_each_refused([(3, "name joints, such as 'knee'")], lambda j: ps.lag(recording, j))


def test_arrays_and_paths_of_other_types_are_refused_in_a_sentence():
    arrays = ps.Recording.from_arrays
    late = TIME.copy()
    late[7] = np.nan
    words = ["a"] * 60
    for call, text in (
        (lambda: ps.load(3), "path of one log, not a int"),
        (lambda: ps.load(["a.csv", "b.csv"]), r"\[load\(p\) for p in paths\]"),
        (lambda: ps.load(TABLE), "Recording.from_frame"),
        (lambda: arrays(TIME, COMMAND["knee"], POSITION["knee"]), "a dictionary of arrays"),
        (lambda: arrays(words, COMMAND, POSITION), "send_time_s: its values are not numbers"),
        (lambda: arrays(TIME, {"knee": words}, POSITION), "command_rad: its values are not"),
        (lambda: arrays(late, COMMAND, POSITION), "row 7 has no time"),
        (lambda: arrays(TIME, COMMAND, POSITION, read_time_s=late), "read_time_s: row 7"),
        (lambda: arrays(TIME, COMMAND, POSITION, metadata=[1]), "metadata is a list"),
        (lambda: ps.Recording.from_frame({"time": TIME}), "pandas.DataFrame"),
        (lambda: arrays(TIME, {"knee": COMMAND["knee"] + 0j}, POSITION), "are not numbers"),
        (lambda: ps.Recording.from_frame(TABLE.assign(knee_pos=C + 0j)), "are not numbers"),
        (lambda: arrays(TIME, {"\x1b": C}, {"\x1b": P}), r"column joint: '.' is no joint"),
        (lambda: arrays(TIME, {"\x1b": C[1:]}, {"\x1b": P}), r"^[ -~\ufffd]*has shape"),
        (lambda: arrays([], {"knee": []}, {"knee": []}), "has no rows"),
        (lambda: ps.Recording.from_frame(TABLE.head(0)), "has no rows"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=text):
            call()


def stacked(**columns):
    return pd.DataFrame(columns, index=pd.Index(TIME, name="time"))


C, P = COMMAND["knee"], POSITION["knee"]
START = np.datetime64("2026-05-04T12:30")
ARRAYS = {
    "lists": (TIME.tolist(), C.tolist(), tuple(P)),
    "series of other indices": (pd.Series(TIME, TIME), pd.Series(C), pd.Series(P, TIME[::-1])),
    "objects": (TIME.astype(object), C.astype(object), [*P[:-1], None]),
    "dates": (pd.Series(START + (1e9 * TIME).astype("m8[ns]")), C, P),
    "durations": (pd.to_timedelta(TIME, "s"), C, P),
    "tensors": (torch.tensor(TIME), torch.tensor(C, requires_grad=True), torch.tensor(P)),
    "masked": (TIME, C, np.ma.masked_array(np.where(P > 0.29, 9.0, P), P > 0.29)),
}
FRAMES = {
    "times as index": stacked(cmd=C, pos=P),
    "dates as index": pd.DataFrame({"cmd": C, "pos": P}, pd.to_datetime(TIME, unit="s")),
    "numbers as index": pd.DataFrame({"cmd": C, "pos": P}, TIME),
    "two levels of names": stacked(**{"a": C, "b": P}).set_axis(
        pd.MultiIndex.from_tuples([("knee", "cmd"), ("knee", "pos")]), axis=1),
    "two levels of rows": stacked(cmd=C, pos=P).assign(joint="knee").set_index(
        "joint", append=True),
    "lists in cells": pd.DataFrame({"time": TIME, "action": list(C[:, None]),
                                    "state": P[:, None].tolist()}),
    "rows by chance": TABLE.sample(frac=1, random_state=0),
    "nullable numbers": TABLE.convert_dtypes(),
    "texts of numbers": TABLE.astype(str),
}  # fmt: skip


@pytest.mark.parametrize("form", [*ARRAYS, *FRAMES])
def test_what_is_in_memory_is_read_in_each_form(form):
    if form in ARRAYS:
        time, command, position = ARRAYS[form]
        recording = ps.Recording.from_arrays(time, {"knee": command}, {"knee": position})
    else:
        recording = ps.Recording.from_frame(FRAMES[form])
    (trial,) = recording.trials(recording.joints[0])
    read = np.isfinite(trial.position_rad)
    assert read.sum() > 40
    np.testing.assert_allclose(trial.send_time_s - trial.send_time_s[0], TIME, atol=1e-6)
    np.testing.assert_allclose(trial.command_rad, C)
    np.testing.assert_allclose(trial.position_rad[read], P[read])


def test_options_are_a_dictionary_or_refused_in_a_sentence():
    degrees = TABLE.assign(knee_cmd=np.degrees(C), knee_pos=np.degrees(P))
    (trial,) = ps.Recording.from_frame(degrees, options={"unit": "deg"}).trials("knee")
    np.testing.assert_allclose(trial.command_rad, C)
    cases = [({"rate": "50"}, "rate is the text '50'"), ("deg", "is deg where a mapping"),
             ({"unit": 3}, "unit is 3"), ({"rte": 3.0}, "Did you mean rate")]  # fmt: skip
    assert_each_refused(cases, lambda options: ps.Recording.from_frame(TABLE, options=options))
    with pytest.raises(InputError, match=r"`options=\{'rate': 50.0, 'command': '.joint._cmd'"):
        ps.Recording.from_frame(TABLE.drop(columns="time"))


def test_one_time_stamp_leaves_the_same_doubt_at_every_door(tmp_path):
    TABLE.to_csv(tmp_path / "log.csv", index=False)
    tidy = pd.DataFrame({"send_time_s": TIME, "joint": "knee", "command_rad": COMMAND["knee"],
                         "position_rad": POSITION["knee"]})  # fmt: skip
    for recording in (
        ps.load(tmp_path / "log.csv"), ps.Recording.from_frame(TABLE),
        ps.Recording.from_frame(tidy), ps.Recording.from_arrays(TIME, COMMAND, POSITION),
    ):  # fmt: skip
        (trial,) = recording.trials("knee")
        assert trial.read_time_doubt_s == pytest.approx(0.01)
        assert any("in doubt by half a turn" in text for text in recording.warnings)
    for keywords in ({"read_time_s": TIME + 0.002}, {"metadata": {"read_after_send_s": 0.002}}):
        recording = ps.Recording.from_arrays(TIME, COMMAND, POSITION, **keywords)
        (trial,) = recording.trials("knee")
        np.testing.assert_allclose(trial.read_time_s - trial.send_time_s, 0.002)
        assert trial.read_time_doubt_s == 0 and not recording.warnings
