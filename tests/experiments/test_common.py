"""What experiments share: archives, results that are kept, reports and their index."""

import importlib
import pathlib
import pkgutil
import sys

import numpy as np
import pytest

import experiments
from experiments.common import archives, claims, command, errors, index, report
from experiments.common.command import Options
from experiments.common.results import Results
from experiments.common.tables import table
from experiments.james_stein import error
from jscomb import exr

FOLDERS = sorted(path.parent for path in index.EXPERIMENTS.glob("*/__init__.py"))
ACCOUNTS = sorted(index.EXPERIMENTS.glob("*/account.py"))
SECTIONS = [section for folder in FOLDERS for section in report.read(folder)]


def test_archives_are_frames(folder, glass_frame):
    frame = archives.load(folder / "glass.npz", 64)
    assert frame.samples == 64
    np.testing.assert_allclose(frame.color, glass_frame.color, rtol=1e-6)
    np.testing.assert_allclose(frame.variance, glass_frame.variance, rtol=1e-5)
    np.testing.assert_allclose(frame.depth, glass_frame.depth, rtol=1e-6)
    with pytest.raises(ValueError, match=r"has \[64\] samples, not 128"):
        archives.load(folder / "glass.npz", 128)


def test_exr_frames_are_measured_like_archives(glass_frame, tmp_path):
    """By scene and samples, with all sub-buffers."""
    exr.write_frame(tmp_path / "glass-64.exr", glass_frame)
    exr.write_frame(tmp_path / "glass-reference.exr", glass_frame)
    assert archives.cases(tmp_path) == [(tmp_path / "glass-64.exr", 64)]
    found = archives.measured(tmp_path, {"": lambda f: {"buffers": f.sub_buffers}})
    assert found == {"glass 64": {"buffers": 4}}
    with pytest.raises(ValueError, match=r"no .npz archive and no EXR frame there"):
        archives.cases(tmp_path / "empty")


def test_fireflies_are_far_above_all_around(glass_frame):
    frame = glass_frame.normalised()
    truth = np.asarray(frame.reference.image)
    assert errors.fireflies(truth, frame) == 0
    assert errors.dssim(truth, frame) == pytest.approx(0, abs=1e-6)
    bright = truth.copy()
    bright[3, 4:6] += 3 * truth.max() + 1.1
    pixels = truth.shape[0] * truth.shape[1]
    assert errors.fireflies(bright, frame) == pytest.approx(2 / pixels)
    assert errors.dssim(bright, frame) > 0


def test_results_go_on_after_a_line_cut_short(tmp_path):
    path = tmp_path / "new" / "kept.jsonl"
    first = Results(path)
    assert first.get("a", lambda: [1.5]) == [1.5]
    assert first.get("b", lambda: 2) == 2
    path.write_text(path.read_text()[:-2])  # interrupted while writing b
    again = Results(path)
    assert again.get("a", lambda: pytest.fail("measured twice")) == [1.5]
    assert again.get("b", lambda: 3) == 3
    assert Results(path).values == {"a": [1.5], "b": 3}


def test_tables_are_markdown():
    found = table(["name", 16], [["a", 0.12345], ["b", None], ["c", 123456.0]])
    assert found.splitlines() == [
        "| name | 16 |",
        "| --- | --- |",
        "| a | 0.123 |",
        "| b |  |",
        "| c | 1.23e+05 |",
    ]


def test_means_are_geometric_and_beside_the_worst():
    rows = {
        "x 4": {"y": 1.0, "z": 2.0},
        "w 4": {"y": 1.0, "z": 8.0},
        "x 16": {"y": 2.0, "z": 2.0},
    }
    found = errors.means(rows, ["z"], lambda row: row["y"], title="z / y")
    assert found.splitlines()[0] == "| z / y | 4 | 16 | all | worst |"
    assert found.splitlines()[2] == "| z | 4.00 | 1.00 | 2.52 | 8.00 |"


def test_a_report_replaces_the_one_before(folder, monkeypatch, capsys, tmp_path):
    """Question, answer, command, date and tables, read back as they were written."""
    place = tmp_path / "report"
    arguments = [str(folder), "--quick", "--report", str(place)]
    monkeypatch.setattr(sys, "argv", ["error", *arguments])
    command.main(error.Config, error.run, error.report)
    capsys.readouterr()
    command.main(error.Config, error.run, error.report)
    (section,) = report.read(place)
    assert section.module == "experiments.james_stein.error"
    assert section.question == error.__doc__.splitlines()[0]
    assert section.answer in capsys.readouterr().out
    assert section.command.startswith(f"python -m {section.module} ")
    assert section.date in report.circumstances()
    monkeypatch.setattr(sys, "argv", ["error", str(place)])
    with pytest.raises(SystemExit, match=r"^experiments.*error: .* no \.npz archive"):
        command.main(error.Config, error.run, error.report)


def test_a_reported_command_tells_no_folders():
    """But as much of a path as tells two files of one name apart."""
    words = ["/of/alice/x.npz", "/a/b/scene.xml", "/a/c/scene.xml", "--size", "3"]
    told = ["x.npz", "b/scene.xml", "c/scene.xml", "--size", "3"]
    assert command.without_folders(words) == told


def test_the_index_is_of_the_results():
    assert index.README.read_text() == index.indexed(index.README.read_text())
    assert len(index.README.read_text().splitlines()) < 100


def commands():
    """Modules of the experiments that answer a question: they have a report."""
    names = [
        found.name
        for found in pkgutil.walk_packages(experiments.__path__, "experiments.")
        if not found.ispkg
    ]
    modules = map(importlib.import_module, names)
    return {m.__name__ for m in modules if {"run", "report"} <= vars(m).keys()}


def test_every_result_is_of_a_command():
    """That is still there, asks the same question, and measured all of it."""
    assert {section.module for section in SECTIONS} <= commands()
    for section in SECTIONS:
        module = importlib.import_module(section.module)
        assert " ".join(module.__doc__.split("\n\n")[0].split()) == section.question
        assert "--quick" not in section.command
        assert pathlib.Path(module.__file__).parent in FOLDERS


@pytest.mark.parametrize("path", ACCOUNTS, ids=lambda path: path.parent.name)
def test_an_account_names_what_is_there(path):
    module = importlib.import_module(f"experiments.{path.parent.name}.account")
    made = module.report(module.run(Options()))
    written = claims.sections()[module.__name__]
    assert written.answer == made.answer
    assert made.body in written.text
    items = [claim.item for claim in module.CLAIMS]
    assert len(set(items)) == len(items)


def test_an_account_refuses_what_is_not_there():
    claim = claims.Claim("eq. 1", "a sum")
    with pytest.raises(ValueError, match=r"eq\. 1: neither here nor a reason why not"):
        claims.check([claim])
    with pytest.raises(ImportError, match=r"no james_stein\.nothing in jscomb"):
        claims.check([claim._replace(where=("james_stein.nothing",))])
    with pytest.raises(ValueError, match=r"no result of experiments\.common\.claims"):
        claims.check([claim._replace(measured=("experiments.common.claims",))])
