"""A result's fields are its JSON object, its table and nothing else."""

import math
from dataclasses import dataclass

import numpy as np
import pytest

from pupper_sysid.common.interval import Interval
from pupper_sysid.common.joints import share_sentences
from pupper_sysid.common.results import JointResults, Result, derived, internal
from pupper_sysid.common.tones import block_bootstrap, fit_sine, least_squares, phasors, sine_design
from pupper_sysid.hardware.loop import Durations


@dataclass(frozen=True, kw_only=True)
class Measured(Result):
    lag_s: Interval
    tones_hz: tuple[float, ...]
    trials: np.ndarray = internal()

    @derived
    def twice_s(self) -> float:
        return 2 * self.lag_s.value

    @property
    def elsewhere(self) -> float:
        return 1.0


MEASURED = Measured(lag_s=Interval(0.04, 0.03, math.inf), tones_hz=(1.0, 2.0), trials=np.zeros(3))


def test_fields_and_derived_properties_are_the_plain_data_and_internal_ones_are_not():
    assert MEASURED.to_dict() == {
        "lag_s": {"value": 0.04, "low": 0.03, "high": None},
        "tones_hz": [1.0, 2.0],
        "twice_s": 0.08,
    }


def test_results_of_joints_are_a_mapping_one_object_and_one_table():
    found = JointResults(joints={"LF_hip": MEASURED, "RB_calf": MEASURED})
    assert list(found) == ["LF_hip", "RB_calf"] and found["RB_calf"] is MEASURED
    assert found.to_dict() == {"joints": dict.fromkeys(found, MEASURED.to_dict())}
    table = found.to_frame()
    assert list(table) == ["joint", "lag_s", "lag_s_low", "lag_s_high", "twice_s"]
    assert table["twice_s"].to_list() == [0.08, 0.08]


# ----- streaming statistics of durations agree with those of all of them at once


@pytest.mark.parametrize("size", [1, 10, 5000])
def test_they_are_those_of_the_whole_and_extremes_find_a_place(size):
    values = np.random.default_rng(0).lognormal(-7.0, 1.0, size)
    found, extreme = Durations(), Durations()
    for value in values:
        found.add(value)
    assert found.count == size and found.largest_s == values.max()
    assert (found.mean_s, found.sd_s) == pytest.approx((values.mean(), values.std()))
    for share in (0.5, 0.9, 0.99):
        exact = np.quantile(values, share, method="inverted_cdf")
        assert found.quantile(share) == pytest.approx(exact, rel=0.011)
    assert np.isnan(extreme.quantile(0.5))
    for value in (0.0, 1e-12, 1e6):
        extreme.add(value)
    assert extreme.largest_s == 1e6 and extreme.quantile(0.5) < 2e-7


# ----- sentences on several joints, said once


def test_sentences_that_differ_in_their_numbers_become_one_with_ranges():
    found = share_sentences(
        {
            "LF_hip": ["polled every 26.84 ms, 43 % lost.", "offset by −4 mrad."],
            "LF_thigh": ["polled every 26.84 ms, 41 % lost.", "offset by −7.5 mrad."],
            "LF_calf": ["polled every 26.84 ms, 8 % lost."],
        }
    )
    assert found == [
        ("All joints", "polled every 26.84 ms, 8 to 43 % lost."),
        ("LF_hip, LF_thigh", "offset by −7.5 to −4 mrad."),
    ]


def test_sentences_of_one_joint_and_those_that_differ_in_names_dates_or_ranges_stay_apart():
    slips = ["at 2 Hz the poll slipped by 5 ms.", "at 4 Hz the poll slipped by 9 ms."]
    assert share_sentences({"LF_hip": slips}) == [("LF_hip", text) for text in slips]
    texts = ["STS3215", "2026-11-23", "1-10 Hz", "44.4…45.0", "1e-3", "v1.2.3", "1,280 rows"]
    others = ["STS3216", "2026-11-24", "1-11 Hz", "44.4…45.1", "1e-4", "v1.2.4", "1,300 rows"]
    texts += ["in trial 3 it slipped", "row 12 is late", "servo 4 is slow"]
    others += ["in trial 7 it slipped", "row 15 is late", "servo 9 is slow"]
    for text, other in zip(texts, others, strict=True):
        assert share_sentences({"a": [text], "b": [other]}) == [("a", text), ("b", other)]


# ----- sines are recovered exactly, and the bootstrap's spread is the textbook's


def test_phasors_of_two_tones_and_an_offset_are_recovered_at_irregular_times():
    time = np.sort(np.random.default_rng(0).uniform(0.0, 3.0, 90))
    first, second = 2 * np.pi * 1.3 * time, 2 * np.pi * 3.1 * time
    value = 0.7 + (np.exp(1j * first) * (0.2 - 0.5j)).real + (np.exp(1j * second) * 0.1j).real
    solution = least_squares(sine_design(first, second), value)
    assert solution[0] == pytest.approx(0.7)
    np.testing.assert_allclose(phasors(solution), [0.2 - 0.5j, 0.1j], atol=1e-12)


def test_channels_are_fitted_apart():
    angle = np.linspace(0.0, 20.0, 70)
    value = np.stack([1.0 + np.cos(angle), -2.0 + 3.0 * np.sin(angle)], axis=1)
    found = fit_sine(angle, value)
    np.testing.assert_allclose(found.offset, [1.0, -2.0], atol=1e-12)
    np.testing.assert_allclose(found.phasor, [1.0, -3.0j], atol=1e-12)


def test_the_bootstrap_spreads_a_mean_by_its_standard_error_and_cuts_too_few_blocks_finer():
    rng = np.random.default_rng(1)
    value = rng.standard_normal(4000)
    fit = block_bootstrap(np.ones((4000, 1)), value, np.arange(4000) // 10, rng, 2000)
    assert fit.blocks == 400
    assert fit.solution == pytest.approx(value.mean())
    # 400 blocks: the spread of a spread is 4 %, of 2000 draws 2 %
    assert fit.drawn.std() == pytest.approx(4000**-0.5, rel=0.15)
    assert fit.inflated(2.0).std() == pytest.approx(2 * fit.drawn.std())
    design, line = sine_design(np.linspace(0.0, 30.0, 100)), np.arange(100.0)
    fit = block_bootstrap(design, line, np.zeros(100, int), np.random.default_rng(2), 5, 8)
    assert fit.blocks == 8 and fit.drawn.shape == (5, 3)
    np.testing.assert_allclose(fit.solution, least_squares(design, line))
