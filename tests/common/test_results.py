"""A result's fields are its JSON object, its table and nothing else."""

import math
from dataclasses import dataclass

import numpy as np

from pupper_sysid.common.interval import Interval
from pupper_sysid.common.results import JointResults, Result, derived, internal


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
