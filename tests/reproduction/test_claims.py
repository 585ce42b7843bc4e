"""Claims are judged by what the evidence says, and unknown evidence is said to be unknown."""

import csv
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

import reproduction.__main__ as program
import reproduction.page
from pupper_sysid.cli.programs import pupper_analyze
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import sha256
from pupper_sysid.common.interval import Interval
from pupper_sysid.data import SAMPLES
from pupper_sysid.policies.analysis.autonomy import (
    DELAYS_MS,
    NUDGE_M_S,
    PUSH_M_S,
    Autonomy,
    FrozenTest,
    Orbits,
    PushTest,
    RatePoint,
    rate_exponent,
)
from pupper_sysid.policies.analysis.trial import (
    AblationPoint,
    DelayPoint,
    DirectionWalk,
    GroundPoint,
)
from pupper_sysid.policies.train.run_file import Run, preset, save_run
from pupper_sysid.sysid.compare.compare import FITTED, PUBLISHED, four_way
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.servo_fit import networks
from pupper_sysid.sysid.servo_fit.training import Recipe
from reproduction import servos as servo_claims
from reproduction.evidence import Claim, PolicyEvidence, ScalePoint, Training, training
from reproduction.policies import judge
from support.command_line import json_of, ran, refused
from support.walks import walked

CURVE = np.random.default_rng(0).random((50, 3))


def known(value: float) -> Interval:
    return Interval(value, value - 0.1, value + 0.1)


def changed(rows: Sequence, **how) -> list:
    """The same rows with other values; a callable gets the row."""
    return [replace(r, **{k: v(r) if callable(v) else v for k, v in how.items()}) for r in rows]


def evidence(kind: str, name: str | None = None) -> PolicyEvidence:
    """A policy that walks well whatever is done to it."""
    delays = sorted({*DELAYS_MS, 160.0})
    orbit = Orbits(
        states=[np.zeros((500, 12))] * 3, orbits=[CURVE[:, :3]] * 3, explained=[0.9],
        explained_3=0.9, participation_ratio=2.0, closure=[0.1] * 3, area_ratio=[1.0] * 3,
    )  # fmt: skip
    gait = {"frequency_hz": 3.0, "amplitude_rad": 0.2, "jitter_rad": 0.01}
    frozen = tuple(
        FrozenTest(test=test, share=share, **gait)
        for test, share in (
            ("nothing frozen", 1.0), ("senses frozen, its own last action", 1.0),
            ("senses and last action frozen", 0.0), ("last action frozen, senses recorded", 0.5),
        )
    )  # fmt: skip
    pushes = tuple(
        PushTest(push_m_s=speed, survival=1.0, shift_early=s, shift_late=s, kept=1.0,
                 phases=(0.1, 0.6), shifts=(s, -s))
        for speed, s in ((NUDGE_M_S, 0.01), (PUSH_M_S, 0.2))
    )  # fmt: skip
    gait |= {"survival": 1.0, "mae_vx_m_s": 0.02}
    rates = tuple(RatePoint(rate_hz=r, cycles_per_step=0.06, **gait) for r in (25.0, 50.0))
    directions = ("forward", "backward", "left", "right", "turn left", "turn right")
    return PolicyEvidence(
        name or kind, kind, {"reward": 7.0, "std": 0.01, "updates": 60.0, "steps_per_s": 1000.0},
        False, "flat", "a trot", walked((0.15, 0.0, 0.0), 0.15, 0.0, 0.0), None,
        {"actions": orbit, "hidden": orbit},
        [
            DelayPoint(extra_delay_ms=d, mode=m, **gait)
            for d in delays for m in ("replay", "fixed", "jittered")
        ],
        [
            AblationPoint(
                channel="all joints", kind=k, level=level, sigma=0.1, correlation=r, **gait
            )
            for k, level, r in (("noise", 0.1, 0.99), ("noise", 0.5, 0.6), ("zero", 0.0, 0.7))
        ],
        Autonomy(frozen=frozen, push=pushes, rate=rates, rate_exponent=rate_exponent(rates)),
        [ScalePoint(scale_rad=s, **gait) for s in (0.45, 0.5, 0.6, 0.75)],
        [GroundPoint(ground=g, **gait) for g in ("flat", "rough")],
        [
            DirectionWalk(direction=d, command=(0.1, 0, 0), survival=1.0, share=known(0.9),
                          drift=known(0.0), arc_rad_m=known(-0.2), wander_m=known(0.0),
                          path=CURVE[:, :2])
            for d in directions
        ],
    )  # fmt: skip


