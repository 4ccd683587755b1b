"""The README, the guide and the notebooks do what they say, each snippet by itself."""

import json
import os
import pathlib
import re
import shlex
import subprocess
import sys

import jax
import numpy as np
import pytest

from jscomb import exr
from jscomb.cli._parsing import parse
from jscomb.frame import Estimate
from tests.battery.public import slug
from tests.test_exr import layer, write

ROOT = pathlib.Path(__file__).parents[1]
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "jscomb" / "guide").glob("*.md"))]
LINKED = [
    *PAGES,
    ROOT / "CHANGELOG.md",
    *sorted((ROOT / "experiments").rglob("*.md")),
]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
# What compiles networks, regressions or quadratic programs takes long on a first run.
LONG = (
    "choose(",
    "njs",
    "oidn.denoise_color",
    "regress(",
    "ensemble.combine_frame",
    "double_shrinkage.combine_frame",
    "uncorrelated.combine_frame",
    "map_shards",
)


def blocks(path, language):
    """The fenced blocks of a language, by page and line."""
    text = path.read_text()
    for found in re.finditer(rf"^```{language}\n(.*?)^```$", text, re.M | re.S):
        line = text[: found.start()].count("\n") + 1
        yield f"{path.name}:{line}", found[1]


def snippets():
    for path in PAGES[1:]:  # the README's has a test of its own
        for where, code in blocks(path, "python"):
            long = any(word in code for word in LONG)
            yield pytest.param(code, id=where, marks=pytest.mark.slow if long else ())


def commands():
    for path in PAGES:
        for where, block in blocks(path, "sh"):
            lines = [shlex.split(line, comments=True) for line in block.splitlines()]
            for number, words in enumerate(filter(None, lines)):
                yield pytest.param(words, id=f"{where}.{number}")


@pytest.fixture
def reader(tmp_path, monkeypatch, glass_frame):
    """A folder with the files that the pages name, and JAX as a reader has it."""
    frame = glass_frame
    exr.write_frame(tmp_path / "frame.exr", frame)
    exr.write_image(tmp_path / "denoised.exr", frame.estimates["oidn"].image)
    for name in ("y", "z"):
        exr.write_frame(tmp_path / f"{name}.exr", frame._replace(estimates={}))
    # Photons: less noise, and light that leaks over a few pixels.
    leaking = lambda image: (image + np.roll(image, 1, -2) + np.roll(image, 1, -3)) / 3
    photons = Estimate(leaking(frame.color), leaking(halves_of(frame)))
    exr.write_frame(tmp_path / "p.exr", frame._replace(estimates={"photons": photons}))
    (tmp_path / "frames").mkdir()
    exr.write_frame(tmp_path / "frames" / "001.exr", frame)
    for seed, half in enumerate(frame.halves()):
        as_blender_writes(tmp_path / f"seed{seed}.exr", half)
    monkeypatch.chdir(tmp_path)
    with (
        jax.enable_x64(False),
        jax.numpy_dtype_promotion("standard"),
        jax.numpy_rank_promotion("allow"),
        jax.debug_key_reuse(False),
    ):
        yield tmp_path


def as_blender_writes(path, frame):
    """A view layer with denoising data, of a denoised rendering."""
    parts = {
        "Combined": (frame.estimates["oidn"].image, "RGB"),
        "Noisy Image": (frame.color, "RGB"),
        "Denoising Albedo": (frame.albedo, "RGB"),
        "Denoising Normal": (frame.normal, "XYZ"),
        "Denoising Depth": (frame.depth, "Z"),
    }
    channels = {}
    for name, (image, letters) in parts.items():
        channels |= layer(f"View Layer.{name}", np.asarray(image), letters)
    samples = {"cycles.View Layer.samples": f"{float(frame.samples):.0f}"}
    write(path, channels, **samples)


def halves_of(frame):
    """The colour of both halves, [2,H,W,C]."""
    return np.stack([np.asarray(half.color) for half in frame.halves()])


@pytest.mark.parametrize("code", [*snippets()])
def test_snippet_stands_alone(code, reader):
    exec(compile(code, "snippet", "exec"), {"__name__": "snippet"})


def test_readme_runs_in_a_new_process(tmp_path):
    """In an empty folder, with nothing imported or set: what a newcomer pastes."""
    ((_, code),) = blocks(README, "python")
    assert len([line for line in code.splitlines() if line]) <= 8
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    path_traced, denoised, combined = map(float, done.stdout.split())
    assert combined < 0.95 * denoised < 0.1 * path_traced
    assert exr.read_image(tmp_path / "combined.exr").shape == (192, 192, 3)


