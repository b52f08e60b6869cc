"""``flexid simulate`` as its user meets it: what it writes is what `identify` and `build_recording` read."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from flexid_cli.cli.main import main
from flexid_cli.config.load import load_config, parse_config
from flexid_cli.config.schema import Config
from flexid_cli.readers.registry import read_log
from flexid_cli.signals.build import build_recording
from flexid_cli.simulate import logged
from flexid_cli.simulate.overlay import as_recorded
from flexid_cli.simulate.parameters import Given, from_config
from flexid_cli.simulate.reference import KINDS
from flexid_cli.simulate.setup import Wishes, prepare, run

ROOT = Path(__file__).resolve().parents[2]
WRIST = {
    "Jm": 17.5,
    "K": 2400.0,
    "JL": 4.7,
    "FVm": 24.0,
    "FSm": 4.1,
    "FV": 8.3,
    "FS": 0.85,
    "MX": -0.5,
    "MY": -5.0,
}
CONFIG = f"""\
version: 1
axis: {{name: wrist, gear_ratio: 50, torque_constant_nm_per_a: 0.35}}
signals:
  motor_current:      {{source: /joint_states/motor/effort, unit: A, hold: sample}}
  motor_position:     {{source: /joint_states/motor/position, unit: rad, side: motor}}
  joint_position:     {{source: /joint_states/joint/position, unit: rad}}
  reference_position: {{source: /joint_states/reference/position, unit: rad, side: motor}}
controller: {{kp: 8.0, kv: 300.0, ki: 800.0, velocity_feedforward: 0.0}}
models: [two_encoders]
simulation:
  parameters: {json.dumps(WRIST).replace('"', "")}
  sensors: {{motor_resolution: 2.0e-6, joint_resolution: 1.0e-5, torque_noise: 0.2}}
  trajectory: {{kind: chirp, amplitude: 0.08, start_hz: 0.1, stop_hz: 15}}
  duration_s: 20
  rate_hz: 200
  seed: 3
