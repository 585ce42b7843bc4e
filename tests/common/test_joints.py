"""Sentences on several joints, said once."""

from pupper_sysid.common.joints import share_sentences


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


def test_two_sentences_of_a_kind_about_one_joint_stay_apart():
    slips = ["at 2 Hz the poll slipped by 5 ms.", "at 4 Hz the poll slipped by 9 ms."]
    assert share_sentences({"LF_hip": slips}) == [("LF_hip", text) for text in slips]


def test_names_dates_and_ranges_are_no_numbers():
    texts = ["STS3215", "2026-11-23", "1-10 Hz", "44.4…45.0", "1e-3", "v1.2.3", "1,280 rows"]
    others = ["STS3216", "2026-11-24", "1-11 Hz", "44.4…45.1", "1e-4", "v1.2.4", "1,300 rows"]
    texts += ["in trial 3 it slipped", "row 12 is late", "servo 4 is slow"]
    others += ["in trial 7 it slipped", "row 15 is late", "servo 9 is slow"]
    for text, other in zip(texts, others, strict=True):
        assert share_sentences({"a": [text], "b": [other]}) == [("a", text), ("b", other)]
