"""One quantity has one number: the report's tables, sentences and JSON objects agree."""

import csv
import re
from collections.abc import Iterator
from html import unescape
from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.results import plain
from pupper_sysid.data import SAMPLES
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.robot import draw_robot
from pupper_sysid.sysid.fit.calibrate import CalibrationResult, calibrate, lag
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.report import report
from pupper_sysid.sysid.report.figures import tracks
from pupper_sysid.sysid.report.report import can_recall, recall
from pupper_sysid.sysid.sweep.excitation import plan
from pupper_sysid.sysid.sweep.recorder import record
from support.fitted_once import fit_once
from support.undrawn import leave_undrawn

JOINT = "LF_thigh"


@pytest.fixture(scope="module")
def swept(tmp_path_factory) -> Recording:
    rng = np.random.default_rng(3)
    path = tmp_path_factory.mktemp("one") / "sweep.csv"
    bus = EmulatedBus(draw_robot(rng), rng)
    record(bus, plan("sine", [JOINT], (2.0, 4.0), duration_s=2.5), path)
    return load(path)


@pytest.fixture(scope="module")
def made(swept) -> CalibrationResult:
    return calibrate(swept)


@pytest.fixture(scope="module", autouse=True)
def fitted() -> Iterator[None]:
    """`delay` and `calibrate` take one fit: what they make of it is the matter."""
    with pytest.MonkeyPatch.context() as patch:
        fit_once(patch)
        yield


@pytest.fixture(scope="module")
def folder(swept, made, tmp_path_factory) -> Path:
    """A report that compares the calibration and a preset, too; calibrated once."""
    out = tmp_path_factory.mktemp("report")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "calibrate", never)
        leave_undrawn(patch)
        report.write_report(
            swept, out, calibration=made.calibration, models=[made.calibration, "paper"]
        )
    return out


def never(*given, **more):
    raise AssertionError("a report with a calibration fits nothing")


def test_a_report_shows_the_joints_that_its_calibration_has(monkeypatch, tmp_path):
    sweep, calibration = load(SAMPLES / "sweep.csv"), load_calibration(SAMPLES / "calibrated.yaml")
    part = calibration.model_copy(update={"joints": {JOINT: calibration.joint(JOINT)}})
    shown = []

    def stop(_, __, joints, ___):
        shown.extend(joints)
        raise InputError("enough")

    monkeypatch.setattr(report, "recall", stop)
    for joints in (None, "all"):
        with pytest.raises(InputError, match="enough"):
            report.write_report(sweep, tmp_path, joints=joints, calibration=part)
    assert shown == 2 * [JOINT]


