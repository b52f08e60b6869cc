"""``flexid tune-filter`` as people and programs use it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from click.testing import CliRunner, Result

from flexid_cli.cli.main import main

PAPER = ["--f1", "3.9", "--nd", "4"]
PAPER_LOG = [*PAPER, "--fs", "350.87", "--decimate", "26"]


def run(*arguments: str) -> Result:
    return CliRunner().invoke(main, ["tune-filter", *arguments])


def document(*arguments: str) -> dict:
    result = run(*arguments, "--json")
    assert result.exit_code == 0
    assert result.stderr == ""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    return json.loads(result.stdout, parse_constant=refuse)


def flat(text: str) -> str:
    return " ".join(text.split())


@pytest.mark.parametrize(
    ("nd", "numbers"), [("2", ["181.04 rad/s", "205.70 Hz"]), ("4", ["168.91 rad/s", "289.64 Hz"])]
)
def test_prints_the_numbers_of_the_paper(nd: str, numbers: list[str]):
    result = run("--f1", "3.9", "--nd", nd)
    assert result.exit_code == 0
    assert result.stderr == ""
    for number in [*numbers, "147.03 rad/s", "3.9 Hz"]:
        assert number in result.stdout


def test_says_which_resonance_f1_is():
    for text in (run(*PAPER).stdout, run("--help").stdout):
        assert "free-free" in text
        assert "sqrt(K (1/Jm" in flat(text)
        assert "motor locked" in flat(text) or "locked-motor" in flat(text)


def test_prints_ratio_band_and_warning_for_the_papers_log():
    text = flat(run(*PAPER_LOG).stdout)
    assert "1.211 Fs" in text
    assert "A(wc) = 0.7475" in text
    assert "5.3980 Hz" in text
    assert "13.495 Hz" in text
    assert "1.384 f1" in text
    assert "warning: decimation by 26, not wc = 23.4 Hz, limits the band" in text


def test_prints_distortion_over_the_band():
    table = run(*PAPER_LOG).stdout.partition("A(w) at")[2].split("\n\n")[0]
    rows = {}
    for line in table.splitlines()[1:]:
        name, *cells = line.rsplit(maxsplit=5)
        rows[name.strip()] = [float(cell) for cell in cells]
    assert {"f1", "2 f1", "4 f1", "0.25 wc", "0.5 wc", "0.75 wc", "wc", "wn"} <= set(rows)
    assert rows["f1"][0] == 3.9
    assert rows["wc"] == [23.4, 147.03, 0.7071, 0.7475, 0.7542]


def test_low_rate_is_warned_about_with_the_distortion_that_results():
    text = flat(run(*PAPER, "--fs", "150").stdout)
    assert "warning: the log's 150 Hz are below the needed Fs = 289.64 Hz: A(wc) is 0.4336" in text


@pytest.mark.parametrize(
    "arguments",
    [
        PAPER,
        PAPER_LOG,
        ["--f1", "3.9", "--nd", "0", "--fs", "350.87"],
        ["--f1", "0.123456789", "--nd", "3", "--m", "12", "--wc-ratio", "9.87654321", "--fs", "12345.678"],
        [*PAPER, "--fs", "40", "--decimate", "1"],
    ],
)
def test_output_fits_80_columns_and_plain_ascii(arguments: list[str]):
    text = run(*arguments).stdout
    assert max(map(len, text.splitlines())) <= 80
    assert text.isascii()
    assert not any(line != line.rstrip() for line in text.splitlines())


def test_help_ends_in_an_example_that_runs():
    lines = run("--help").stdout.rstrip().splitlines()
    start = next(i for i, line in enumerate(lines) if line.strip() == "Example:")
    examples = [line.split() for line in lines[start + 1 :]]
    assert examples
    assert max(map(len, lines)) <= 80
    for program, command, *arguments in examples:
        assert (program, command) == ("flexid", "tune-filter")
        assert run(*arguments).exit_code == 0


def test_json_holds_full_precision():
    content = document(*PAPER_LOG)
    assert content["schema"] == "flexid-tune-filter/1"
    assert content["filter"]["wn_rad_s"] == pytest.approx(168.90827907370485, rel=1e-13)
    assert content["filter"]["fs_hz"] == pytest.approx(289.63790446390607, rel=1e-13)
    assert content["filter"]["wn_hz"] == pytest.approx(26.88258754372547, rel=1e-13)
    assert content["sampled"]["fs_ratio"] == pytest.approx(350.87 / 289.63790446390607, rel=1e-13)
    assert content["decimated"]["band_hz"] == pytest.approx(5.398, rel=1e-13)
    assert content["decimated"]["is_limit"] is True
    assert content["effective_band_hz"] == content["decimated"]["band_hz"]
    assert [doubt["code"] for doubt in content["warnings"]] == ["decimation_limits"]
    assert "free-free" in content["f1_meaning"]


def test_json_has_null_where_there_is_no_number():
    content = document("--f1", "3.9", "--nd", "0")
    assert content["filter"]["fs_hz"] is None
    assert content["sampled"] is None
    assert content["decimated"] is None
    assert all(point["sampled"] is None for point in content["distortion"])
    assert document(*PAPER, "--fs", "40")["sampled"]["distortion_at_wc"] is None


def test_options_reach_the_equations():
    content = document(
        "--f1", "10", "--nd", "3", "--m", "5", "--ac", "0.9", "--rc", "1.05", "--wc-ratio", "3"
    )["filter"]  # fmt: skip
    assert (content["m"], content["ac"], content["rc"], content["wc_ratio"]) == (5, 0.9, 1.05, 3.0)
    assert content["wc_hz"] == pytest.approx(30.0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([*PAPER, "--rc", "1.5"], ["rc = 1.5", "(Ac, 1/Ac)", "--rc"]),
        ([*PAPER, "--rc", "0.70"], ["rc = 0.7", "0.707107", "--rc"]),
        ([*PAPER, "--ac", "1"], ["Ac = 1", "--ac"]),
        ([*PAPER, "--ac", "0"], ["Ac = 0", "--ac"]),
        (["--f1", "0", "--nd", "2"], ["f1", "--f1"]),
        (["--f1", "-3.9", "--nd", "2"], ["f1", "--f1"]),
        (["--f1", "nan", "--nd", "2"], ["f1", "--f1"]),
        (["--f1", "1e308", "--nd", "2"], ["f1", "--f1"]),
        (["--f1", "3.9", "--nd", "5"], ["nd is 5", "0 to 4"]),
        (["--f1", "3.9", "--nd", "-1"], ["nd is -1", "0 to 4"]),
        (["--f1", "3.9", "--nd", "0", "--rc", "1"], ["nd = 0", "--rc"]),
        ([*PAPER, "--m", "0"], ["m is 0", "--m"]),
        ([*PAPER, "--wc-ratio", "0"], ["wc/w1", "--wc-ratio"]),
        ([*PAPER, "--fs", "0"], ["sampling rate", "--fs"]),
        ([*PAPER, "--fs", "350", "--decimate", "0"], ["decimation factor is 0", "--decimate"]),
        ([*PAPER, "--decimate", "26"], ["none is given", "--fs"]),
        (["--nd", "2"], ["--f1"]),
        (["--f1", "3.9"], ["--nd"]),
        (["--f1", "soft", "--nd", "2"], ["--f1", "soft"]),
        (["--f1", "3.9", "--nd", "2.5"], ["--nd", "2.5"]),
    ],
)
@pytest.mark.parametrize("as_json", [False, True])
def test_bad_input_is_one_message_with_the_cure(arguments: list[str], words: list[str], as_json: bool):
    result = run(*arguments, *(["--json"] if as_json else []))
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr.count("error:") == 1
    assert "Traceback" not in result.stderr
    assert "internal error" not in result.stderr
    for word in words:
        assert word in result.stderr


@pytest.mark.parametrize(
    "arguments", [PAPER, PAPER_LOG, ["--f1", "3.9", "--nd", "0"], [*PAPER, "--fs", "30"]]
)
def test_plot_is_a_labelled_and_reproducible_svg(tmp_path: Path, arguments: list[str]):
    files = [tmp_path / "a.svg", tmp_path / "b.svg"]
    for file in files:
        result = run(*arguments, "--plot", str(file))
        assert result.exit_code == 0, result.stderr
        assert "wrote" in result.stderr
        assert result.stdout == run(*arguments).stdout
    assert files[0].read_bytes() == files[1].read_bytes()
    assert sorted(tmp_path.iterdir()) == files
    text = files[0].read_text()
    assert ET.fromstring(text).tag.endswith("svg")
    derivative = (
        [] if "0" in arguments else ["ideal derivative", "central difference", "band-limited derivative"]
    )
    for label in ["low-pass", "angular frequency w (rad/s)", "magnitude", *derivative]:
        assert label in text
    assert "<dc:date>" not in text


def test_plot_ignores_the_readers_own_matplotlib_style(tmp_path: Path):
    style = tmp_path / "matplotlibrc"
    style.write_text("lines.linewidth: 9\nsvg.fonttype: none\naxes.facecolor: red\n")
    bare = {name: value for name, value in os.environ.items() if name != "MATPLOTLIBRC"}
    drawn = []
    for number, environment in enumerate([bare, bare | {"MATPLOTLIBRC": str(style)}]):
        file = tmp_path / f"{number}.svg"
        flexid(*PAPER, "--plot", str(file), env=environment)
        drawn.append(file.read_bytes())
    assert drawn[0] == drawn[1]


def test_plot_with_json_keeps_standard_output_pure(tmp_path: Path):
    result = run(*PAPER, "--json", "--plot", str(tmp_path / "a.svg"))
    assert json.loads(result.stdout)["filter"]["nd"] == 4
    assert (tmp_path / "a.svg").is_file()


def test_plot_refuses_what_it_cannot_write(tmp_path: Path):
    existing = tmp_path / "a.svg"
    existing.write_text("mine")
    for target, word in [
        (existing, "--force"),
        (tmp_path / "a.png", ".svg"),
        (tmp_path / "none" / "a.svg", "folder"),
    ]:
        result = run(*PAPER, "--plot", str(target))
        assert result.exit_code == 2
        assert word in result.stderr
        assert result.stdout == ""
    assert existing.read_text() == "mine"
    assert run(*PAPER, "--plot", str(existing), "--force").exit_code == 0
    assert "<svg" in existing.read_text()


def flexid(*arguments: str, env: dict[str, str] | None = None) -> str:
    """Run the command in a process of its own; returns its standard output."""
    root = Path(__file__).resolve().parents[2]
    environment = dict(env or os.environ)
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [str(root), environment.get("PYTHONPATH")]))
    vector = [sys.executable, "-m", "flexid_cli", "tune-filter", *arguments]
    return subprocess.run(vector, env=environment, check=True, capture_output=True, text=True).stdout


def test_no_heavy_import_without_plot():
    program = (
        "import sys; from flexid_cli.cli.main import main\n"
        "try: main(sys.argv[1:])\n"
        "except SystemExit as end: assert not end.code\n"
        "heavy = {'numpy', 'scipy', 'rich', 'matplotlib', 'pandas', 'pydantic', 'numba', 'mcap', 'rosbags'}\n"
        "print(sorted(heavy & set(sys.modules)), file=sys.stderr)"
    )
    root = Path(__file__).resolve().parents[2]
    environment = os.environ | {"PYTHONPATH": str(root)}
    for extra in ([], ["--json"], ["--fs", "350.87", "--decimate", "26"]):
        vector = [sys.executable, "-c", program, "tune-filter", *PAPER, *extra]
        done = subprocess.run(vector, env=environment, check=True, capture_output=True, text=True)
        assert done.stderr.strip() == "[]"


def test_as_a_program_stdout_is_one_json_document():
    assert json.loads(flexid(*PAPER_LOG, "--json"))["decimated"]["factor"] == 26
