"""The judge of the diagnosis: its counting by hand-made answers, its running by a stand-in for the tool."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks import diagnosis
from benchmarks.machine.cases import NONE, Task
from flexid_cli.errors import DataError


def _result(kinds, *answers, group="singles", verdict="explained", where=("motor",), **more):
    effects = [{"name": a[0], "alternatives": list(a[1:]), "equation": "motor"} for a in answers]
    kinds = list(kinds)
    return {
        "group": group,
        "name": f"{group}-{kinds}-{answers}",
        "kinds": kinds,
        "where": list(where),
        "share": [0.05],
        "shapes": ["rich", "updown"],
        "effects": effects,
        "verdict": verdict,
        "location": None,
        "residual_over_floor": 1.1,
        "K_interval": [9.0, 11.0],
        "K": 10.0,
        "seconds": 2.0,
        "samples": 45000,
        "memory_mb": 200.0,
        **more,
    }


@pytest.mark.parametrize(
    ("answers", "alone", "in_two", "in_three", "wrong"),
    [
        ([("cogging",)], 1, 1, 1, False),
        ([("cogging", "backlash")], 0, 1, 1, False),
        ([("backlash", "cogging")], 0, 1, 1, False),
        ([("backlash", "cogging", "hysteresis")], 0, 0, 1, False),
        ([("backlash",)], 0, 0, 0, True),
        ([("backlash", "hysteresis")], 0, 0, 0, False),
        ([("cogging",), ("backlash",)], 0, 0, 0, True),
        ([], 0, 0, 0, False),
    ],
)
def test_a_single_effect_is_judged(answers, alone, in_two, in_three, wrong):
    result = _result(["cogging"], *answers)
    assert [diagnosis.named(result, n) for n in (1, 2, 3)] == [alone, in_two, in_three]
    assert diagnosis.wrong_alone(result) is wrong


@pytest.mark.parametrize(
    ("answers", "count"),
    [
        ([("cogging",), ("backlash",)], 2),
        ([("backlash", "cogging"), ("hysteresis", "backlash")], 2),
        ([("backlash", "cogging")], 1),
        ([("cogging",), ("cogging", "hysteresis")], 1),
        ([("cogging",), ("backlash",), ("gravity",)], 0),
        ([("gravity",)], 0),
    ],
)
def test_a_pair_needs_a_set_for_each(answers, count):
    assert diagnosis.named(_result(["cogging", "backlash"], *answers, group="pairs"), 2) == count


def test_wilson_is_the_textbook_interval():
    low, high = diagnosis.wilson(8, 10)  # Wilson 1927; the figures of Brown, Cai and DasGupta 2001
    assert (low, high) == (pytest.approx(0.4902, abs=1e-4), pytest.approx(0.9433, abs=1e-4))
    assert diagnosis.wilson(0, 10) == (pytest.approx(0.0, abs=1e-12), pytest.approx(0.2775, abs=1e-4))
    assert diagnosis.wilson(0, 0) == (0.0, 1.0)


def test_targets_hold_by_their_bounds():
    right = [_result(["cogging"], ("cogging",)) for _ in range(100)]
    scores = {s.text: s for s in diagnosis.scores(right)}
    assert scores["right name alone"].holds("bound")
    assert "K's interval holds the truth" in scores
    few = {s.text: s for s in diagnosis.scores(right[:10])}
    assert not few["right name alone"].holds("bound")  # ten of ten is no proof of 85 %
    assert few["right name alone"].holds("count")
    assert few["right name alone"].holds("unless_refuted")
    none = {s.text: s for s in diagnosis.scores([_result(["cogging"], ("backlash",)) for _ in range(6)])}
    assert not none["right name alone"].holds("unless_refuted")
    wrong = [_result(["cogging"], ("backlash",), group="motor_only") for _ in range(4)]
    fine = [_result(["cogging"], ("cogging",), group="motor_only") for _ in range(96)]
    score = {s.text: s for s in diagnosis.scores(wrong + fine)}["wrong name alone"]
    assert (score.hits, score.trials) == (4, 100)
    assert not score.holds("count")


def test_outside_needs_the_right_equation():
    good = _result(["end_stop"], group="outside", verdict="unexplained", where=["load"], location="load")
    bad = _result(["end_stop"], group="outside", verdict="unexplained", where=["load"], location="motor")
    assert diagnosis.missed(good) == ""
    assert "located in motor" in diagnosis.missed(bad)
    confident = _result(["end_stop"], ("gravity",), group="outside", where=["load"], location="load")
    assert "confident" in diagnosis.missed(confident)


def test_after_the_repair():
    bad = [
        {"residual_over_floor": 1.2},
        {"residual_over_floor": None},
        {"K_interval": [11.0, 12.0]},
        {"K_interval": None},
    ]
    rows = [_result(["cogging"], ("cogging",), **more) for more in [{}, *bad]]
    scores = {s.text: (s.hits, s.trials) for s in diagnosis.scores(rows) if s.group == "named right"}
    assert set(scores.values()) == {(3, 5)}


def test_what_the_baseline_holds_of_the_paper_is_nothing_hidden():
    held, both = ["dropped_friction"], ["dropped_friction", "gravity"]
    fine = _result(held, group="paper", verdict="adequate")
    alarm = _result(held, ("backlash",), group="paper")
    named = _result(both, ("gravity", "torque_offset"), group="paper")
    missing = _result(both, group="paper", verdict="unexplained")
    assert [diagnosis.missed(r) for r in (fine, named)] == ["", ""]
    assert diagnosis.missed(alarm) == "an alarm where nothing is hidden"
    assert diagnosis.missed(missing) == "located, not named"
    scores = {s.text: (s.hits, s.trials) for s in diagnosis.scores([fine, alarm, named, missing])}
    assert scores["all that the baseline lacks named, in sets of three"] == (1, 2)
    assert scores["friction that the baseline holds: adequate"] == (1, 2)
    assert scores["wrong name alone"] == (1, 4)


def test_the_small_version_fails_where_something_is_clearly_wrong():
    right = [_result(["cogging"], ("cogging",)) for _ in range(diagnosis.SMALL_NAMED)]
    null = _result([NONE], group="nulls", verdict="adequate")
    outside = _result(["end_stop"], group="outside", verdict="unexplained")
    assert diagnosis.small_faults([*right, null, outside]) == []
    # Something that is only missed is no fault as long as enough is named.
    assert diagnosis.small_faults([*right, _result(["cogging"], verdict="unexplained")]) == []
    for wrong, why in [
        (_result(["cogging"], ("backlash",)), "a confident wrong name"),
        (_result(["end_stop"], ("gravity",), group="outside"), "a confident wrong name"),
        (_result([NONE], group="nulls", verdict="unexplained"), "an alarm"),
        (_result(["end_stop"], group="outside", verdict="adequate"), "the library does not have it"),
        (_result(["cogging"], verdict="error", error="ValueError: x"), "ValueError: x"),
    ]:
        [fault] = diagnosis.small_faults([*right, wrong])
        assert why in fault
    [fault] = diagnosis.small_faults(right[1:])
    assert fault.startswith(f"{len(right) - 1} cases named right")


def test_the_small_version_runs_its_own_cases(monkeypatch, capsys):
    jobs = list(diagnosis.small_jobs(diagnosis.TOOL))
    assert [(j.group, j.task.kinds) for j in jobs] == list(diagnosis.SMALL)
    assert all(j.task.seed < 5_000_000 for j in jobs)  # the test's begin there
    monkeypatch.setattr(diagnosis, "small_jobs", lambda tool: [replace(jobs[0], tool=tool)])
    assert diagnosis.main(["--small", "--tool", f"{__name__}:refuses"]) == 1
    assert "too little motion" in capsys.readouterr().out


def test_the_paper_s_own_route_stands_beside(monkeypatch):
    task = next(t for t in diagnosis.tasks("paper", "calibration") if t.kinds == ("dropped_friction",))
    task = replace(task, seconds=(8.0, 9.0))
    result, _ = diagnosis.run(diagnosis.Job("paper", task.name, f"{__name__}:stand_in", task=task))
    assert isinstance(result["K_paper"], float)
    assert abs(result["K_paper"] / result["K"] - 1.0) > 0.1  # Table 3's inversion, friction's terms left out


def test_summary_reads_objects_and_dictionaries():
    interval = SimpleNamespace(low=1.0, high=2.0)
    k = SimpleNamespace(symbol="K", verdict="identified", interval=interval)
    effect = SimpleNamespace(
        name="cogging", alternatives=("backlash",), where=SimpleNamespace(equation="motor")
    )
    held_out = {
        "before": {"motor": 3.0},
        "after": {"motor": 2.2, "load": 1.0},
        "noise_floor": {"motor": 2.0, "load": 1.0},
    }
    answer = {
        "verdict": "ambiguous",
        "effects": [effect],
        "location": None,
        "fit": {"held_out": held_out},
        "parameters_after": [k],
    }
    expected = diagnosis.summary(answer)
    assert expected == diagnosis.summary(SimpleNamespace(**answer))
    assert expected["residual_over_floor"] == pytest.approx(1.1)
    assert expected["K_interval"] == [1.0, 2.0]
    assert expected["effects"] == [{"name": "cogging", "alternatives": ["backlash"], "equation": "motor"}]
    weak = SimpleNamespace(symbol="K", verdict="weak", interval=interval)
    assert diagnosis.summary(answer | {"parameters_after": [weak]})["K_interval"] is None


def stand_in(recording, config, validation=None):
    """Finds a torque offset wherever the mean torque is not small, and nothing else."""
    assert config.controller is not None
    assert validation is not None
    torque = recording.segments[0].torque
    there = abs(torque.mean()) > 0.01 * torque.std()
    effects = [{"name": "torque_offset", "alternatives": (), "where": {"equation": "motor"}}] if there else []
    return {
        "verdict": "explained" if there else "adequate",
        "effects": effects,
        "location": None,
        "fit": None,
    }


def refuses(recording, config, validation=None):
    raise DataError("too little motion", "move more")


def _short(monkeypatch, kinds):
    made = [Task("singles", (kind,), 7 + k, seconds=(5.0, 6.0)) for k, kind in enumerate(kinds)]
    monkeypatch.setattr(diagnosis, "tasks", lambda group, seeds: made)


def test_results_are_resumed(monkeypatch, tmp_path, capsys):
    _short(monkeypatch, ["torque_offset", "cogging"])
    files = ["--results", str(tmp_path / "r.jsonl"), "--recipes", str(tmp_path / "sizes.jsonl")]
    arguments = ["--list", "singles", "--tool", f"{__name__}:stand_in", *files]
    assert diagnosis.main([*arguments, "--limit", "1"]) == 1  # one of one is no proof
    first = (tmp_path / "r.jsonl").read_text()
    (tmp_path / "r.jsonl").write_text(first + '{"name": "cut o')
    capsys.readouterr()
    assert diagnosis.main(arguments) == 1
    lines = diagnosis.read_lines(tmp_path / "r.jsonl")
    assert [r["kinds"] for r in lines] == [["torque_offset"], ["cogging"]]
    assert lines[0] == json.loads(first)
    assert len(diagnosis.read_lines(tmp_path / "sizes.jsonl")) == 2
    shown = capsys.readouterr()
    assert "1/1 singles-cogging" in shown.err
    assert "right name alone" in shown.out


def test_a_refusal_and_a_crash_are_results(monkeypatch, tmp_path):
    task = Task("singles", (NONE,), 9, seconds=(5.0, 6.0))
    job = diagnosis.Job("nulls", task.name, f"{__name__}:refuses", task=task)
    result, recipe = diagnosis.run(job)
    assert (result["verdict"], result["error"]) == ("refused", "too little motion")
    result, again = diagnosis.run(replace(job, tool=f"{__name__}:nowhere", recipe=recipe))
    assert result["verdict"] == "error"
    assert again == recipe
    assert diagnosis.missed(result).startswith("error: AttributeError")


def test_labelled_cases_become_configurations(recordings):
    from flexid_cli.config.load import parse_config

    jobs = list(diagnosis.labelled_jobs(recordings / "simulated", f"{__name__}:stand_in"))
    assert len(jobs) == 38
    result, _ = diagnosis.run(next(j for j in jobs if j.name == "single/case000"))
    assert result["verdict"] in ("adequate", "explained")
    assert result["group"] == "nulls"
    for job in jobs:
        facts = json.loads((job.folder / "facts.json").read_text())
        text = json.dumps(diagnosis.labelled_configuration(facts, job.name))  # JSON is YAML
        config = parse_config(text)
        assert (config.signals.joint_position is None) == (job.group == "motor_only")