"""


@pytest.fixture
def axis(tmp_path: Path) -> Path:
    path = tmp_path / "axis.yaml"
    path.write_text(CONFIG, encoding="utf-8")
    return path


def simulate(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, ["simulate", *map(str, arguments)], env={"COLUMNS": "80"})


def done(*arguments: str | Path) -> Result:
    result = simulate(*arguments)
    assert result.exit_code == 0, result.output
    return result


def content(path: Path) -> dict[str, bytes]:
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    return {file.name: file.read_bytes() for file in files}


NAMES = ("run.csv", "run.csv.gz", "run.mcap", "run.bag", "run", "run2.db3")


def test_every_container_holds_the_same_record_and_identify_finds_the_parameters(
    axis: Path, tmp_path: Path
) -> None:
    outputs = [tmp_path / name for name in NAMES]
    done("-c", axis, *(part for path in outputs for part in ("-o", path)))
    config = load_config(axis)
    records = [build_recording([path], config)[0] for path in outputs]
    for record in records[1:]:
        assert record.start_ns == records[0].start_ns == logged.START_NS
        [one], [other] = records[0].segments, record.segments
        for name in ("torque", "motor_position", "joint_position", "reference_position"):
            np.testing.assert_array_equal(getattr(other, name), getattr(one, name))
    result = CliRunner().invoke(main, ["identify", str(outputs[2]), "-c", str(axis), "--json"])
    assert result.exit_code == 0, result.output
    [model] = json.loads(result.stdout)["models"]
    for p in model["parameters"]:
        true = WRIST.get(p["symbol"], 0.0)
        assert abs(p["estimate"] - true) < 5.0 * p["stderr"], p["symbol"]
        assert p["symbol"] == "z" or abs(p["estimate"] - true) < 0.1 * abs(true), p["symbol"]


def test_the_same_arguments_give_the_same_bytes(axis: Path, tmp_path: Path) -> None:
    for folder in ("a", "b", "other"):
        (tmp_path / folder).mkdir()
        seed = "4" if folder == "other" else "3"
        outputs = [tmp_path / folder / name for name in (*NAMES, "truth.json")]
        arguments = [part for path in outputs for part in ("-o", path)]
        done("-c", axis, "--duration", "2", "--seed", seed, *arguments)
    for name in (*NAMES, "truth.json"):
        assert content(tmp_path / "a" / name) == content(tmp_path / "b" / name), name
        assert content(tmp_path / "a" / name) != content(tmp_path / "other" / name), name


def test_the_truth_that_is_written_gives_the_record_again(axis: Path, tmp_path: Path) -> None:
    first = ("--effects", "backlash=0.001,hysteresis.hysteresis_torque=3", "-p", "K=2500", "--duration", "2")
    result = done("-c", axis, *first, "-o", tmp_path / "a.csv", "-o", tmp_path / "a.json")
    assert "hysteresis.hysteresis_length is not given: 0.001 is used" in result.stderr
    truth = json.loads((tmp_path / "a.json").read_text())
    assert truth["axis"]["K"] == 2500.0
    assert truth["effects"]["backlash"] == {"gap": 0.001}
    assert truth["effects"]["hysteresis"] == {
        "hysteresis_torque": 3.0,
        "hysteresis_length": 0.001,
        "hysteresis_exponent": 1.0,
    }
    plain = tmp_path / "plain.yaml"
    plain.write_text(
        CONFIG.partition("  parameters:")[0] + "  trajectory:" + CONFIG.partition("  trajectory:")[2]
    )
    done("-c", plain, "--truth", tmp_path / "a.json", "--duration", "2", "-o", tmp_path / "b.csv")
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    done("-c", axis, "--duration", "2", "-o", tmp_path / "c.csv")
    assert (tmp_path / "a.csv").read_bytes() != (tmp_path / "c.csv").read_bytes()


def test_the_sample_logs_are_simulated_again() -> None:
    """The parameters of the truth file and the reference of the log give the log, within noise and counts."""
    files = [ROOT / "sample_logs" / name for name in ("axis3.truth.json", "axis3.mcap")]
    result = done("-c", ROOT / "configs/axis3.yaml", "--truth", files[0], "--like", files[1], "--json")
    signals = json.loads(result.stdout)["signals"]
    assert signals["torque"]["residual_rms"] == pytest.approx(2.0, rel=0.1)  # 2 N.m of noise, and counts
    assert signals["joint_position"]["residual_rms"] < 0.5 * 1.2e-5  # less than a count
    assert signals["motor_position"]["residual_rms"] < 1.5 * 1.92e-6  # a count and a half


# --- in the configuration's own terms ---

TERMS: dict[str, dict[str, Any]] = {
    "plain": {},
    "instant": {"motor_current": {"hold": "instant"}},
    "hold not given": {"motor_current": {"hold": None}},
    "scale, offset, sign": {
        "motor_current": {"unit": "mA", "scale": 0.5, "offset": -30.0, "sign": -1},
        "motor_position": {"unit": "deg", "scale": -2.0, "offset": 3.0},
        "joint_position": {"unit": "arcsec", "sign": -1, "offset": 40.0},
    },
    "joint side": {
        "motor_position": {"side": "joint", "unit": "mrad"},
        "reference_position": {"side": "joint"},
        "joint_position": {"side": "motor"},
    },
    "torque at the joint": {"motor_current": None, "joint_torque": {"unit": "kN.m", "hold": "sample"}},
    "torque at the motor": {"motor_current": None, "motor_torque": {"unit": "N.m", "hold": "sample"}},
    "volts": {"motor_current": {"unit": "V", "torque_per_volt": 0.2}},
    "counts": {
        "motor_position": {"unit": "count", "counts_per_rev": 65536, "side": "motor"},
        "joint_position": {"unit": "count", "counts_per_rev": 8_000_000},
    },
    "counts that wrap": {
        "motor_position": {"unit": "count", "counts_per_rev": 65536, "side": "motor", "unwrap": True}
    },
    "wrapped angle": {"motor_position": {"unit": "deg", "unwrap": True}},
    "late stamps": {
        "motor_current": {"delay_s": 0.0125},
        "motor_position": {"delay_s": 0.005},
        "joint_position": {"delay_s": -0.004},
        "reference_position": {"delay_s": 0.01},
    },
}


def config_with(terms: dict[str, Any]) -> Config:
    data = load_text(CONFIG)
    for role, keys in terms.items():
        if keys is None:
            del data["signals"][role]
            continue
        signal = data["signals"].setdefault(role, {"source": "/joint_states/motor/effort"})
        signal.update(keys)
        data["signals"][role] = {k: v for k, v in signal.items() if v is not None}
    del data["simulation"]["sensors"]
    data["simulation"]["duration_s"] = 4
    return Config.model_validate(data)


def load_text(text: str) -> dict[str, Any]:
    data: dict[str, Any] = parse_config(text).resolved()
    return data


@pytest.mark.parametrize("case", TERMS)
@pytest.mark.parametrize("name", ["run.csv", "run.mcap"])
def test_signals_are_written_in_the_terms_of_the_configuration(case: str, name: str, tmp_path: Path) -> None:
    """What `build_recording` makes of the log is what was simulated, joint side."""
    config = config_with(TERMS[case])
    assert config.simulation is not None
    setup = prepare(config, from_config(config.simulation), Wishes())
    result = run(setup)
    logged.write(tmp_path / name, logged.as_logged(result, setup.rate_hz, config), config)
    recording, _ = build_recording([tmp_path / name], config)
    assert recording.sample_rate_hz == pytest.approx(setup.rate_hz, rel=1e-6)
    [segment] = recording.segments
    at = segment.start_s + (recording.start_ns - logged.START_NS) * 1e-9
    time = at + np.arange(segment.samples) / recording.sample_rate_hz
    inner = (time > 0.2) & (time < result.time_s[-1] - 0.2)

    def off(values: np.ndarray | None, true: np.ndarray) -> float:
        assert values is not None
        expected = np.interp(time, result.time_s, true)
        smooth = np.interp(time, result.time_s, np.abs(np.gradient(np.gradient(true)))).max()
        return float(np.abs(values - expected)[inner].max() - smooth)

    # Straight lines between samples are off by an eighth of the second difference; counts by half of one.
    assert off(segment.motor_position, result.motor_position) < 1e-9
    assert off(segment.joint_position, result.joint_position) < 1e-9
    assert off(segment.reference_position, setup.reference) < 1e-9
    held = 0.5 * (
        result.torque + np.concatenate((result.torque[:1], result.torque[:-1]))
    )  # as it acts on average
    assert off(segment.torque, held) < 1e-9


def test_columns_stand_where_the_configuration_says(tmp_path: Path) -> None:
    """A table without header: numbered columns, semicolons, decimal commas, milliseconds, lines to skip."""
    config = parse_config((ROOT / "configs/csv_current.yaml").read_text(encoding="utf-8"))
    data = config.resolved()
    data["csv"]["skip_rows"] = 2
    data["signals"]["joint_position"]["source"] = 6
    data |= {"controller": load_text(CONFIG)["controller"], "simulation": load_text(CONFIG)["simulation"]}
    path = tmp_path / "run.csv"
    config = Config.model_validate(data)
    assert config.simulation is not None
    setup = prepare(config, from_config(config.simulation), Wishes(duration_s=2.0))
    result = run(setup)
    logged.write(path, logged.as_logged(result, setup.rate_hz, config), config)
    rows = path.read_text(encoding="utf-8").splitlines()
    assert rows[:2] == ["-", "-"]
    assert [len(row.split(";")) for row in rows[2:5]] == [6, 6, 6]
    assert rows[3].split(";")[0] == "1000000005,0"
    counts = np.array([float(row.split(";")[2].replace(",", ".")) for row in rows[2:]])
    np.testing.assert_array_equal(counts, np.round(counts))
    recording, _ = build_recording([path], config)
    step = 2.0 * np.pi / 65536 / 121
    joint_side = recording.segments[0].motor_position - result.motor_position[: recording.segments[0].samples]
    turns = joint_side / (2.0 * np.pi / 121)
    assert np.abs(turns - np.round(turns[0])).max() * 2.0 * np.pi / 121 < 2.0 * step


def test_a_record_without_times_has_the_rate_of_its_configuration(tmp_path: Path) -> None:
    config = tmp_path / "axis.yaml"
    config.write_text(
        CONFIG.replace("signals:\n", "signals:\n  time: {rate_hz: 250}\n").replace("rate_hz: 200", "")
    )
    done("-c", config, "--duration", "2", "-o", tmp_path / "run.csv")
    assert (tmp_path / "run.csv").read_text().splitlines()[0].count(",") == 3
    recording, _ = build_recording([tmp_path / "run.csv"], load_config(config))
    assert recording.sample_rate_hz == pytest.approx(250.0)
    refused = simulate("-c", config, "--rate", "300", "-o", tmp_path / "other.csv")
    assert refused.exit_code == 2
    assert "signals.time.rate_hz" in refused.stderr


def test_an_axis_in_metres(tmp_path: Path) -> None:
    text = """\
