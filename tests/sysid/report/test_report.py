"""The report: one self-contained page, honest tables, nothing overwritten, names escaped."""

import csv
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from matplotlib.text import Text

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.figure_style import save
from pupper_sysid.common.page import Section, render
from pupper_sysid.common.tables import Column, Table
from pupper_sysid.sysid.doctor.examination import Examination, JointExamination
from pupper_sysid.sysid.fit.calibration_file import to_calibration
from pupper_sysid.sysid.fit.results import JointCalibrationResult
from pupper_sysid.sysid.fit.structure import CANDIDATES, candidate
from pupper_sysid.sysid.lag.frequency_response import FrequencyResponse, TransferFunction
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.report import figures
from pupper_sysid.sysid.report.figures import (
    LONGEST_RUN,
    hold_runs,
    response_errors,
    tracks,
    window,
)
from pupper_sysid.sysid.report.report import write_findings
from pupper_sysid.sysid.report.sections import Findings, advice
from support.browser import looks_right, needs_chromium
from support.joint_results import AGE_S, LATTICE, LOOP_S, fitted, interval, result_of
from support.refusals import assert_each_refused
from support.undrawn import leave_undrawn

HOSTILE = '<script>alert("x")</script>&lt;'


def recording_of(name: str = "sweep") -> Recording:
    time = LOOP_S * np.arange(20)
    table = pd.DataFrame({
        "send_time_s": time, "read_time_s": time + 1e-3, "trial": 0, "joint": "LF_thigh",
        "frequency_hz": 1.0, "command_rad": 0.5, "position_rad": 0.5,
    })  # fmt: skip
    return Recording(table, {"bus": {"kind": "emulated"}}, name, None, "0" * 64)


def examined(name: str) -> Examination:
    joint = JointExamination(
        verdict="use with care", reasons=("two frequencies only.",), loop_period_s=0.02,
        jitter_s=1e-4, fresh_fraction=2 / 3, poll_period_s=0.03, loss=0.0, z_score=20.0,
        hit_rate=1.0, quantum_rad=0.0057, reading_minus_command_rad=0.01, missing_fraction=0.0,
        peak_command_rad_s=2.5, hold_histogram=(50, 50),
    )  # fmt: skip
    return Examination(recording=name, warnings=(), joints={"LF_thigh": joint})


def report_of(results: dict[str, JointCalibrationResult], folder):
    """The report of results alone."""
    recordings = [recording_of()]
    calibration = to_calibration(results, recordings, 0)
    return write_findings(
        Findings(recordings=recordings, results=results, calibration=calibration), folder
    )


def write(folder, name: str = "sweep", force: bool = False):
    recordings, results = [recording_of(name)], {"LF_thigh": result_of()}
    calibration = to_calibration(results, recordings, 3)
    found = Findings(
        recordings=recordings, results=results, calibration=calibration,
        examinations=[(name, examined(name))], responses={"LF_thigh": response_of()},
    )  # fmt: skip
    return write_findings(found, folder, force)


class Page(HTMLParser):
    """Tags, attributes and text of a page, as a browser would see them."""

    def __init__(self, html: str):
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.text += data


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return write(tmp_path_factory.mktemp("report"), HOSTILE)


@pytest.fixture(scope="module")
def page(written):
    return Page(written.path.read_text(encoding="utf-8"))


@pytest.fixture
def undrawn(monkeypatch) -> None:
    leave_undrawn(monkeypatch)


def rows_of(written, name: str) -> list[dict[str, str]]:
    (path,) = [p for p in written.tables if p.stem == name]
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_the_page_asks_for_nothing_but_itself(page, written):
    loads = [
        v for _, a in page.tags for k, v in a.items()
        if k in ("src", "srcset", "data", "action", "href", "xlink:href")
    ]  # fmt: skip
    inside = ("data:image/png;base64,", "#")
    assert loads and all(v is not None and v.startswith(inside) for v in loads)
    html = written.path.read_text(encoding="utf-8")
    assert not re.search(r"url\((?!#)", html)
    assert "@import" not in html
    assert not {"script", "link", "iframe", "object"} & {tag for tag, _ in page.tags}


def test_ids_occur_once_and_every_reference_and_section_has_its_id(page, written):
    ids = [a["id"] for _, a in page.tags if "id" in a]
    assert len(ids) == len(set(ids))
    html = written.path.read_text(encoding="utf-8")
    used = set(re.findall(r"url\(#([^)]+)\)", html))
    links = [link for _, a in page.tags if (link := a.get("href") or a.get("xlink:href"))]
    used |= {link.removeprefix("#") for link in links if link.startswith("#")}
    assert used and used <= set(ids)
    anchors = {a["href"] for tag, a in page.tags if tag == "a" and "href" in a}
    assert anchors == {f"#{a['id']}" for tag, a in page.tags if tag == "section"}