def with_tests(policy: PolicyEvidence, **tests) -> PolicyEvidence:
    """The same policy with other results of some tests of autonomy."""
    return replace(policy, autonomy=replace(policy.autonomy, **tests))


def learned(kind: str, **how) -> Training:
    """A training from random weights that ended with a robot that stays up."""
    values = {
        "reward": 7.0, "std": 0.1, "steps_per_s": 1000.0, "million_samples": 20.0, "lasted_s": 19.0,
        "episode_s": 20.0, "learned_noise": True, "curriculum": False, "curve": (CURVE[:, 0],) * 3,
    }  # fmt: skip
    return Training(name=kind, kind=kind, **(values | how))


def claims(*policies: PolicyEvidence, played=None, stacks=()) -> dict[str, Claim]:
    return {c.id: c for c in judge(policies, played or {}, stacks)}


def verdicts(*policies: PolicyEvidence, played=None, stacks=()) -> dict[str, str]:
    return {i: c.verdict for i, c in claims(*policies, played=played, stacks=stacks).items()}


def assert_judged(cases: Sequence, judged: Callable[..., Sequence[Claim]]) -> None:
    """Each case: evidence, claim, verdict, and words that its numbers or reasons must have."""
    problems = []
    for known, id_, verdict, words in cases:
        row = next(c for c in judged(known) if c.id == id_)
        if row.verdict != verdict or words not in row.ours + row.how:
            problems.append(f"{id_}: {verdict}, {words!r}: {row}")
    assert not problems, "\n".join(problems)


def drifting(row: DelayPoint) -> float:
    """A frequency that grows with the delay."""
    return 3.0 + row.extra_delay_ms / 300


BOTH = (evidence("mlp"), evidence("lstm"))


def test_every_claim_has_a_row_with_all_its_parts():
    found = [*servo_claims.judge(servo_claims.ServoEvidence()), *judge(BOTH, {}, [])]
    assert len(found) >= 30 and len({c.id for c in found}) == len(found)
    for claim in found:
        assert claim.claim and claim.paper and claim.ours and claim.how


def test_without_evidence_nothing_is_decided():
    found = verdicts(evidence("gru"))
    for id_ in ("T1", "G2", "G3", "P1", "P2", "B1", "B3", "X1", "X2", "D2", "D3", "G1"):
        assert found[id_] == "not testable here", id_
    nothing = servo_claims.judge(servo_claims.ServoEvidence())
    assert {c.verdict for c in nothing} == {"not testable here"}
    assert all("--recordings" in c.how for c in nothing)


