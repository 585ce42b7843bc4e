"""Numbers of another unit as the prior: what they say, and what is common to all of them."""

import numpy as np
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.servo_models.calibration.quantity import Quantity
from pupper_sysid.sysid.fit.choice import Fitted
from pupper_sysid.sysid.fit.joint_fit import _foreign
from pupper_sysid.sysid.fit.search import Fit
from pupper_sysid.sysid.fit.servo_prior import PER_INERTIA, ServoPrior, servo_prior
from pupper_sysid.sysid.fit.structure import SIMULATED, Scales, candidate

SAMPLE = load_calibration("data/samples/calibrated.yaml")


def prior_of(calibration=SAMPLE, joint="pan", gain=None) -> ServoPrior:
    return servo_prior(calibration, "sample", joint, gain)


def test_the_same_joint_is_taken_and_else_all_of_them_which_differ_more():
    same, others = prior_of(joint="LF_hip"), prior_of()
    hip = SAMPLE.joints["LF_hip"].actuator.ratios_to_armature
    mean, _ = same.logarithms["stiffness_per_s2"]
    assert np.exp(mean) == pytest.approx(hip.stiffness.value, rel=1e-6)
    values = [j.actuator.ratios_to_armature.stiffness.value for j in SAMPLE.joints.values()]
    assert min(values) < np.exp(others.logarithms["stiffness_per_s2"][0]) < max(values)


def test_stiffness_scales_with_the_gain_and_is_vague_where_one_of_the_gains_is_not_known():
    card = load_calibration("sts3215-bam-m1")  # P 32
    at_16, at_32, unknown = (prior_of(card, gain=gain) for gain in (16.0, 32.0, None))
    mean, sd = at_32.logarithms["stiffness_per_s2"]
    assert at_16.logarithms["stiffness_per_s2"][0] == pytest.approx(mean - np.log(2))
    assert at_16.logarithms["effort_rad_s2"] == at_32.logarithms["effort_rad_s2"]
    assert unknown.logarithms["stiffness_per_s2"][1] > sd + 0.3


def test_joints_on_links_of_their_own_differ_by_a_common_factor_not_number_by_number():
    joint = SAMPLE.joints["LF_hip"]

    def on_a_link(factor: float):
        ratios = joint.actuator.ratios_to_armature
        heavier = {
            name: getattr(ratios, name).scaled(factor)
            for name in type(ratios).model_fields
            if getattr(ratios, name) is not None
        }
        ratios = ratios.model_copy(update=heavier)
        actuator = joint.actuator.model_copy(update={"ratios_to_armature": ratios})
        return joint.model_copy(update={"actuator": actuator})

    links = {f"joint_{n}": on_a_link(factor) for n, factor in enumerate((0.25, 1.0, 4.0))}
    apart, alike = (
        prior_of(SAMPLE.model_copy(update={"joints": joints}))
        for joints in (links, {name: joint for name in links})
    )
    assert apart.shared_sd > alike.shared_sd
    for name in PER_INERTIA:
        assert apart.logarithms[name] == pytest.approx(alike.logarithms[name], abs=0.02)


def test_a_calibration_that_knows_nothing_is_refused():
    joint = SAMPLE.joints["LF_hip"]
    unknown = Quantity(value=1.0, identified="no", why="never excited")

    def without(part):
        own = {k: unknown for k, v in part if isinstance(v, Quantity)}
        return part.model_copy(update=own)

    actuator = without(joint.actuator)
    actuator = actuator.model_copy(
        update={"ratios_to_armature": without(joint.actuator.ratios_to_armature)}
    )
    empty = SAMPLE.model_copy(
        update={"joints": {"pan": joint.model_copy(update={"actuator": actuator})}}
    )
    with pytest.raises(InputError, match="no number with an interval"):
        prior_of(empty)


def test_its_cost_is_that_of_a_normal_distribution_with_a_factor_in_common():
    prior = prior_of()
    structure = candidate(SIMULATED[0], Scales(prior=prior))
    common = np.array([p.name in PER_INERTIA for p in structure.parameters])
    bounded = structure.prior[1] > 0  # the offset has no prior
    covariance = np.diag(1 / structure.prior[1][bounded])
    covariance += prior.shared_sd**2 * np.outer(common, common)[np.ix_(bounded, bounded)]
    precision = np.zeros((len(common),) * 2)
    precision[np.ix_(bounded, bounded)] = np.linalg.inv(covariance)
    apart = np.random.default_rng(0).standard_normal((5, len(common)))
    points = structure.prior[0] + apart
    expected = 0.5 * np.einsum("ni,ij,nj->n", apart, precision, apart)
    np.testing.assert_allclose(structure.prior_cost(points), expected, rtol=1e-8)
    np.testing.assert_allclose(structure.prior_slope(points), apart @ precision, atol=1e-8)
    np.testing.assert_allclose(structure.prior_precision, precision, atol=1e-8)


def test_a_heavier_link_costs_little_and_another_ratio_much():
    structure = candidate(SIMULATED[0], Scales(prior=prior_of()))
    common = np.array([p.name in PER_INERTIA for p in structure.parameters])
    heavier = structure.prior[0] - np.log(2) * common
    stronger = structure.prior[0] + np.log(2) * (np.array(structure.names) == "effort_rad_s2")
    assert structure.prior_cost(heavier[None])[0] < 1.0
    assert structure.prior_cost(stronger[None])[0] > 4.0


def test_numbers_that_no_unit_of_the_servo_has_are_named():
    structure = candidate(SIMULATED[0], Scales(prior=prior_of()))
    usual = Fitted(structure, Fit(structure.prior[0], 0.0))
    place = structure.names.index("velocity_limit_rad_s")
    far = structure.prior[0] + np.log(5.0) * (np.arange(len(structure.names)) == place)
    assert list(_foreign("pan", usual)) == []
    (sentence,) = _foreign("pan", Fitted(structure, Fit(far, 0.0)))
    assert "velocity limit is 5 times that of sample" in sentence