def test_drawings_follow_the_colours_of_the_page_can_be_hidden_and_are_described(page, written):
    shown = {a["class"] for tag, a in page.tags if tag == "g" and "class" in a}
    boxes = {a["id"] for tag, a in page.tags if tag == "input"}
    assert boxes == {f"show-{part}" for part in figures.OVERLAY_PARTS}
    assert shown == {f"part-{part}" for part in figures.OVERLAY_PARTS}
    html = written.path.read_text(encoding="utf-8")
    body = html[html.index("<main>") :]
    assert "var(--drawing-blue" in body and "var(--ink" in body
    plain = set(re.findall(r"(?<!, )#[0-9a-f]{6}\b", body))
    assert plain <= {"#fdfdfd", "#111111"}, "letters on bars only"
    images = [a for tag, a in page.tags if tag == "svg"]
    assert len(images) == len(written.figures)
    assert all(len(a["aria-label"] or "") > 20 for a in images)
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in written.figures)
    assert [p.stem for p in written.drawings] == [p.stem for p in written.figures]


def test_what_the_page_says_is_what_was_found(page):
    assert HOSTILE in page.text  # shown, not run
    assert "Use with care. Two frequencies only." in page.text
    assert (
        "raw lag 81 ms = 28 ms stale readings + 10 ms command hold + 44 ms servo "
        "(24 ms dead time + 20 ms dynamics)" in page.text
    )
    assert "It prefers preset “paper” on LF_thigh." in page.text  # the raw score


def test_a_page_of_several_joints_has_one_panel_each_and_one_column_each(tmp_path, undrawn):
    names = ("LF_hip", "RF_calf")
    made = report_of({n: result_of(n) for n in names}, tmp_path)
    page = Page(made.path.read_text(encoding="utf-8"))
    assert {"overlay", "residuals"} <= {p.stem for p in made.figures}
    assert sum(tag == "details" for tag, _ in page.tags) == 1 + len(names)
    assert not any(tag == "details" and "open" in a for tag, a in page.tags)
    assert page.text.count("Only two frequencies.") == 1  # said once for all joints


def test_a_negative_age_is_explained_and_numbers_that_are_none_are_dashes_or_empty(
    tmp_path, undrawn
):
    unknown = replace(LATTICE, kind="unresolved", poll_period_s=np.nan, loss=np.nan)
    budget = replace(result_of().lag, feedback=unknown, stale_lag_s=-0.002)
    made = report_of({"LF_thigh": result_of(lag=budget)}, tmp_path)
    (row,) = rows_of(made, "lag_budget")
    assert row["feedback_poll_period_s"] == row["feedback_loss"] == ""
    html = made.path.read_text(encoding="utf-8")
    assert "younger than the row" in html
    assert not re.search(r">\s*-?(nan|inf|None)\s*<", html)


def test_commands_in_sentences_are_set_as_code_and_escaped():
    section = Section("a", "A", text=["Add `sweep --kind steps`, not `<b>`."], notes=["A ` alone."])
    html = render("t", "s", [section])
    assert "Add <code>sweep --kind steps</code>, not <code>&lt;b&gt;</code>." in html
    assert "<li>A ` alone.</li>" in html
    table = Table("t", "T", [Column("", "todo", kind="words")], [{"todo": "run `delay`"}])
    assert "run <code>delay</code></td>" in render("t", "s", [Section("a", "A", tables=[table])])