def test_a_claim_about_policies_is_judged_by_what_its_evidence_says():
    (mlp, lstm), nan = BOTH, float("nan")
    untestable, contradicted = "not testable here", "does not hold here"

    def frozen(share: float, **tests) -> PolicyEvidence:
        return with_tests(lstm, frozen=changed(lstm.autonomy.frozen, share=share), **tests)

    def delayed(policy: PolicyEvidence, hz, name: str = "") -> PolicyEvidence:
        delay = changed(policy.delay, frequency_hz=hz)
        return replace(policy, delay=delay, name=name or policy.name)

    def knowing(place: int, share: float) -> PolicyEvidence:
        rows = list(lstm.compliance)
        rows[place] = replace(rows[place], share=known(share))
        return replace(lstm, compliance=rows)

    robust = changed(mlp.ablation, correlation=lambda r: 0.95 if r.kind == "noise" else 0.7)
    robust = replace(lstm, ablation=robust)
    lost = replace(lstm, ablation=changed(lstm.ablation, correlation=nan))
    fallen = [
        replace(r, frequency_hz=nan, survival=0.0) if r.rate_hz < 50 else r
        for r in mlp.autonomy.rate
    ]  # fmt: skip
    two_rates = [
        delayed(p, hz, f"{p.kind}-{hz}") for p in BOTH for hz in (2.5, 2.9)
    ]  # fmt: skip
    one_wild = [delayed(p, drifting) if p.name.endswith("2.9") else p for p in two_rates]
    cases = [
        (BOTH, "X1", "holds partly", ""), ((mlp, frozen(0.9)), "X1", "holds", ""),
        ((mlp, frozen(0.1)), "X1", contradicted, ""),
        # one that does not walk is no oscillator; without pushes, frozen inputs decide
        ((mlp, frozen(nan, push=())), "X1", untestable, ""),
        ((mlp, with_tests(lstm, push=())), "X1", "holds partly", ""),
        (BOTH, "G2", "holds", ""), (BOTH, "G3", contradicted, ""),
        ((delayed(mlp, drifting), lstm), "G3", "holds", ""),
        ((mlp, delayed(lstm, drifting)), "G2", contradicted, ""),
        # policies of a kind that each keep a rate of their own are not erratic
        (two_rates, "G2", "holds", ""), (two_rates, "G3", contradicted, ""),
        (one_wild, "G2", "holds partly", ""), (one_wild, "G3", "holds partly", ""),
        ((delayed(mlp, nan), lstm), "G3", untestable, "no rhythm"),
        ((mlp, delayed(lstm, nan)), "G2", untestable, "no rhythm"),
        ((mlp, robust), "B2", contradicted, "LSTM ∞"),
        # one of two is not left out of the mean
        ((mlp, lstm, replace(robust, name="b")), "B2", contradicted, "LSTM ∞"),
        ((mlp, lost), "B2", untestable, "Of the LSTM that was given there is no number"),
        (
            (with_tests(mlp, rate=fallen), with_tests(lstm, rate=fallen)), "D1", contradicted,
            "MLP 0, LSTM 0 %",
        ),
        *(((mlp, knowing(place, 0.0)), "C1", contradicted, "") for place in (0, 1)),
        *(((replace(mlp, ground=g), lstm), "B3", untestable, "") for g in ("rough", None)),
    ]  # fmt: skip
    assert_judged(cases, lambda policies: judge(policies, {}, []))
    for place in (0, 1):
        assert "LSTM" not in claims(mlp, knowing(place, nan))["C1"].ours
    assert claims(*BOTH)["B3"].verdict != untestable


def test_claims_about_training_are_judged_by_trainings_from_random_weights():
    untestable, contradicted = "not testable here", "does not hold here"
    both, gru = [learned("mlp"), learned("lstm")], learned("gru")
    fallen = [learned(k, lasted_s=0.3) for k in ("mlp", "lstm", "gru", "transformer")]
    cases = [
        ([], "T1", untestable, "Policies that imitated a gait do not tell"),
        (fallen, "T1", untestable, "for 0.3 s of 20 s"), (fallen, "T3", untestable, "20.0"),
        ([*both, gru], "T1", contradicted, ""), (both, "T1", untestable, "of a GRU"),
        ([*both, learned("gru", reward=2.0)], "T1", "holds", ""),
        ([*both, gru], "T2", contradicted, ""),
        ([*both, learned("gru", std=0.3)], "T2", "holds", ""),
        ([replace(t, learned_noise=False) for t in (*both, gru)], "T2", untestable, ""),
        (both, "T3", contradicted, ""),
        ([learned("mlp", lasted_s=3.0), both[1]], "T3", "holds", ""),
        ([learned("mlp", curriculum=True), both[1]], "T3", untestable, "MLP"),
        ([*both, learned("transformer", steps_per_s=300.0)], "T4", "holds", ""),
        (both, "T4", untestable, "Transformer"),
    ]  # fmt: skip
    several = [*both, learned("lstm", reward=6.0), gru]
    first = next(c for c in judge(BOTH, {}, [], several) if c.id == "T1")
    assert first.interval["LSTM"] == Interval(6.5, 6.0, 7.0)
    assert_judged(cases, lambda trainings: judge(BOTH, {}, [], trainings))


def test_a_training_is_read_from_its_run(tmp_path):
    save_run(tmp_path / "imitated", Run())
    with pytest.raises(InputError, match="imitated a trot before PPO"):
        training(tmp_path / "imitated")
    run = tmp_path / "run"
    save_run(run, preset("paper", "gru"))
    with pytest.raises(InputError, match="nothing was trained yet"):
        training(run)
    (run / "progress.csv").write_text(
        "update,reward,std,samples,episode_steps,collect_s,update_s\n"
        "1,0.02,0.9,1000,40,1,1\n2,0.04,0.7,2000,60,1,1\n"
    )
    found = training(run)
    assert (found.kind, found.learned_noise, found.curriculum) == ("gru", True, False)
    assert (found.reward, found.std, found.lasted_s) == pytest.approx((1.5, 0.8, 1.0))
    assert (found.steps_per_s, found.million_samples) == pytest.approx((500.0, 0.002))


