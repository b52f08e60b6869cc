"""Joint fits of records of a machine whose simulation shares no code with flexid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.coverage import BY_NAME, Machine, configuration, recording_of, reference
from benchmarks.machine import Sensors
from flexid_cli.config.schema import Config
from flexid_cli.errors import UsageError
from flexid_cli.estimate import records as estimation
from flexid_cli.estimate.records import identify_records
from flexid_cli.estimate.result import Estimate, Identification, ModelResult
from flexid_cli.readers.base import RawLog
from flexid_cli.signals.recording import Recording
from flexid_cli.signals.records import Record

MACHINE = replace(BY_NAME["3"], duration_s=16.0)
SHARED = ("Jm", "K", "FVm", "FSm", "FV", "FS")
NOISE = 3e-6  # rad, 0.05 % of the torsion
PAYLOADS = {"empty": (2.0, 1.0, -2.0), "half": (2.6, 1.4, -2.5), "full": (3.4, 2.0, -3.3)}


def config(model: str = "two_encoders", **estimate: object) -> Config:
    plain = configuration(MACHINE, model, "direct")
    options = plain.estimate.model_copy(update={"confidence_level": 0.99, **estimate})
    return plain.model_copy(update={"estimate": options, "models": (model,)})


def simulated(machine: Machine, seed: int, model: str = "two_encoders") -> Recording:
    rng = np.random.default_rng(seed)
    path = rng.uniform(0.9, 1.1) * reference(machine, "chirp") + rng.uniform(-0.3, 0.3)
    sensors = Sensors(torque_noise=0.5, motor_noise=NOISE, joint_noise=NOISE)
    return recording_of(machine.run(path, sensors, seed), config(model), joint=model == "two_encoders")


def record(name: str, recording: Recording) -> Record:
    return Record(name, (Path(f"{name}.mcap"),), recording, RawLog("memory", (), {}))


def only(identification: Identification) -> ModelResult:
    [model] = identification.models
    return model


def by_symbol(model: ModelResult) -> dict[str, Estimate]:
    return {e.symbol: e for e in (*model.parameters, *model.derived)}


def holds(estimate: Estimate, truth: float) -> bool:
    assert estimate.interval is not None
    return estimate.interval.low <= truth <= estimate.interval.high


@pytest.fixture(scope="module", autouse=True)
def solved_once() -> object:
    """Each record is solved alone once, however often it is joined: the joint fit is what is tested here."""
    solve, kept = estimation._solve, {}

    def remember(one: Record, config: Config, model_id: str, f1: float | None) -> object:
        key = (id(one.recording), config.estimate.per_record, model_id)
        if key not in kept:
            kept[key] = (one.recording, solve(one, config, model_id, f1))  # keeps the recording's id its own
        return replace(kept[key][1], name=one.name)

    patch = pytest.MonkeyPatch()
    patch.setattr(estimation, "_solve", remember)
    yield
    patch.undo()


@pytest.fixture(scope="module")
def payloads() -> list[Record]:
    machines = [replace(MACHINE, JL=JL, MX=MX, MY=MY) for JL, MX, MY in PAYLOADS.values()]
    return [record(name, simulated(m, k)) for k, (name, m) in enumerate(zip(PAYLOADS, machines, strict=True))]


@pytest.fixture(scope="module")
def fitted(payloads: list[Record]) -> ModelResult:
    return only(identify_records(payloads, config(per_record=("JL", "MX", "MY"))))


def test_payloads_of_their_own_and_a_drive_that_is_shared(fitted: ModelResult) -> None:
    found = by_symbol(fitted)
    assert fitted.method == "joint fit of 3 records"
    for symbol in SHARED:
        assert holds(found[symbol], getattr(MACHINE, symbol)), symbol
    for name, truth in PAYLOADS.items():
        for symbol, value in zip(("JL", "MX", "MY"), truth, strict=True):
            assert found[f"{symbol}[{name}]"].verdict == "identified"
            assert holds(found[f"{symbol}[{name}]"], value), (symbol, name)
        ratio = truth[0] / MACHINE.Jm
        assert holds(found[f"JL/Jm[{name}]"], ratio)
        antiresonance = float(np.sqrt(MACHINE.K / truth[0])) / (2.0 * np.pi)
        assert holds(found[f"fa[{name}]"], antiresonance)
    assert found["K"].verdict == "identified"
    assert "JL" not in found
    assert fitted.fit.fit_percent > 98.0


def test_random_parts_average_out_and_systematic_ones_do_not(fitted: ModelResult) -> None:
    joint = fitted.tests["bias_budget"]["parameters"]["K"]
    alone = [one.tests["bias_budget"]["parameters"]["K"] for one in fitted.records]
    assert joint["random_percent"] < min(one["random_percent"] for one in alone)
    stderr = by_symbol(fitted)["K"].relative_stderr_percent
    for source, size in joint["systematic_percent"].items():
        assert size >= 0.9 * min(one["systematic_percent"][source] for one in alone), source
        assert stderr >= size


def test_the_records_stand_beside_the_joint_estimate(fitted: ModelResult, payloads: list[Record]) -> None:
    assert [one.name for one in fitted.records] == list(PAYLOADS)
    for one, truth in zip(fitted.records, PAYLOADS.values(), strict=True):
        own = {e.symbol: e for e in one.parameters}
        assert one.reason == ""
        assert holds(own["JL"], truth[0])
    test = fitted.tests["consistency"]
    assert test["p_value"] > 0.001
    assert set(test["parameters"]) == set(SHARED)
    assert all(one["records"] == 3 for one in test["parameters"].values())


def test_the_order_of_the_records_does_not_matter(fitted: ModelResult, payloads: list[Record]) -> None:
    found = by_symbol(fitted)
    other = by_symbol(only(identify_records(payloads[::-1], config(per_record=("JL", "MX", "MY")))))
    assert set(other) == set(found)
    for symbol, one in found.items():
        assert other[symbol].value == pytest.approx(one.value, abs=1e-6 * one.stderr)
        assert other[symbol].stderr == pytest.approx(one.stderr, rel=1e-6)
        assert other[symbol].verdict == one.verdict


def test_a_payload_that_was_not_declared_is_found(payloads: list[Record]) -> None:
    model = only(identify_records([payloads[0], payloads[2]], config()))
    found = by_symbol(model)
    assert found["JL"].verdict == "weak"
    assert "the two records contradict each other in JL" in found["JL"].reason
    assert "the two records contradict each other in JL" in found["fa"].reason
    assert holds(found["K"], MACHINE.K)
    assert model.tests["consistency"]["p_value"] < 1e-6
    [told] = [text for text in model.warnings if "JL differs between the records" in text]
    assert "name it in estimate.per_record" in told
    # Half the difference, at least, from the middle to either.
    assert found["JL"].stderr == pytest.approx(0.7, rel=0.1)


def test_a_stiffness_that_differs_between_records_widens_its_interval() -> None:
    factors = np.array([0.97, 1.01, 1.03, 0.99])
    records = [
        record(f"day {k}", simulated(replace(MACHINE, K=f * MACHINE.K), 20 + k))
        for k, f in enumerate(factors)
    ]
    model = only(identify_records(records, config(confidence_level=0.95)))
    found = by_symbol(model)
    assert holds(found["K"], MACHINE.K)
    spread = float(np.std(factors, ddof=1)) * MACHINE.K
    assert found["K"].stderr == pytest.approx(spread / 2.0, rel=0.3)
    assert found["K"].reason == "" or "the difference between the records" in found["K"].reason
    between = model.tests["consistency"]["parameters"]["K"]["between_records_stderr"]
    assert between == pytest.approx(spread, rel=0.3)
    assert any("K differs between the records" in text for text in model.warnings)
    # What agrees is not drawn along.
    for symbol in ("Jm", "JL"):
        assert holds(found[symbol], getattr(MACHINE, symbol))
        assert found[symbol].relative_stderr_percent < 0.3


# --- laws ---


def halves(recording: Recording) -> list[Recording]:
    [segment] = recording.segments
    middle = segment.samples // 2
    parts = []
    for which in (slice(0, middle), slice(middle, None)):
        arrays = {
            name: getattr(segment, name)[which]
            for name in ("torque", "motor_position", "joint_position", "reference_position")
        }
        parts.append(
            replace(recording, segments=(replace(segment, **arrays),), duration_s=recording.duration_s / 2)
        )
    return parts


@pytest.fixture(scope="module")
def there_and_back() -> list[Recording]:
    """A chirp up and down again, so that each half holds what the whole does."""
    up = reference(MACHINE, "chirp")
    path = np.concatenate([up, up[::-1]])
    sensors = Sensors(torque_noise=0.5, motor_noise=NOISE, joint_noise=NOISE)
    run = recording_of(MACHINE.run(path, sensors, 5), config(), joint=True)
    return [run, *halves(run)]


def pair(recordings: Sequence[Recording]) -> list[Record]:
    return [record(name, one) for name, one in zip(("up", "down"), recordings, strict=True)]


def test_halves_of_a_run_give_what_the_whole_gives(there_and_back: list[Recording]) -> None:
    whole = by_symbol(only(estimation_of_one(there_and_back[0])))
    joint = by_symbol(only(identify_records(pair(there_and_back[1:]), config())))
    for symbol in (*SHARED, "JL", "MX", "MY"):
        one, other = whole[symbol], joint[symbol]
        assert abs(one.value - other.value) < 1.5 * max(one.stderr, other.stderr), symbol
        assert 0.4 < other.stderr / one.stderr < 2.5, symbol


def estimation_of_one(recording: Recording) -> Identification:
    from flexid_cli.estimate.identify import identify

    return identify(recording, config())


def test_units_and_directions_are_only_names(there_and_back: list[Recording]) -> None:
    """Torque in units four times smaller, and the axis turned round."""
    plain = by_symbol(only(identify_records(pair(there_and_back[1:]), config())))
    turned = []
    for recording in there_and_back[1:]:
        [segment] = recording.segments
        turned.append(
            replace(
                recording,
                segments=(
                    replace(
                        segment,
                        torque=-4.0 * segment.torque,
                        motor_position=-segment.motor_position,
                        joint_position=-segment.joint_position,
                        reference_position=-segment.reference_position,
                    ),
                ),
            )
        )
    other = by_symbol(only(identify_records(pair(turned), config())))
    for symbol in (*SHARED, "JL", "MY"):
        one = plain[symbol]
        assert other[symbol].value == pytest.approx(4.0 * one.value, abs=4e-2 * one.stderr), symbol
        assert other[symbol].stderr == pytest.approx(4.0 * one.stderr, rel=1e-2), symbol
    assert other["MX"].value == pytest.approx(-4.0 * plain["MX"].value, abs=4e-2 * plain["MX"].stderr)
    assert other["z[up]"].value == pytest.approx(-plain["z[up]"].value, abs=1e-2 * plain["z[up]"].stderr)


# --- other models, and what is refused ---


def test_the_motor_alone_has_the_gravity_of_each_posture() -> None:
    records = [record(name, simulated(MACHINE, 40 + k, "motor_only")) for k, name in enumerate("ab")]
    model = only(identify_records(records, config("motor_only")))
    found = by_symbol(model)
    assert {"Q0[a]", "kg[a]", "Q0[b]", "kg[b]"} <= set(found)
    assert holds(found["K"], MACHINE.K)
    assert holds(found["FVm + FV"], MACHINE.FVm + MACHINE.FV)
    for one in model.records:
        for own in one.parameters:
            if own.symbol in {"Q0", "kg"}:
                assert abs(found[f"{own.symbol}[{one.name}]"].value - own.value) < 2.0 * own.stderr


def test_one_mass_whose_payload_differs() -> None:
    """A hundred times as stiff, driven far below its resonance: one total inertia for each payload."""
    records = []
    for k, (name, (JL, _, _)) in enumerate(PAYLOADS.items()):
        stiff = replace(MACHINE, K=100.0 * MACHINE.K, JL=JL)
        t = np.arange(round(16.0 * MACHINE.rate_hz)) / MACHINE.rate_hz
        path = 0.12 * np.sin(2.0 * np.pi * (0.1 * t + 0.12 * t**2))
        run = stiff.run(path, Sensors(torque_noise=0.2, motor_noise=NOISE), k)
        records.append(record(name, recording_of(run, config("rigid"), joint=False)))
    model = only(identify_records(records, config("rigid", per_record=("JL",))))
    found = by_symbol(model)
    assert model.method == "joint fit of 3 records"
    assert holds(found["FVm+FV"], MACHINE.FVm + MACHINE.FV)
    assert holds(found["FSm+FS"], MACHINE.FSm + MACHINE.FS)
    for name, (JL, _, _) in PAYLOADS.items():
        assert holds(found[f"Jm+JL[{name}]"], MACHINE.Jm + JL)
        assert found[f"Jm+JL[{name}]"].verdict == "identified"


def test_parameters_that_no_record_shows_stay_open() -> None:
    """An axis that gravity cannot move has no first moments; all else is as sure as ever."""
    plain = config()
    level = plain.model_copy(update={"axis": plain.axis.model_copy(update={"gravity_m_per_s2": 0.0})})
    machine = replace(MACHINE, MX=0.0, MY=0.0)
    records = [record(name, simulated(machine, 60 + k)) for k, name in enumerate("ab")]
    found = by_symbol(only(identify_records(records, level)))
    for symbol in ("MX", "MY"):
        assert found[symbol].verdict == "not_identifiable"
        assert found[symbol].value is None
        assert found[symbol].reason == "its column is zero in every record"
    for symbol in ("Jm", "K", "JL"):
        assert holds(found[symbol], getattr(MACHINE, symbol))
        assert found[symbol].verdict == "identified"


def test_a_record_that_cannot_be_solved_is_named_and_left_out(payloads: list[Record]) -> None:
    [segment] = payloads[1].recording.segments
    cut = {
        name: getattr(segment, name)[:200]
        for name in ("torque", "motor_position", "joint_position", "reference_position")
    }
    short = record("short", replace(payloads[1].recording, segments=(replace(segment, **cut),)))
    model = only(identify_records([payloads[0], short], config()))
    assert model.method == "structured"
    assert "only empty could be solved" in model.method_reason
    assert model.warnings[0].startswith("two_encoders: record short was left out: ")
    assert [bool(one.reason) for one in model.records] == [False, True]


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"route": "paper"}, "route paper"),
        ({"essential": True}, "essential"),
        ({"effects": ("backlash",)}, "effects"),
    ],
)
def test_what_is_for_one_record_is_refused(
    options: dict[str, object], match: str, payloads: list[Record]
) -> None:
    with pytest.raises(UsageError, match=match):
        identify_records(payloads, config(**options))