def test_the_tables_have_the_numbers_of_the_result(written):
    (row,) = rows_of(written, "lag_budget")
    assert row["joint"] == "LF_thigh"
    for name, value in (("raw_lag_s", 0.081), ("stale_lag_s", 0.0275), ("dead_time_s_low", 0.0205),
                        ("dynamics_s", 0.020)):  # fmt: skip
        assert float(row[name]) == pytest.approx(value)
    tones = rows_of(written, "by_frequency")
    assert [float(r["frequency_hz"]) for r in tones] == [1.0, 2.0]
    assert float(tones[1]["phase_deg"]) == pytest.approx(-30.0)
    transfer = {r["parameter"]: r for r in rows_of(written, "transfer_functions")}
    assert float(transfer["dead_time_s"]["high"]) == pytest.approx(0.11)
    assert float(transfer["gain"]["chi2_per_dof"]) == 1.5
    models = {r["model"]: r for r in rows_of(written, "candidate_models")}
    assert list(models) == [*CANDIDATES, "paper"]
    assert [m for m, r in models.items() if r["is_chosen"] == "True"] == ["delayed_pd"]
    assert float(models["paper"]["rmse_fresh_rad"]) == pytest.approx(0.150)
    assert float(models["delayed_pd"]["rmse_raw_rad"]) == pytest.approx(0.120)
    parameters = {(r["part"], r["parameter"]): r for r in rows_of(written, "parameters")}
    delay = parameters["actuator", "dead_time_s"]
    assert (float(delay["value"]), float(delay["low"]), delay["unit"]) == (0.024, 0.0205, "s")
    # stiffness = ratio × armature, and armature = stall torque / effort ratio
    nominal = {p.name: p.nominal for p in candidate("delayed_pd").parameters}
    expected = nominal["stiffness_per_s2"] * 0.35 / nominal["effort_rad_s2"]
    stiffness = parameters["actuator", "stiffness_nm_per_rad"]
    assert float(stiffness["value"]) == pytest.approx(expected)
    assert stiffness["identified"] == "ratio only"
    assert parameters["actuator", "effort_limit_nm"]["identified"] == "no"


def test_nothing_is_overwritten_without_force(written, tmp_path, undrawn):
    folder = tmp_path / "report"
    (folder / "tables").mkdir(parents=True)
    victim = Path(
        shutil.copy(written.path.parent / "tables/candidate_models.csv", folder / "tables")
    )
    victim.write_text("mine")
    with pytest.raises(InputError, match=r"candidate_models\.csv exists already.*force=True"):
        write(folder)
    assert victim.read_text() == "mine"
    assert not (folder / "report.html").exists(), "a refused report leaves no half of one behind"
    write(folder, force=True)
    assert victim.read_text() != "mine"


def advised(results: dict[str, JointCalibrationResult]) -> list[str]:
    return advice(results, to_calibration(results, [recording_of()], 0))


def test_advice_says_what_to_record_next_and_why():
    known = result_of()
    open_limit = fitted("delayed_pd", known.candidate_models["delayed_pd"].scores,
                        {"velocity_limit_rad_s": "never reached"})  # fmt: skip
    unreached = result_of(candidate_models=known.candidate_models | {"delayed_pd": open_limit})
    without, with_limit = (advised({"LF_thigh": r}) for r in (known, unreached))
    assert not any("Record steps" in s for s in without)
    assert any("limit of its speed" in s and "Record steps" in s for s in with_limit)
    (missing,) = [s for s in without if "Not recorded yet" in s]
    assert "LF_hip" in missing and "LF_thigh" not in missing
    # joints with the same gap are named in one sentence
    said = advised({j: result_of(j) for j in ("LF_hip", "LF_thigh")})
    (gap,) = [s for s in said if "only 2 frequencies" in s]
    assert gap.startswith("LF_hip, LF_thigh: only 2 frequencies (1, 2 Hz)")


def test_a_late_reading_is_wrong_by_speed_times_age_and_a_window_lies_within_its_trial():
    for track in tracks(result_of()):
        assert np.max(np.abs(track.fresh_error_rad)) < 1e-12
        moving = np.abs(track.row_speed_rad_s) > 0.5 * np.max(np.abs(track.row_speed_rad_s))
        slope = track.row_error_rad[moving] / track.row_speed_rad_s[moving]
        # the joint turns within the reading's age, so only the average is the age
        assert np.mean(slope) == pytest.approx(-AGE_S, rel=0.15)
        start, stop = window(track)
        assert 0 <= start < stop <= track.time_s[-1] + 1e-9
        periods = min(2.5, track.time_s[-1] * track.frequency_hz)
        assert (stop - start) * track.frequency_hz == pytest.approx(periods)


def test_predicted_hold_runs_follow_from_poll_and_loss():
    # a poll every 1.5 rows that never fails is seen after 1 row or 2, equally often
    runs = hold_runs([(50,)], [LOOP_S], LATTICE)
    assert runs.expected == pytest.approx([25.0, 25.0] + [0.0] * (LONGEST_RUN - 2), abs=1e-9)
    # half of the polls lost: gaps of 2, 4, 6 … rows, each half as frequent as the one before
    halves = replace(LATTICE, poll_period_s=0.040, loss=0.5)
    runs = hold_runs([(64,)], [LOOP_S], halves)
    assert runs.expected[:6] == pytest.approx([0, 32, 0, 16, 0, 8], abs=1e-6)
    # the last bar holds all longer ones
    histogram = (3, 1) + (0,) * LONGEST_RUN + (2,)
    runs = hold_runs([histogram, histogram], [LOOP_S, LOOP_S], LATTICE)
    assert runs.count.tolist() == [6, 2] + [0] * (LONGEST_RUN - 3) + [4]


