"""What a person hears of a damaged file: counts, times and the first cause, in one sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from flexid_cli.readers.base import Damage

PATH = Path("run.mcap")
SPANS = ((4.995, 5.005), (7.0, 8.0), (19.3, 57.8), (60.0, 61.0), (62.0, 63.0))


@pytest.mark.parametrize(
    ("damage", "parts"),
    [
        (
            Damage(PATH, 14286, 6766, spans_s=SPANS[2:3], reasons=("the chunk at byte 97: its checksum is wrong",)),
            [
               "run.mcap is damaged: 14286 samples can be trusted, 6766 may be wrong and were left out; no trusted",
               "sample from 19.3 to 57.8 s. Cause: the chunk at byte 97: its checksum is wrong",
            ],
        ),
        (
            Damage(PATH, 1, 1, 1, spans_s=SPANS, reasons=("run.mcap:12: the line has 2 fields", "run.mcap: more")),
            [
               "run.mcap is damaged: 1 sample can be trusted, 1 may be wrong and was left out, 1 is lost; no trusted",
               "sample from 4.9950 to 5.0050 s, 7.00 to 8.00 s, 19.3 to 57.8 s and in 2 more gaps. First cause:",
               "line 12: the line has 2 fields",
            ],
        ),
        (
            Damage(PATH, 20, 0, None, reasons=("run.mcap: the file is cut short",)),
            [
               "run.mcap is damaged: 20 samples can be trusted, an unknown number is lost. Cause: the file is",
               "cut short",
            ],
        ),
        (
            Damage(PATH, 20, lost_bytes=5000, reasons=("5000 bytes follow its end",)),
            [
               "run.mcap is damaged: 20 samples can be trusted, none is lost. Cause: 5000 bytes follow its end",
            ],
        ),
    ],
)  # fmt: skip
def test_sentence(damage: Damage, parts: list[str]) -> None:
    assert damage.sentence() == " ".join(parts)


def test_kept_samples_are_said_to_be_used() -> None:
    assert "3 may be wrong and were used nevertheless" in Damage(PATH, 1, 3).sentence(suspect_kept=True)