def table(folder: Path, name: str) -> list[dict[str, str]]:
    with (folder / "tables" / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def text(folder: Path) -> str:
    html = re.sub(r"<(style|img)[^>]*>(.*?</style>)?", "", (folder / "report.html").read_text())
    return unescape(re.sub(r"<[^>]+>", " ", html))


def parameters(folder: Path) -> dict[str, dict[str, str]]:
    return {f"{r['part']} {r['parameter']}": r for r in table(folder, "parameters")}


def test_poll_loss_and_age_are_those_of_the_calibration_wherever_they_stand(folder, made):
    (budget,), (doctor,) = table(folder, "lag_budget"), table(folder, "doctor")
    known = parameters(folder)
    for name, elsewhere in (
        ("poll_period_s", (budget["feedback_poll_period_s"], doctor["poll_period_s"])),
        ("loss", (budget["feedback_loss"], doctor["loss"])),
        ("mean_age_s", (budget["feedback_mean_age_s"],)),
        ("quantum_rad", (budget["quantum_rad"], doctor["quantum_rad"])),
        ("offset_rad", (budget["offset_rad"],)),
    ):
        own = float(known[f"feedback {name}"]["value"])
        assert [float(x) for x in elsewhere] == pytest.approx([own] * len(elsewhere)), name
    assert "offset_rad" not in doctor  # reading minus command is another quantity
    age = made.calibration.joint(JOINT).feedback.mean_age_s.value
    said = re.findall(r"(\d+) ms old on average", text(folder))
    assert said and set(said) == {f"{1e3 * age:.0f}"}
    said = re.findall(r"mean age (\S+) ms", text(folder))
    assert said and set(said) == {f"{1e3 * age:.1f}"}
    assert not re.search(r"\d ms feedback age", text(folder))


def test_lag_and_dead_time_stand_once(folder, swept, made):
    (budget,) = table(folder, "lag_budget")
    dead_time = parameters(folder)["actuator dead_time_s"]
    assert [float(budget[f"dead_time_s{end}"]) for end in ("", "_low", "_high")] == pytest.approx(
        [float(dead_time[end]) for end in ("value", "low", "high")]
    )
    by_estimator = {r["estimator"]: r for r in table(folder, "estimators")}
    default = float(by_estimator["hold-aware (default)"][f"{JOINT}_lag_s"])
    assert float(budget["lag_s"]) == pytest.approx(default)
    assert "dead time" not in " ".join(re.findall(r"(?:FOPDT|SOPDT)\s+([a-z ]+)", text(folder))), (
        "a transfer function's delay is not the servo's dead time"
    )
    # what `delay` prints is what `calibrate` prints
    assert plain(lag(swept)[JOINT]) == plain(made[JOINT].lag)


def test_errors_of_one_model_on_one_recording_are_one_number(folder):
    candidates = {r["model"]: r for r in table(folder, "candidate_models")}
    compared = {r["model"]: r for r in table(folder, "servo_models")}
    carried = next(n for n, r in candidates.items() if r["is_chosen"] == "True")
    pairs = [("DelayedPD (paper)", "paper")]
    if carried.startswith("delayed_pd") and "backlash" not in carried:
        pairs.append(("DelayedPD", carried))
    for there, here in pairs:
        for name, own in (("rmse_free_run_rad", "rmse_fresh_rad"), ("rmse_held_rad",) * 2):
            assert float(compared[there][name]) == pytest.approx(
                float(candidates[here][own]), rel=0.01
            ), (there, name)


def test_what_is_identified_is_not_called_unidentified(folder, made):
    own = made.calibration.joint(JOINT).actuator
    speed = (own.velocity_limit_rad_s, own.ratios_to_armature.back_emf)
    known = any(q.identified != "no" for q in speed)
    page = text(folder)
    assert ("limit of its speed" in page) == (not known)
    assert ("friction is not identified. Record" in page) == (
        own.ratios_to_armature.friction_loss.identified == "no"
    )
    assert "cannot be identified" not in page and "cannot be seen" not in page


def test_what_is_shown_of_the_file_of_a_calibration_is_what_its_fit_found(swept, made, tmp_path):
    made.save(tmp_path / "made.yaml")
    known = load_calibration(tmp_path / "made.yaml")
    assert can_recall(known.joint(JOINT))
    fitted, found = made[JOINT], recall(known, swept, [JOINT])[JOINT]
    assert (found.model, found.simulated_model) == (fitted.model, fitted.simulated_model)
    assert found.dead_time_s == fitted.dead_time_s and found.warnings == fitted.warnings
    for name in ("lag_s", "raw_lag_s", "fresh_lag_s", "stale_lag_s", "command_hold_s"):
        assert getattr(found.lag, name) == getattr(fitted.lag, name), name
    assert list(found.candidate_models) == list(fitted.candidate_models)
    for name, fit in fitted.candidate_models.items():
        again = found.candidate_models[name]
        assert again.values == pytest.approx(fit.values)
        for score in ("rmse_fresh_rad", "rmse_held_rad", "rmse_leave_one_frequency_out_rad"):
            own, other = getattr(fit.scores, score), getattr(again.scores, score)
            assert own == pytest.approx(other, nan_ok=True), (name, score)
    assert found.delayed_pd.values == pytest.approx(fitted.delayed_pd.values)
    for before, after in zip(tracks(fitted), tracks(found), strict=True):
        np.testing.assert_allclose(after.model_rad, before.model_rad, atol=1e-9)
