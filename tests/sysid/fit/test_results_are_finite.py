"""Results that are not finite, or not plausible, are findings of a calibration and no crash."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pupper_sysid.common.interval import Interval
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.calibration.parts import Feedback, RatiosToArmature
from pupper_sysid.servo_models.calibration.quantity import Quantity, measured, quantity_of
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.servo_models.held_feedback import HeldFeedback
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice, find_poll_lattice
from pupper_sysid.sysid.fit.calibration_file import to_calibration
from pupper_sysid.sysid.fit.results import CandidateFit, JointCalibrationResult
from pupper_sysid.sysid.fit.scores import Scores
from pupper_sysid.sysid.fit.structure import SIMULATED, candidate
from pupper_sysid.sysid.lag.lag_budget import LagBudget, lag_budget
from pupper_sysid.sysid.plan.planner import Setup
from pupper_sysid.sysid.plan.proposal import feedback_setup
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.report.figures import hold_runs
from support import made_recordings

PERIOD_S, LOSS, QUANTUM_RAD = 0.02685, 0.42, 0.0057
ANY = st.floats(allow_nan=True, allow_infinity=True)


@pytest.fixture(scope="module")
def slow() -> Recording:
    """A polled log of a slow axis without tones: it moves by at most 2.4 steps per poll."""
    servo = DelayedPDParameters(
        stiffness=100.0, damping=40.0, friction_loss=0.0, armature=1.0, effort_limit=60.0,
        velocity_limit=0.5, dead_time_s=0.05,
    )  # fmt: skip
    setup = made_recordings.Setup(
        servo,
        1 / 0.019,
        0.4,
        quantum_rad=QUANTUM_RAD,
        poll_s=PERIOD_S,
        loss=LOSS,
        kind="steps",
        trial_s=2.0,
    )
    assert 0.5 * PERIOD_S < 3 * QUANTUM_RAD
    return made_recordings.record(setup, np.random.default_rng(7))


@pytest.fixture(scope="module")
def lattice(slow) -> PollLattice:
    return find_poll_lattice(slow.trials(made_recordings.JOINT), np.random.default_rng(0))


@pytest.fixture(scope="module")
def lag(slow, lattice) -> LagBudget:
    joint = made_recordings.JOINT
    return lag_budget(joint, slow.trials(joint), np.random.default_rng(0), lattice)


def calibrated(slow: Recording, lag: LagBudget, **numbers: Interval) -> Calibration:
    """The calibration of a fit with these numbers."""
    model = candidate(SIMULATED[0])
    fitted = {p.name: Interval(p.nominal, p.nominal, p.nominal) for p in model.parameters}
    scores = Scores(
        rmse_fresh_rad=0.01, rmse_held_rad=0.01, rmse_raw_rad=0.01, rmse_one_step_rad=math.nan,
        rmse_leave_one_frequency_out_rad=math.nan, rmse_by_left_out_frequency_rad={},
        fit_percent=-math.inf,
    )  # fmt: skip
    fit = CandidateFit(model=SIMULATED[0], parameters=fitted | numbers, undecided={}, scores=scores)
    result = JointCalibrationResult(
        joint=lag.joint, model=SIMULATED[0], simulated_model=SIMULATED[0],
        structure_nats={SIMULATED[0]: 0.0, SIMULATED[1]: 99.0},
        command_jitter_s=Interval(math.nan, math.nan, math.nan),
        candidate_models={SIMULATED[0]: fit},
        lag=lag.with_dead_time(Interval(0.05, 0.04, 0.06), 0.0), presets={}, warnings=(),
    )  # fmt: skip
    return to_calibration({lag.joint: result}, [slow], seed=0)


def test_a_joint_too_slow_to_show_lost_polls_has_a_poll_and_no_loss(lattice):
    assert lattice.kind == "lattice"
    assert math.isnan(lattice.loss) and math.isnan(lattice.mean_age_s)
    ends = lattice.loss_interval
    assert ends.low < 0.01 and ends.high > 0.99  # Jeffreys' prior, nothing counted
    assert ends.low < LOSS < ends.high


def test_a_calibration_says_so_and_gives_a_simulator_a_loss_that_it_can_run(slow, lag):
    found = calibrated(slow, lag).joint(lag.joint).feedback
    assert found.poll_period_s.identified == "yes"
    for quantity in (found.loss, found.mean_age_s):
        assert quantity.identified == "no" and "failed polls do not show" in str(quantity.why)
    assert found.loss.low < LOSS < found.loss.high
    HeldFeedback(found.poll_period_s.value, found.loss.value)
    assert any("share of lost polls is not identified" in text for text in lag.warnings)


def test_what_uses_a_lattice_s_loss_gets_a_number_or_leaves_it_out(lag, lattice):
    setup = feedback_setup(lag, Setup())
    assert 0 <= setup.loss < 1
    HeldFeedback(lattice.poll_period_s, lattice.assumed_loss)
    runs = hold_runs([(0, 20, 10, 5)], [0.019], lattice)
    assert runs.expected is None and runs.count.sum() == 35


@settings(max_examples=60)
@given(ANY, ANY, ANY, st.sampled_from(["loss", "poll_period_s", "mean_age_s", "offset_rad"]))
def test_no_measured_number_is_refused_by_the_file(value, low, high, name):
    zero = quantity_of(Interval(0.0, 0.0, 0.0))
    entries = dict.fromkeys(Feedback.model_fields, zero)
    made = measured(Feedback, **entries | {name: quantity_of(Interval(value, low, high))})
    found: Quantity = getattr(made, name)
    assert found.low is None or found.low <= found.value
    assert found.high is None or found.high >= found.value
    if not math.isfinite(value) or found.value != value:
        assert found.identified == "no" and found.why
    if math.isfinite(value) and found.value != value:
        assert "is outside the possible" in str(found.why)


def test_a_number_in_its_range_stays_as_it_is():
    inside = quantity_of(Interval(0.3, 0.2, 0.4))
    assert (inside.value, inside.low, inside.high, inside.identified) == (0.3, 0.2, 0.4, "yes")
    assert quantity_of(Interval(0.3, 0.31, 0.29)).low == 0.3  # ends are not inside of the value
    ratio = quantity_of(Interval(2.0, 1.0, 3.0), "ratio only")
    made = measured(
        RatiosToArmature, stiffness=ratio, damping=ratio, friction_loss=ratio, effort_limit=ratio
    )
    assert made.stiffness == ratio


def test_a_fit_whose_interval_has_no_end_is_calibrated(slow, lag):
    nominals = {p.name: p.nominal for p in candidate(SIMULATED[0]).parameters}
    ratios = {
        "stiffness_per_s2": "stiffness", "damping_per_s": "damping",
        "friction_rad_s2": "friction_loss", "effort_rad_s2": "effort_limit",
    }  # fmt: skip
    for end in (math.nan, math.inf):
        numbers = {n: Interval(nominals[n], nominals[n] / 2, end) for n in ratios}
        joint = calibrated(slow, lag, **numbers).joint(lag.joint)
        for name, key in ratios.items():
            quantity = getattr(joint.actuator.ratios_to_armature, key)
            assert quantity.value == pytest.approx(nominals[name]) and quantity.high is None
        assert joint.scores.fit_percent is None


def test_a_lag_at_the_end_of_its_search_is_in_the_file(slow, lag):
    late = replace(lag, lag_s=Interval(1.15, 1.1, 1.2), raw_lag_s=Interval(9.0, 8.0, math.nan))
    found = calibrated(slow, late).joint(lag.joint).lag
    assert found.lag_s is not None and found.lag_s.value == 1.15
    assert found.raw_lag_s is not None and found.raw_lag_s.identified == "no"