def test_stacks_differ_only_if_the_interval_of_their_difference_says_so():
    keys = ("mae_vx_m_s", "mae_vy_m_s", "mae_yaw_rad_s")
    row = {"falls": 0.0} | {k: known(0.05) for k in keys}
    for low, high, verdict in (
        (-0.03, -0.01, "holds"), (0.01, 0.03, "does not hold here"), (-0.01, 0.01, "holds partly")
    ):  # fmt: skip
        less = {f"less_{k}": Interval((low + high) / 2, low, high) for k in keys}
        stacks = [row | {"stack": "encoders"}, row | {"stack": "servo model"} | less]
        assert verdicts(*BOTH, stacks=stacks)["D3"] == verdict


def test_servos_that_make_a_saw_tooth_rounder_are_seen_and_drift_is_not_judged_as_a_gait():
    time = 0.02 * np.arange(500)
    saw, smooth = 2 * (2.8 * time % 1.0) - 1, np.sin(2 * np.pi * 2.8 * time)
    drift = np.cumsum(np.random.default_rng(0).standard_normal((2, 500)), axis=1)
    for command, reading, verdict, words in (
        (saw, smooth, "holds partly", "2.80 Hz"), (*drift, "not testable here", "of noise"),
        (drift[0], np.full(500, np.nan), "not testable here", "nothing was read"),
    ):  # fmt: skip
        found = claims(*BOTH, played={"LF_thigh": (time, command, reading)})["G1"]
        assert found.verdict == verdict and words in found.ours + found.how


@pytest.mark.slow
def test_four_ways_on_the_sample_playback_score_unseen_readings_only(monkeypatch):
    small = Recipe(8, 2, (0.3, 3.0), 60, 1e-2, 20, 2)
    monkeypatch.setattr(networks, "MLP", small)
    monkeypatch.setattr(networks, "LSTM", small)
    recording = load(SAMPLES / "playback.csv")
    found = four_way(recording, ["LF_thigh"], seed=0)
    assert set(found.tracks) == {PUBLISHED, "LSTM", "MLP"} and FITTED in found.models
    whole = sum(len(t.send_time_s) for t in recording.trials("LF_thigh"))
    scored = {n: len(m.errors["LF_thigh"].free_run) for n, m in found.models.items()}
    assert len(set(scored.values())) == 1 and next(iter(scored.values())) < 0.5 * whole
    rms = {n: m.mean.rmse_free_run_rad for n, m in found.models.items()}
    assert rms["MLP"] < rms[PUBLISHED]
    claims = {
        c.id: c for c in servo_claims.judge(
            servo_claims.ServoEvidence(servos=found, played=recording)
        )
    }  # fmt: skip
    assert claims["S1"].verdict in ("holds", "does not hold here") and "mrad" in claims["S1"].ours
    assert claims["A1"].verdict == "not testable here"
    # commands that were never repeated do not say how well the robot repeats itself
    once = replace(found, repeatability_rad={"LF_thigh": float("nan")})
    for c in servo_claims.judge(servo_claims.ServoEvidence(servos=once, played=recording)):
        assert c.id != "S4" or c.verdict == "not testable here"


POLICIES = [SAMPLES / "policies" / kind for kind in ("lstm", "mlp")]
ARGUMENTS = (*POLICIES, "--actuator", SAMPLES / "calibrated.yaml")