version: 1
axis: {name: slide, gear_ratio: 1, gravity_m_per_s2: 0}
signals:
  joint_torque: {source: force, unit: V, torque_per_volt: 35.0, hold: sample}
  motor_position: {source: position, unit: mm}
controller: {kp: 20, kv: 2000}
simulation:
  parameters: {Jm: 20, K: 4.0e5, JL: 8, FSm: 5}
  sensors: {joint_zero: 0.001}
  duration_s: 2
"""
    config = parse_config(text)
    assert config.simulation is not None
    setup = prepare(config, from_config(config.simulation), Wishes())
    assert setup.motion["amplitude"] == 0.01
    result = run(setup)
    logged.write(tmp_path / "run.csv", logged.as_logged(result, setup.rate_hz, config), config)
    recording, _ = build_recording([tmp_path / "run.csv"], config)
    np.testing.assert_allclose(recording.segments[0].motor_position, result.motor_position[1:], atol=1e-15)


# --- trajectories ---


def test_a_log_gives_the_reference(axis: Path, tmp_path: Path) -> None:
    """The reference of a log, and the same as a bare table of degrees at the motor, give the log again."""
    done("-c", axis, "--duration", "2", "-o", tmp_path / "a.mcap")
    done("-c", axis, "--trajectory", tmp_path / "a.mcap", "-o", tmp_path / "b.mcap")
    one, other = (
        read_log([tmp_path / name], ["/joint_states/motor/position"]) for name in ("a.mcap", "b.mcap")
    )
    values = [next(iter(log.channels.values())).values for log in (one, other)]
    np.testing.assert_allclose(values[0], values[1], atol=50 * 2.1e-6)
    table = read_log([tmp_path / "a.mcap"], ["/joint_states/reference/position"])
    rows = next(iter(table.channels.values())).values
    text = "t [ms],set point\n" + "".join(f"{5.0 * k},{v!r}\n" for k, v in enumerate(rows.tolist()))
    (tmp_path / "bare.csv").write_text(text, encoding="utf-8")
    done("-c", axis, "--trajectory", tmp_path / "bare.csv", "-o", tmp_path / "c.mcap")
    again = read_log([tmp_path / "c.mcap"], ["/joint_states/motor/position"])
    np.testing.assert_allclose(next(iter(again.channels.values())).values, values[1], atol=50 * 2.1e-6)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: f"{kind}_")  # `slow` alone would be the marker
def test_every_trajectory_is_followed(kind: str, axis: Path, tmp_path: Path) -> None:
    done(
        "-c", axis, "--trajectory", kind, "--stop-hz", "0.5", "--amplitude", "0.2", "-o", tmp_path / "run.csv"
    )
    recording, _ = build_recording([tmp_path / "run.csv"], load_config(axis))
    [segment] = recording.segments
    reference = segment.reference_position
    assert reference is not None
    assert np.abs(reference).max() == pytest.approx(0.2, rel=1e-3)
    assert abs(reference[0]) < 1e-4
    assert abs(reference[-1]) < 2e-3
    assert np.abs(segment.motor_position - reference).max() < 0.6 * np.ptp(reference)


# --- overlays ---


def decoded(path: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Stamps and values by topic, by another program's decoder."""
    found: dict[str, list[tuple[int, float]]] = {}
    with path.open("rb") as stream:
        for _, channel, message, content in make_reader(
            stream, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, content.data))
    return {k: (np.array([s for s, _ in v]), np.array([x for _, x in v])) for k, v in found.items()}


