"""Outputs by suffix, rendered before anything is written, and written all or none."""

from __future__ import annotations

import json
import os
import re
import runpy
import stat
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import unquote

import pytest

from flexid_cli.errors import OutputError, UsageError
from flexid_cli.report.write import render_outputs
from flexid_cli.writers.files import check_targets, write_files

EXAMPLES = SimpleNamespace(**runpy.run_path(str(Path(__file__).resolve().parents[1] / "report_examples.py")))


def rendered(*outputs, name="rigid"):
    identification, document = EXAMPLES.case(name)
    return render_outputs(document, identification, outputs)


def listing(folder):
    return sorted(path.name for path in folder.iterdir())


def test_json_alone_needs_no_figures(tmp_path):
    contents = rendered(tmp_path / "run.json")
    assert list(contents) == [tmp_path / "run.json"]
    assert json.loads(contents[tmp_path / "run.json"])["schema"] == "flexid-report/1"


def test_markdown_has_its_figures_beside_it(tmp_path):
    path = tmp_path / "run 1 (a).md"
    contents = rendered(path, tmp_path / "run.JSON")
    names = {f"run 1 (a)_rigid_{kind}.svg" for kind in ("torque", "filter", "spectrum")}
    assert {p.name for p in contents} == {"run 1 (a).md", "run.JSON"} | names
    assert {p.parent for p in contents} == {tmp_path}
    assert {unquote(link) for link in re.findall(r"\]\(([^()]*)\)", contents[path])} == names


def test_unknown_suffix_names_the_known_ones(tmp_path):
    with pytest.raises(UsageError) as caught:
        rendered(tmp_path / "run.json", tmp_path / "run.docx")
    assert ".docx" in caught.value.message
    assert caught.value.hint == "supported: .json, .md"
    with pytest.raises(UsageError, match="no suffix"):
        rendered(tmp_path / "run")


def test_the_same_output_twice_is_refused(tmp_path):
    with pytest.raises(UsageError, match="twice"):
        rendered(tmp_path / "run.json", tmp_path / "run.json")


def test_the_same_input_gives_the_same_bytes(tmp_path):
    path = tmp_path / "run.md"
    assert rendered(path, name="flexible") == rendered(path, name="flexible")


def test_files_are_written_with_the_users_permissions(tmp_path):
    write_files({tmp_path / "a.json": "ä\n", tmp_path / "b.svg": b"\x00\r\n"})
    assert (tmp_path / "a.json").read_bytes() == "ä\n".encode()
    assert (tmp_path / "b.svg").read_bytes() == b"\x00\r\n"
    assert listing(tmp_path) == ["a.json", "b.svg"]
    umask = os.umask(0)
    os.umask(umask)
    assert stat.S_IMODE((tmp_path / "a.json").stat().st_mode) == 0o666 & ~umask


def test_an_existing_file_is_kept_without_force(tmp_path):
    old = tmp_path / "old.md"
    old.write_text("old")
    with pytest.raises(OutputError, match="exists already") as caught:
        write_files({tmp_path / "new.json": "new", old: "new"})
    assert "--force" in caught.value.hint
    assert listing(tmp_path) == ["old.md"]
    assert old.read_text() == "old"


def test_force_replaces_and_keeps_the_permissions(tmp_path):
    old = tmp_path / "old.md"
    old.write_text("old")
    old.chmod(0o600)
    write_files({old: "new"}, force=True)
    assert old.read_text() == "new"
    assert stat.S_IMODE(old.stat().st_mode) == 0o600
    assert listing(tmp_path) == ["old.md"]


def test_a_link_stays_a_link(tmp_path):
    target, link = tmp_path / "target.md", tmp_path / "link.md"
    target.write_text("old")
    link.symlink_to(target)
    write_files({link: "new"}, force=True)
    assert link.is_symlink()
    assert target.read_text() == "new"


def test_missing_folder_and_folder_as_file(tmp_path):
    with pytest.raises(OutputError, match="no folder") as caught:
        check_targets([tmp_path / "nowhere" / "run.md"])
    assert "create the folder" in caught.value.hint
    with pytest.raises(OutputError, match="is a folder"):
        check_targets([tmp_path], force=True)


def test_two_names_of_one_file_are_refused(tmp_path):
    (tmp_path / "link.md").symlink_to(tmp_path / "run.md")
    with pytest.raises(OutputError, match="twice"):
        write_files({tmp_path / "run.md": "a", tmp_path / "link.md": "b"})
    assert listing(tmp_path) == ["link.md"]


@pytest.mark.parametrize("fails_at", [1, 2, 3])
def test_a_rename_that_fails_takes_everything_back(tmp_path, monkeypatch, fails_at):
    new, old, last = tmp_path / "new.json", tmp_path / "old.md", tmp_path / "last.svg"
    old.write_text("old")
    rename, calls = Path.replace, []

    def replace(self, target):
        calls.append(target)
        if len(calls) == fails_at:
            raise OSError(28, "No space left on device", str(self))
        return rename(self, target)

    monkeypatch.setattr(Path, "replace", replace)
    with pytest.raises(OutputError, match="No space left"):
        write_files({new: "1", old: "2", last: "3"}, force=True)
    monkeypatch.undo()
    assert listing(tmp_path) == ["old.md"]
    assert old.read_text() == "old"


def test_a_content_that_cannot_be_written_leaves_nothing(tmp_path):
    with pytest.raises(UnicodeEncodeError):
        write_files({tmp_path / "a.json": "fine", tmp_path / "b.json": "\udcff"})
    assert listing(tmp_path) == []


def test_an_interrupted_write_leaves_nothing(tmp_path, monkeypatch):
    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_files({tmp_path / "a.json": "fine"})
    assert listing(tmp_path) == []