@pytest.fixture
def gathered(tmp_path, monkeypatch):
    """Policies that walk well are known to, without walks; results go to an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        "reproduction.page.gather", lambda name, policy, *rest: evidence(policy.contract.kind, name)
    )


@pytest.mark.slow
def test_the_page_has_every_claim_and_its_pictures(capsys, tmp_path, gathered):
    out, err = ran(capsys, *ARGUMENTS, "--json", program=program)
    assert " ".join(err.split()).count("they take the numbers of") == 1, "said once, not by policy"
    found = json.loads(out)
    assert set(found["claims"][0]) == {
        "id", "claim", "paper", "ours", "interval", "verdict", "how",
    }  # fmt: skip
    page = Path(found["page"]).read_text()
    for claim in found["claims"]:
        assert f"| {claim['id']} " in page
    for picture in found["pictures"]:
        assert f"({picture})" in page
        # not where `pupper-analyze ablation` draws its own
        assert (tmp_path / "analysis/claims" / picture).stat().st_size > 5000
    assert "Table I" in page
    assert "--command 0.15 0 0 --robots 16 --seconds 10 --seed 0" in page
    contract = json.loads((POLICIES[0] / "contract.json").read_text())
    for digest in (contract["weights_sha256"], sha256(SAMPLES / "calibrated.yaml")):
        assert digest in page
    assert f"mujoco {version('mujoco')}" in page
    assert {Path(p).stem for p in found["pictures"]} <= set(reproduction.page.PICTURES)
    beside = {p.relative_to("analysis/claims") for p in Path("analysis/claims").rglob("*.*")}
    drawn = {Path(p).with_suffix(ending) for p in found["pictures"] for ending in (".png", ".svg")}
    tables = {Path(f"tables/{name}.csv") for name in reproduction.page.TABLES if name != "beside"}
    assert beside == drawn | tables | {Path("claims.md"), Path("claims.html")}
    rows = list(csv.DictReader((Path("analysis/claims") / "tables/claims.csv").open()))
    assert [row["verdict"] for row in rows] == [claim["verdict"] for claim in found["claims"]]
    report = Path(found["report"]).read_text()
    assert "Table I" in report and report.count('<svg class="drawing"') == len(found["pictures"])
    assert all(claim["id"] in report for claim in found["claims"])
    again = refused(capsys, program, *ARGUMENTS)
    assert "claims.md exists already" in again
    twice = refused(capsys, program, POLICIES[0], POLICIES[0], *ARGUMENTS[2:], "--out", "b")
    assert "rename" in twice
    Path("c/figures").mkdir(parents=True)
    Path("c/figures/ablation.png").touch()
    taken = refused(capsys, program, *ARGUMENTS, "--out", "c")
    assert "ablation.png exists already" in taken


def test_claims_that_another_page_judges_otherwise_are_listed_beside(capsys, gathered, monkeypatch):
    monkeypatch.setattr("reproduction.page._draw", lambda *evidence: [])  # drawn above
    found = json_of(capsys, *ARGUMENTS, "--out", "a", program=program)
    first = {c["id"]: c for c in found["claims"]}
    assert first["C1"]["verdict"] == "holds"
    table = Path("a/tables/claims.csv")
    ran(capsys, *ARGUMENTS, "--beside", table, "--out", "b", program=program)
    alike = Path("b/claims.md").read_text()
    assert "Every claim that both pages have is judged alike." in alike
    assert not Path("b/tables/beside.csv").exists()
    rows = list(csv.DictReader(table.open()))
    next(row for row in rows if row["id"] == "C1")["verdict"] = "does not hold here"
    with table.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    ran(capsys, *ARGUMENTS, "--beside", table, "--out", "c", program=program)
    (row,) = csv.DictReader(Path("c/tables/beside.csv").open())
    assert (row["id"], row["verdict"], row["verdict_there"]) == (
        "C1", "holds", "does not hold here"
    )  # fmt: skip
    line = f"| C1 | {row['claim']} | {row['here']} | holds | {row['there']} | does not hold here |"
    assert line in Path("c/claims.md").read_text()
    assert sha256(table) in Path("c/claims.md").read_text()
    assert "Judged otherwise" in Path("c/claims.html").read_text()


def test_tables_that_are_none_and_policies_of_an_unpublished_kind_are_refused_before_any_walk(
    capsys, tmp_path
):
    table, policy, out = tmp_path / "table.csv", SAMPLES / "policies/lstm", tmp_path / "out"
    for text, words in (
        ("id,claim\nA1,x\n", "has no column `ours`"),
        ("id,ours,verdict\nA1,x,perhaps\n", "verdict of A1 is 'perhaps'"),
    ):
        table.write_text(text)
        assert words in refused(capsys, program, policy, "--beside", table, "--out", out)
    contract = tmp_path / "more/contract.json"
    shutil.copytree(SAMPLES / "policies/mlp", contract.parent)
    contract.write_text(contract.read_text().replace('"kind": "mlp"', '"kind": "mlp-actions"'))
    servos = ("--actuator", SAMPLES / "calibrated.yaml")
    said = refused(capsys, program, contract.parent, *servos, "--out", out)
    assert "of the kind mlp-actions" in said
    answer = refused(capsys, pupper_analyze, "claims", "runs/A", "--robots", "2")
    assert "`python -m reproduction runs/A --robots 2`" in answer