def test_an_overlay_has_the_stamps_of_the_log_and_adds_up(axis: Path, tmp_path: Path) -> None:
    done("-c", axis, "-o", tmp_path / "run.mcap")
    result = done("-c", axis, "--like", tmp_path / "run.mcap", "-o", tmp_path / "overlay.mcap")
    assert "reference through the controller" in result.stdout
    topics = decoded(tmp_path / "overlay.mcap")
    names = ("torque", "motor_position", "joint_position")
    assert set(topics) == {
        f"/{kind}/{name}" for kind in ("measured", "simulated", "residual") for name in names
    } | {"/measured/reference_position"}
    raw = read_log([tmp_path / "run.mcap"], ["/joint_states/motor/effort", "/joint_states/joint/position"])
    stamps = raw.channels["/joint_states/motor/effort"].stamps["log_time"]
    for name in names:
        (at, measured), (_, simulated), (_, residual) = (
            topics[f"/{kind}/{name}"] for kind in ("measured", "simulated", "residual")
        )
        np.testing.assert_array_equal(at, stamps)
        np.testing.assert_array_equal(residual, measured - simulated)
    current = raw.channels["/joint_states/motor/effort"].values
    np.testing.assert_allclose(topics["/measured/torque"][1], current * 0.35 * 50, rtol=1e-12)
    joint = raw.channels["/joint_states/joint/position"].values
    np.testing.assert_array_equal(topics["/measured/joint_position"][1], joint)
    assert np.std(topics["/residual/torque"][1]) == pytest.approx(0.2, rel=0.1)  # the noise that was added


def test_an_overlay_starts_within_the_motion(axis: Path, tmp_path: Path) -> None:
    """Cut out of the run, the loop starts with the motion and the torque that it had."""
    done("-c", axis, "-o", tmp_path / "run.mcap")
    done(
        "-c",
        axis,
        "--like",
        tmp_path / "run.mcap",
        "--start",
        "7.3",
        "--end",
        "15",
        "-o",
        tmp_path / "x.mcap",
    )
    topics = decoded(tmp_path / "x.mcap")
    measured, residual = (topics[f"/{kind}/joint_position"][1] for kind in ("measured", "residual"))
    assert np.std(residual[:200]) < 0.3 * np.std(measured[:200])
    assert np.std(residual[-800:]) < 1e-5 / np.sqrt(12.0) * 1.1  # counts, once the start has died away
    assert np.std(topics["/residual/torque"][1][-800:]) == pytest.approx(0.2, rel=0.1)


