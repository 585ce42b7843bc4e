"""Slow strokes give hysteresis, dead zone and play, each where it can be told from the others.

Coverage over 60 servos: `benchmarks/coverage.py --world strokes`.
"""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pupper_sysid.sysid.backlash import backlash
from pupper_sysid.sysid.recordings.files import load
from support.command_line import run
from support.refusals import assert_each_refused
from support.strokes import stroked


@cache
def measured(seed: int, degrees: float, zone: int):
    """Backlash of a servo with this play and dead zone, and its true numbers."""
    recording, true = stroked(seed, degrees, zone)
    return backlash(recording)["bench"], true


TWO_DEGREES = (3, 2.0, 0)


def test_hysteresis_is_twice_friction_over_stiffness_at_each_gain():
    found, true = measured(*TWO_DEGREES)
    for own in found.gains:
        width = 2 * true.friction_nm / (true.torque_nm * true.duty_per_rad * own.p_gain)
        assert own.hysteresis_rad.value == pytest.approx(width, abs=true.count_rad / 4)
        # back-EMF over stiffness, dead time, and half a period of the held command
        emf = true.back_emf_nm_s_rad + true.torque_nm * true.duty_per_rad * 32 * true.d_time_s
        lag = emf / (true.torque_nm * true.duty_per_rad * own.p_gain) + true.dead_time_s + 0.009
        assert own.lag_s.value == pytest.approx(lag, rel=0.06)


@pytest.mark.parametrize(
    ("degrees", "zone"), [(0.0, 1), (0.7, 5), pytest.param(1.3, 1, marks=pytest.mark.slow)]
)
def test_play_is_measured_whatever_the_dead_zone(degrees, zone):
    play, truth = measured(7, degrees, zone)[0].backlash_rad, np.radians(degrees)
    assert play is not None
    assert play.value == pytest.approx(truth, abs=0.0012 + 0.05 * truth)
    assert play.low - 1e-3 <= truth <= play.high + 1e-3
    play = measured(*TWO_DEGREES)[0].backlash_rad
    assert play is not None and 0.025 < play.low < np.radians(2.0) < play.high < 0.045


def test_a_dead_zone_shows_where_friction_no_longer_hides_it():
    (shown, true), (hidden, _) = measured(7, 0.7, 5), measured(7, 0.0, 1)
    zone = shown.dead_zone_rad
    assert zone is not None and zone.low <= 5 * true.count_rad <= zone.high
    assert zone.high - zone.low < 2 * true.count_rad
    assert hidden.dead_zone_rad is not None and hidden.dead_zone_rad.value == 0.0
    assert hidden.dead_zone_rad.high > true.count_rad
    assert "at most half" in hidden.notes[0]


def test_one_gain_cannot_tell_friction_from_a_dead_zone_and_says_so():
    recording, true = stroked(*TWO_DEGREES)
    table = recording.table
    alone = replace(recording, table=table[table["p_gain"] == 8].reset_index(drop=True))
    found = backlash(alone)["bench"]
    assert found.dead_zone_rad is None and len(found.gains) == 1
    assert "two or more gains" in found.notes[0] and "dead time" in found.notes[1]
    # the dead time is unknown: a wider interval, which still holds the truth
    assert found.backlash_rad is not None
    assert found.backlash_rad.low < true.backlash_rad < found.backlash_rad.high


def test_without_a_load_backlash_is_not_given_and_other_recordings_are_refused(hip):
    recording, _ = stroked(5, 1.0, 1, gains=(32,), mass_kg=0.0)
    found = backlash(recording)["bench"]
    assert found.backlash_rad is None and found.gains[0].hysteresis_rad.value > 0
    assert any("cannot be separated from friction" in note for note in found.notes)
    assert_each_refused([(load(hip), "no slow strokes at two speeds")], backlash)


def test_a_shift_of_the_zero_changes_nothing():
    recording, _ = stroked(*TWO_DEGREES)
    table = recording.to_frame()
    table["position_rad"] += 0.01
    play = backlash(replace(recording, table=table))["bench"].backlash_rad
    before = measured(*TWO_DEGREES)[0].backlash_rad
    assert play is not None and before is not None
    assert play.value == pytest.approx(before.value, abs=1e-3)


def test_the_command_prints_numbers_and_documented_keys(tmp_path, capsys):
    stroked(*TWO_DEGREES)[0].save(tmp_path / "a.csv")
    code, out, _ = run(capsys, "backlash", tmp_path / "a.csv", "--json")
    own = json.loads(out)["joints"]["bench"]
    assert code == 0 and own["backlash_rad"]["value"] == pytest.approx(np.radians(2), rel=0.1)
    code, out, _ = run(capsys, "backlash", tmp_path / "a.csv")
    assert code == 0 and "bench: backlash" in out and "°" in out