def test_letters_in_figures_are_nine_points_or_more_and_the_parts_of_a_lag_are_end_to_end():
    drawn = [
        figures.lag_budget_figure({"LF_thigh": result_of().lag}),
        figures.overlay_figure(result_of()),
        figures.hold_histogram_figure({"LF_thigh": hold_runs([(50, 50)], [LOOP_S], LATTICE)}),
        figures.residual_figure(result_of()),
    ]
    for figure in drawn:
        sizes = [t.get_fontsize() for t in figure.findobj(Text) if t.get_text()]
        assert sizes and min(sizes) >= 9.0
    bars = [p for p in drawn[0].axes[0].patches if p.get_width() > 0]
    ends = [(b.get_x(), b.get_x() + b.get_width()) for b in bars]
    assert np.ravel(ends) == pytest.approx([0, 9.5, 9.5, 33.5, 33.5, 53.5, 53.5, 81.0])


def response_of() -> FrequencyResponse:
    """A tenth of the command, 100 ms late; 2 % uncertain along the response, 1 % across."""
    frequency = np.array([1.0, 4.0, 8.0])
    turned = 0.1 * np.exp(-2j * np.pi * 0.1 * frequency)
    along = np.stack([turned.real, turned.imag], axis=-1) / 0.1
    across = along[:, ::-1] * np.array([-1.0, 1.0])
    covariance = np.stack(
        [
            0.002**2 * np.outer(u, u) + 0.001**2 * np.outer(v, v)
            for u, v in zip(along, across, strict=True)
        ]
    )
    fit = TransferFunction(
        name="FOPDT",
        parameters={
            "gain": interval(0.1), "dead_time_s": interval(0.1), "time_constant_s": interval(1e-3)
        },
        chi2_per_dof=1.5,
    )  # fmt: skip
    return FrequencyResponse(
        joint="LF_thigh", bandwidth_hz=None, transfer_functions={"FOPDT": fit},
        frequency_hz=frequency, amplitude_rad=np.full(3, 0.2), response=turned,
        raw_response=0.5 * turned, covariance=covariance,
    )  # fmt: skip


def test_the_bode_figure_shows_gain_unwrapped_phase_and_the_intervals_of_the_covariance():
    gain, phase = figures.bode_figure({"LF_thigh": response_of()}).axes
    assert gain.lines[0].get_ydata() == pytest.approx([-20.0] * 3)
    assert phase.lines[0].get_ydata() == pytest.approx([-36.0, -144.0, -288.0])
    gain_db, phase_deg = response_errors(response_of())
    # 90 % of a Gaussian lies within 1.645 standard deviations; 1 % is 0.0869 dB or 0.573 degrees
    assert gain_db == pytest.approx(np.full(3, 1.645 * 2 * 0.08686), rel=1e-3)
    assert phase_deg == pytest.approx(np.full(3, 1.645 * 0.57296), rel=1e-3)


def test_a_figure_is_written_as_its_ending_says(tmp_path):
    figure = figures.lag_budget_figure({"LF_thigh": result_of().lag})
    save(figure, tmp_path / "a.svg")
    drawing = ElementTree.parse(tmp_path / "a.svg").getroot()
    assert drawing.tag == "{http://www.w3.org/2000/svg}svg"
    width, height = (float(drawing.attrib[k].removesuffix("pt")) for k in ("width", "height"))
    assert (width, height) == pytest.approx(72 * figure.get_size_inches())
    save(figures.lag_budget_figure({"LF_thigh": result_of().lag}), tmp_path / "b.svg")
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    cases = [("a.jpg", "a.jpg: pictures are written as .png or .svg"), ("a.svg", "exists already")]
    assert_each_refused(cases, lambda name: save(figure, tmp_path / name))


@needs_chromium
@pytest.mark.parametrize(
    ("width", "dark"), [(375, True), pytest.param(1280, False, marks=pytest.mark.slow)]
)
def test_in_a_browser_nothing_overflows_or_complains(written, tmp_path, width, dark):
    looks_right(written.path, tmp_path, width, dark)