@pytest.mark.parametrize("words", [*commands()])
def test_command_exists(words, monkeypatch):
    """Its program, its subcommand, its options; its module for Python's."""
    for each in " ".join(words).split(" && "):
        program, *rest = each.split()
        if program == "jscomb":
            monkeypatch.setattr(sys, "argv", [program, *rest])
            assert callable(parse())
        elif program == "python":
            assert rest[0] == "-m"
            assert (ROOT / f"{rest[1].replace('.', '/')}.py").exists()
        else:
            assert program in ("pip", "pytest")


@pytest.mark.parametrize(
    "words",
    [
        each
        for each in commands()
        if each.values[0][:2] in [["jscomb", c] for c in ("info", "compare", "view")]
        or {"--method", "whitened"} <= set(each.values[0])
    ],
)
def test_command_runs(words, jscomb, reader):
    frame = exr.read_frame(reader / "frame.exr")
    if words[1] != "combine":  # it would not replace them
        for name in ("out", "combined"):
            exr.write_image(reader / f"{name}.exr", frame.color)
    status, out, error = jscomb(*words[1:])
    assert (status, error) == (0, "")
    assert out


def test_every_frame_has_one_task_of_the_job_array(tmp_path):
    """The script as it stands, with the command in place of what prints its words."""
    ((_, script),) = blocks(ROOT / "jscomb" / "guide" / "large_frames.md", "bash")
    command = tmp_path / "jscomb"
    command.write_text('#!/bin/sh\nprintf "%s\\n" "$@"\n')
    command.chmod(0o755)
    (tmp_path / "frames").mkdir()
    frames = [f"frames/{number:03} a.exr" for number in range(5)]
    for frame in frames:
        (tmp_path / frame).touch()
    done = []
    for task in range(7):  # more of them than frames
        words = subprocess.run(
            ["bash", "-c", script],
            cwd=tmp_path,
            env={
                "PATH": f"{tmp_path}:{os.environ['PATH']}",
                "SLURM_ARRAY_TASK_ID": str(task),
                "SLURM_ARRAY_TASK_COUNT": "7",
            },
            capture_output=True,
            text=True,
            check=True,
        ).stdout.splitlines()
        assert not words or (words[0], words[-2:]) == ("combine", ["-o", "out/"])
        done += words[1:-2]
    assert sorted(done) == frames


@pytest.mark.slow
def test_the_table_is_what_the_demo_prints(jscomb, tmp_path):
    """The errors, but for rounding; times are a machine's own.

    A denoiser's derivative depends on which of equal pixels is a maximum, and with it
    what pd's network makes of it: 4 % between programs optimised and not.
    """
    _, out, _ = jscomb("demo", "--out", tmp_path)
    printed = dict(re.findall(r"^ {2}(\S.*?) {2,}(0\.\d+)", out, re.M))
    rows = dict(
        re.findall(r"^\| ([a-z][^|]*) \| (0\.\d+) \|", README.read_text(), re.M)
    )
    assert [*rows] == [*printed]
    found, told = ({n: float(e) for n, e in t.items()} for t in (printed, rows))
    np.testing.assert_allclose([*told.values()], [*found.values()], rtol=0.05)
    order = [found[n] for n in ("best", "balanced", "fast", "denoised", "path tracing")]
    assert order == sorted(order)


@pytest.mark.parametrize("path", LINKED, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(path):
    text = re.sub(r"^```.*?^```$|`[^`\n]+`", "", path.read_text(), flags=re.M | re.S)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = path.parent / name if name else path
        assert target.exists(), link
        if anchor:
            headings = re.findall(r"^#+ (.*)$", target.read_text(), re.M)
            assert anchor in map(slug, headings), link


def test_readme_is_short():
    text = README.read_text()
    assert len(text.splitlines()) < 120
    assert len(re.findall(r"^!\[", text, re.M)) == 1
    assert len(re.findall(r"^\| ---", text, re.M)) == 1
    assert all(f"(jscomb/guide/{page.name})" in text for page in PAGES[1:])
    assert all(f"(notebooks/{path.name})" in text for path in NOTEBOOKS)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_notebook_is_committed_as_executed(path):
    """In order, in one go, without an error, with its pictures; it ends in a claim."""
    assert path.stat().st_size < 300_000
    cells = json.loads(path.read_text())["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == [*range(1, len(code) + 1)]
    assert re.search(r"^ *assert ", "".join(code[-1]["source"]), re.M)
    outputs = [output for cell in code for output in cell["outputs"]]
    assert not [o for o in outputs if o["output_type"] == "error"]
    assert not [o for o in outputs if o.get("name") == "stderr"]
    for cell in code:
        pictures = [
            o["data"]["image/png"]
            for o in cell["outputs"]
            if "data" in o and "image/png" in o["data"]
        ]
        assert len(pictures) == "".join(cell["source"]).count("plt.show()")
        assert all(len(picture) > 5_000 for picture in pictures)