@pytest.mark.parametrize("hold", ["sample", "instant"])
def test_an_overlay_without_the_controller_is_driven_by_the_motor(
    hold: str, axis: Path, tmp_path: Path
) -> None:
    axis.write_text(CONFIG.replace("hold: sample", f"hold: {hold}"), encoding="utf-8")
    done("-c", axis, "-o", tmp_path / "run.mcap")
    arguments = ("-c", axis, "--like", tmp_path / "run.mcap", "--json", "--set", "controller={law: external}")
    result = done(*arguments)
    assert "the controller is not known: driven by the motor" in result.stderr
    document = json.loads(result.stdout)
    assert document["drive"] == "motor"
    torque, joint = document["signals"]["torque"], document["signals"]["joint_position"]
    assert torque["residual_rms"] < 0.02 * torque["measured_rms"]
    assert joint["residual_rms"] < 1e-3 * joint["measured_rms"]
    with_gap = json.loads(done(*arguments, "--effects", "backlash=0.005").stdout)["signals"]
    assert with_gap["joint_position"]["residual_rms"] > 10.0 * joint["residual_rms"]


def test_an_overlay_of_a_report(axis: Path, tmp_path: Path) -> None:
    done("-c", axis, "-o", tmp_path / "run.mcap")
    arguments = [str(tmp_path / "run.mcap"), "-c", str(axis), "-qq", "-o", str(tmp_path / "r.json")]
    assert CliRunner().invoke(main, ["identify", *arguments]).exit_code == 0
    result = done("-c", axis, "--report", tmp_path / "r.json", "--like", tmp_path / "run.mcap", "--json")
    document = json.loads(result.stdout)
    assert document["source"].endswith("r.json (two_encoders)")
    torque = document["signals"]["torque"]
    assert torque["residual_rms"] < 0.01 * torque["measured_rms"]
    # A new record out of the same report has its rate.
    done(
        "-c",
        axis,
        "--report",
        tmp_path / "r.json",
        "--set",
        "simulation={}",
        "--duration",
        "1",
        "-o",
        tmp_path / "n.csv",
    )
    assert len((tmp_path / "n.csv").read_text().splitlines()) == 1 + 200


def test_gaps_cut_an_overlay(axis: Path, tmp_path: Path) -> None:
    done("-c", axis, "-o", tmp_path / "run.csv")
    lines = (tmp_path / "run.csv").read_text().splitlines(keepends=True)
    (tmp_path / "gap.csv").write_text("".join(lines[:1500] + lines[2000:]))
    done("-c", axis, "--like", tmp_path / "gap.csv", "-o", tmp_path / "overlay.mcap")
    stamps, residual = decoded(tmp_path / "overlay.mcap")["/residual/joint_position"]
    assert stamps.size == 4000 - 500
    assert np.diff(stamps).max() > 2.4e9
    assert np.isfinite(residual).all()


def test_recorded_torque_is_compared_where_it_stands() -> None:
    config = parse_config(CONFIG)
    assert as_recorded(config).signals.torque.hold == "instant"
    assert config.signals.torque.hold == "sample"


# --- reports ---


def report(tmp_path: Path, **changes: Any) -> Path:
    estimates = {**WRIST, "z": 1e-4}
    parameters = [{"symbol": k, "estimate": v, "verdict": "identified"} for k, v in estimates.items()]
    document = {
        "schema": "flexid-report/1",
        "recording": {"sample_rate_hz": 200.0},
        "models": [
            {
                "id": "two_encoders",
                "parameters": parameters,
                "pipeline": {"reversal_velocity": 0.002, "lowpass": {"order": 4, "cutoff_hz": 12.0}},
            }
        ],
        "diagnosis": None,
    }
    path = tmp_path / "report.json"
    path.write_text(json.dumps({**document, **changes}), encoding="utf-8")
    return path


def truth_of(*arguments: str | Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(done(*arguments, "--duration", "1", "--json").stdout)
    return document


def test_a_report_gives_parameters_reversal_width_and_the_encoders_zero(axis: Path, tmp_path: Path) -> None:
    truth = truth_of("-c", axis, "--report", report(tmp_path), "-p", "joint_stiffness=2600")
    assert truth["axis"] == {
        **WRIST, "K": 2600.0, "gravity": 9.81, "torque_offset": 0.0, "reversal_velocity": 0.002,
    }  # fmt: skip
    assert truth["sensors"]["joint_zero"] == -1e-4  # K (qm - q - z): the joint encoder shows q - z


def test_a_report_with_a_diagnosis_gives_the_effect_too(axis: Path, tmp_path: Path) -> None:
    diagnosis = {
        "verdict": "explained",
        "effects": [{"name": "backlash", "parameters": [{"name": "gap", "estimate": 0.002}]}],
        "parameters_after": [
            {"symbol": k, "estimate": v, "verdict": "identified"} for k, v in {**WRIST, "K": 2700.0}.items()
        ],
    }
    truth = truth_of("-c", axis, "--report", report(tmp_path, diagnosis=diagnosis))
    assert truth["effects"] == {"backlash": {"gap": 0.002}}
    assert truth["axis"]["K"] == 2700.0
    doubtful = truth_of(
        "-c", axis, "--report", report(tmp_path, diagnosis={**diagnosis, "verdict": "ambiguous"})
    )
    assert doubtful["effects"] == {}
    assert doubtful["axis"]["K"] == WRIST["K"]


def test_gravity_as_a_spring_keeps_torque_and_slope(axis: Path, tmp_path: Path) -> None:
    values = {k: v for k, v in WRIST.items() if k not in {"MX", "MY"}} | {"Q0": -4.9, "kg": -49.0}
    parameters = [{"symbol": k, "estimate": v, "verdict": "weak"} for k, v in values.items()]
    path = report(tmp_path, models=[{"id": "motor_only", "parameters": parameters}])
    result = done(
        "-c", axis, "--report", path, "--duration", "1", "--json", "--set", "simulation.trajectory.centre=0.3"
    )
    axis_values = json.loads(result.stdout)["axis"]
    c, s = np.cos(0.3), np.sin(0.3)
    assert 9.81 * (axis_values["MX"] * c + axis_values["MY"] * s) == pytest.approx(-4.9)
    assert 9.81 * (-axis_values["MX"] * s + axis_values["MY"] * c) == pytest.approx(-49.0)
    assert "used although not identified" in result.stderr


def test_estimates_that_no_axis_has(axis: Path, tmp_path: Path) -> None:
    def with_value(symbol: str, value: float) -> Path:
        estimates = [
            {"symbol": k, "estimate": v, "verdict": "weak"} for k, v in {**WRIST, symbol: value}.items()
        ]
        return report(tmp_path, models=[{"id": "two_encoders", "parameters": estimates}])

    result = done("-c", axis, "--report", with_value("FS", -1.0), "--duration", "1", "--json")
    assert "taken as 0" in result.stderr
    assert json.loads(result.stdout)["axis"]["FS"] == 0.0
    refused = simulate("-c", axis, "--report", with_value("K", -1.0), "-o", tmp_path / "x.csv")
    assert refused.exit_code == 2
    assert "the estimate of K is -1" in refused.stderr


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("no JSON", "it is no JSON"),
        ("[1]", "is no report"),
        ('{"schema": "flexid-report/2"}', "is no report of flexid"),
        ('{"schema": "flexid-report/1", "models": 3}', "no estimate of a flexible axis"),
        (
            '{"schema": "flexid-report/1", "models": [{"id": "two_encoders", "parameters": [1]}]}',
            "no estimate",
        ),
        ('{"schema": "flexid-report/1", "models": [{"id": "rigid", "parameters": []}]}', "it has rigid"),
    ],
)
def test_files_that_are_no_report(text: str, words: str, axis: Path, tmp_path: Path) -> None:
    (tmp_path / "r.json").write_text(text, encoding="utf-8")
    for option in ("--report", "--truth"):
        result = simulate("-c", axis, option, tmp_path / "r.json", "-o", tmp_path / "x.csv")
        assert result.exit_code == 2
        assert "internal error" not in result.stderr
        assert option == "--truth" or words in result.stderr


def test_a_torque_in_amperes(axis: Path, tmp_path: Path) -> None:
    """Without a torque constant everything is per ampere, and the log holds the simulated numbers."""
    unknown = ("--set", "axis.torque_constant_nm_per_a=unknown")
    done("-c", axis, *unknown, "--duration", "2", "-o", tmp_path / "run.csv", "-o", tmp_path / "run.json")
    assert json.loads((tmp_path / "run.json").read_text())["torque_constant_nm_per_a"] == "unknown"
    overlaid = done("-c", axis, *unknown, "--like", tmp_path / "run.csv", "--json")
    torque = json.loads(overlaid.stdout)["signals"]["torque"]
    assert torque["residual_rms"] == pytest.approx(0.2, rel=0.2)


# --- mistakes ---

MISTAKES: dict[str, tuple[tuple[str, ...], str]] = {
    "unknown effect": (("--effects", "backlsh=0.001"), "did you mean backlash?"),
    "unknown parameter of an effect": (("--effects", "backlash.gab=0.001"), "did you mean gap?"),
    "several parameters": (("--effects", "hysteresis=3"), "--effects hysteresis.hysteresis_torque=15"),
    "no number": (("--effects", "backlash=wide"), "'wide' is no number"),
    "no value": (("--effects", "backlash"), "this is not NAME=VALUE"),
    "impossible value": (("--effects", "backlash=-1"), "gap = -1 is not possible"),
    "effect twice": (("--effects", "backlash=1e-3,backlash.gap=2e-3"), "given twice"),
    "unknown parameter": (("-p", "stiffness=1"), "did you mean joint_stiffness?"),
    "parameter twice": (("-p", "K=1", "-p", "joint_stiffness=2"), "K is given twice"),
    "negative inertia": (("-p", "JL=-1"), "JL must be above zero"),
    "negative friction": (("-p", "FS=-1"), "FS cannot be negative"),
    "nothing known": (("--set", "simulation={}"), "nothing says how large Jm, K, JL are"),
    "one missing": (("--set", "simulation={parameters: {Jm: 1, K: 1}}"), "nothing says how large JL is"),
    "no controller": (("--set", "controller=null"), "the controller is not known"),
    "external controller": (("--set", "controller={law: external}"), "--like LOG needs none"),
    "unstable": (("--set", "controller.kv=3e6"), "the simulated loop is unstable"),
    "unknown trajectory": (("--trajectory", "chrip"), "did you mean chirp?"),
    "too fast": (("--stop-hz", "150"), "above half the rate"),
    "reversed band": (("--start-hz", "20"), "is not possible"),
    "too short": (("--duration", "0.1"), "20 samples"),
    "too long": (("--duration", "1e9"), "too many samples"),
    "two sources": (("--report", "a.json", "--truth", "b.json"), "exclude each other"),
    "no report": (("--report", "missing.json"), "cannot read the report missing.json"),
    "a model without a report": (("--model", "motor_only"), "give --report"),
    "drive without a recording": (("--drive", "motor"), "belong to --like"),
    "window without a recording": (("--start", "1"), "belong to --like"),
    "unknown effect in the configuration": (
        ("--set", "simulation.effects={dahl: {}}"),
        "there is no effect 'dahl'",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_told_with_their_cure(mistake: str, axis: Path, tmp_path: Path) -> None:
    arguments, words = MISTAKES[mistake]
    result = simulate("-c", axis, *arguments, "-o", tmp_path / "x.csv")
    assert result.exit_code == 2, result.output
    assert words in result.stderr.replace("\n  ", " ")
    assert "internal error" not in result.stderr
    assert not (tmp_path / "x.csv").exists()


OUTPUTS: dict[str, tuple[Callable[[Path], list[str | Path]], str]] = {
    "none": (lambda _: [], "nothing says where the log goes"),
    "suffix": (lambda p: ["-o", p / "run.xlsx"], "names no format"),
    "stdout": (lambda _: ["-o", "-"], "cannot go to standard output"),
    "twice": (lambda p: ["-o", p / "x.csv", "-o", p / "x.csv"], "asked for twice"),
    "folder twice": (lambda p: ["-o", p / "bag", "-o", p / "bag", "--force"], "asked for twice"),
    "exists": (lambda p: ["-o", p / "old.csv"], "exists already"),
    "bag exists": (lambda p: ["-o", p / "bag"], "exists already"),
    "no bag": (lambda p: ["-o", p / "precious", "--force"], "no rosbag2 recording"),
    "no folder": (lambda p: ["-o", p / "nowhere" / "x.csv"], "there is no folder"),
    "input": (lambda p: ["-o", p / "axis.yaml", "--force"], "names no format"),
}


@pytest.mark.parametrize("case", OUTPUTS)
def test_outputs_are_refused_before_the_work(case: str, axis: Path, tmp_path: Path) -> None:
    (tmp_path / "old.csv").write_text("kept")
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "thesis.txt").write_text("kept")
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").write_text("kept")
    arguments, words = OUTPUTS[case]
    result = simulate("-c", axis, *arguments(tmp_path))
    assert result.exit_code == 2
    assert words in result.stderr
    for name in ("old.csv", "precious/thesis.txt", "bag/metadata.yaml"):
        assert (tmp_path / name).read_text() == "kept"


def test_force_replaces_a_log_and_a_bag(axis: Path, tmp_path: Path) -> None:
    outputs = ("-o", tmp_path / "x.csv", "-o", tmp_path / "bag", "-o", tmp_path / "t.json")
    done("-c", axis, "--duration", "1", *outputs)
    before = (tmp_path / "x.csv").read_bytes()
    done("-c", axis, "--duration", "1", "--seed", "9", *outputs, "--force")
    assert (tmp_path / "x.csv").read_bytes() != before
    assert {path.name for path in tmp_path.iterdir()} == {"axis.yaml", "x.csv", "bag", "t.json"}
    recordings = [build_recording([tmp_path / name], load_config(axis))[0] for name in ("x.csv", "bag")]
    np.testing.assert_array_equal(*(r.segments[0].torque for r in recordings))


def test_a_bag_that_holds_an_input_is_not_replaced(axis: Path, tmp_path: Path) -> None:
    done("-c", axis, "--duration", "1", "-o", tmp_path / "bag")
    arguments = ("-c", axis, "--like", tmp_path / "bag", "-o", tmp_path / "bag", "--force")
    result = simulate(*arguments)
    assert result.exit_code == 2
    assert "holds an input" in result.stderr


@pytest.mark.parametrize(
    ("source", "name", "words"),
    [
        ("/status.current", "run.mcap", "names a field that no message here has"),
        ("/status.current[1]", "run.bag", "names a field that no message here has"),
        ("3", "run", "is a column number"),
    ],
)
def test_a_source_that_no_message_holds(
    source: str, name: str, words: str, axis: Path, tmp_path: Path
) -> None:
    result = simulate("-c", axis, "--set", f"signals.motor_current.source={source}", "-o", tmp_path / name)
    assert result.exit_code == 2
    assert words in result.stderr
    assert "write CSV" in result.stderr
    done(
        "-c",
        axis,
        "--set",
        f"signals.motor_current.source={source}",
        "--duration",
        "1",
        "-o",
        tmp_path / "x.csv",
    )


@pytest.mark.parametrize("clock", ["header_stamp", "log_time"])
def test_clocks_of_messages(clock: str, axis: Path, tmp_path: Path) -> None:
    """A Float64 has no header, so that only the log's own time is a clock for it."""
    single = ("--set", "signals.motor_current.source=/drive/current", "--set", f"signals.time.source={clock}")
    result = simulate("-c", axis, "--duration", "1", *single, "-o", tmp_path / "x.mcap")
    if clock == "header_stamp":
        assert result.exit_code == 2
        assert "only JointState messages" in result.stderr
    else:
        overrides = [text for text in single if text != "--set"]
        recording, _ = build_recording([tmp_path / "x.mcap"], load_config(axis, overrides))
        assert recording.segments[0].samples == 199  # a held torque acts half a sample later


def test_nothing_of_a_fresh_record_is_taken_with_an_overlay(axis: Path, tmp_path: Path) -> None:
    done("-c", axis, "--duration", "1", "-o", tmp_path / "run.csv")
    result = simulate("-c", axis, "--like", tmp_path / "run.csv", "--seed", "1", "-o", tmp_path / "x.mcap")
    assert result.exit_code == 2
    assert "--seed means nothing with --like" in result.stderr


def test_messages_go_to_standard_error(axis: Path, tmp_path: Path) -> None:
    result = done("-c", axis, "--duration", "1", "-o", tmp_path / "x.csv")
    assert result.stdout == ""
    assert "200 samples at 200 Hz, 1 s" in result.stderr
    quiet = done("-c", axis, "--duration", "1", "-o", tmp_path / "x.csv", "--force", "-q")
    assert (quiet.stdout, quiet.stderr) == ("", "")
    told = done("-c", axis, "--duration", "1", "-v", "--json")
    assert "steps" in told.stderr
    assert json.loads(told.stdout)["schema"] == "flexid-truth/1"


def test_sensors_of_the_configuration(axis: Path) -> None:
    data = load_text(CONFIG)
    data["simulation"]["sensors"] = {
        "motor_counts_per_rev": 4096, "joint_counts_per_rev": 8192, "joint_delay_s": 0.002, "skew_s": 0.001,
        "joint_noise": 1e-6,
    }  # fmt: skip
    sensors = prepare(Config.model_validate(data), Given(WRIST), Wishes()).sensors
    assert sensors.motor_resolution == pytest.approx(2 * np.pi / 4096 / 50)
    assert sensors.joint_resolution == pytest.approx(2 * np.pi / 8192)
    assert sensors.joint_delay_s == pytest.approx(0.003)
    assert sensors.joint_noise == 1e-6
    result = simulate(
        "-c", axis, "--set", "simulation.sensors={motor_counts_per_rev: 4, motor_resolution: 1}", "--json"
    )
    assert result.exit_code == 2
    assert "exclude each other" in result.stderr
