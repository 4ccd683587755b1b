"""Frames to train, to validate and to test on: views of real and of random scenes.

A view is a variation of a real scene (`variations`) or a random scene
(`rendering`, random-SEED), rendered at several sample counts with four sub-buffers and
features, denoised, and photon mapped with halves. Its frames share one reference and
one photon-mapped image; their noise is independent of both and of each other. OUT gets
a folder a split, frames VIEW-SPP.exr in it; the same command resumes an interrupted
run. `--sheet` prints what is there.

Splits are by scene: no view of a scene that is trained on is in another split. The test
split is for final figures only; choices are made on the validation split.

References of training views are noisy; those of validation and test views have eight
times the samples, and `metrics.rel_l2` subtracts the noise that is left.
"""

import dataclasses
import functools
import pathlib
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
import tyro
from tqdm import tqdm

from experiments.common.command import tool
from experiments.common.processes import in_fresh_processes
from experiments.common.results import Results
from experiments.common.tables import table
from experiments.data import variations
from experiments.data.development import noise
from jscomb import exr, methods, rendering
from jscomb.denoisers import oidn
from jscomb.rendering import PHOTONS, Settings

BUFFERS = 4
STREAMS = 1_000_000  # difference of the seeds of one view's frames
VIEWS_A_PROCESS = 8
PHOTONS_A_PASS = 100_000
PASSES = (8, 16, 32)  # of photon mapping
LOW, MIDDLE, HIGH = (4, 8, 16), (32, 64, 128), (256, 512, 1024, 2048, 4096)
RARE = (0.7, 0.2, 0.07, 0.02, 0.01)  # probabilities of HIGH: cost grows with samples


class Split(NamedTuple):
    """What a split is made of.

    Attributes:
        scenes: real ones.
        variations: of each.
        random: number of random scenes.
        first: seed of the first one.
        reference_spp: samples a pixel of references.
        counts: sample counts of every view; none for all of few and some samples, and
            a drawn one of many.
    """

    scenes: tuple[str, ...]
    variations: int
    random: int
    first: int
    reference_spp: int
    counts: tuple[int, ...] = ()


SPLITS = {
    "train": Split(
        ("bathroom", "cornell-box", "glass-of-water", "living-room-2"),
        variations=17,
        random=96,
        first=1000,
        reference_spp=256,
    ),
    "validate": Split(
        ("dining-room", "veach-mis"),
        variations=3,
        random=6,
        first=2000,
        reference_spp=2048,
        counts=(4, 8, 32, 128, 512),
    ),
    "test": Split(
        ("living-room", "staircase2", "veach-bidir"),
        variations=4,
        random=8,
        first=3000,
        reference_spp=2048,
        counts=(4, 16, 64, 256, 1024),
    ),
}


@dataclasses.dataclass(frozen=True)
class Config:
    """Which frames.

    Attributes:
        out: folder of the frames.
        scenes: folder of the real scenes, a folder with a scene.xml each.
        splits: which of the splits.
        size: width and height in pixels.
        sheet: print what is there and render nothing.
        quick: one random scene a split, tiny.
    """

    out: tyro.conf.Positional[pathlib.Path]
    scenes: pathlib.Path
    splits: tuple[str, ...] = ("train", "validate", "test")
    size: int = 128
    sheet: bool = False
    quick: bool = False

    def __post_init__(self) -> None:
        """Raise for an unknown split."""
        if wrong := set(self.splits) - set(SPLITS):
            raise ValueError(
                f"no split {', '.join(wrong)}; there are {', '.join(SPLITS)}"
            )


class View(NamedTuple):
    """One view of a scene.

    Attributes:
        split: train, validate or test.
        scene: a real one's name, or "random".
        seed: of the variation or of the random scene.
    """

    split: str
    scene: str
    seed: int

    @property
    def name(self) -> str:
        """As in the names of its files."""
        return f"{self.scene}-{self.seed:04d}"


def views(config: Config) -> list[View]:
    """List the views, those of all splits and scenes in turn: any part is a dataset.

    Args:
        config: which splits.

    Returns:
        the views.
    """
    rows = []
    for name in config.splits:
        split = SPLITS[name]
        if config.quick:
            split = split._replace(scenes=(), random=1)
        real = [
            [View(name, s, k) for k in range(split.variations)] for s in split.scenes
        ]
        random = [View(name, "random", split.first + k) for k in range(split.random)]
        rows += [*real, random]
    spread = [(k / len(row), view) for row in rows for k, view in enumerate(row)]
    return [view for _, view in sorted(spread)]


def counts(view: View) -> list[int]:
    """Return the sample counts of a view's frames.

    Args:
        view: which.

    Returns:
        of its split, or all of few and some samples, which cost little beside the one
        of many and the reference.
    """
    fixed = SPLITS[view.split].counts
    if fixed:
        more = fixed[-1] * 4  # every other view reaches farther
        return [*fixed, more] if view.seed % 2 == 0 else list(fixed)
    rng = np.random.default_rng([_number(view), 0xC0417])
    return [*LOW, *MIDDLE, int(rng.choice(HIGH, p=RARE))]


def frames(folder: pathlib.Path, split: str) -> Iterator[tuple[str, int, pathlib.Path]]:
    """List the frames of a split.

    Args:
        folder: that `run` wrote.
        split: train, validate or test.

    Yields:
        view, samples a pixel and file, by view and samples.

    Raises:
        ValueError: if there are none.
    """
    found = []
    for path in (folder / split).glob("[!.]*.exr"):
        view, _, samples = path.stem.rpartition("-")
        found.append((view, int(samples), path))
    if not found:
        raise ValueError(f"{folder / split}: no frames there; experiments.data.dataset")
    yield from sorted(found)


def measured(
    folder: pathlib.Path,
    split: str,
    measure: Callable[[pathlib.Path], Any],
    results: pathlib.Path | None,
    *,
    first: int | None = None,
) -> dict[str, Any]:
    """Measure the frames of a split, and keep what was measured as it comes.

    Args:
        folder: that `run` wrote.
        split: train, validate or test.
        measure: of a frame's file.
        results: file that stores results; None to keep none.
        first: how many frames; None for all.

    Returns:
        what was measured, by "view samples".

    Raises:
        ValueError: if there are no frames.
    """
    store = Results(results)
    return {
        f"{view} {samples}": store.get(
            f"{view} {samples}", functools.partial(measure, path)
        )
        for view, samples, path in list(frames(folder, split))[:first]
    }


def run(config: Config) -> list[pathlib.Path]:
    """Render the frames that do not exist yet.

    Args:
        config: which frames.

    Returns:
        all frames' files.

    Raises:
        ImportError: without Open Image Denoise.
        RuntimeError: if the renderer crashed; the same command resumes.
    """
    if config.sheet:
        print(sheet(config.out))
        return sorted(config.out.glob("*/*.exr"))
    if not oidn.available():
        raise ImportError('a dataset needs a denoiser: pip install "jscomb[oidn]"')
    for split in config.splits:
        (config.out / split).mkdir(parents=True, exist_ok=True)
    start, todo = time.monotonic(), views(config)
    # Dr.Jit keeps every scene's compiled code, and was observed to crash after ninety.
    render = functools.partial(_render, config)
    made = in_fresh_processes(render, todo, each=VIEWS_A_PROCESS)
    number = sum(tqdm(made, total=len(todo), unit="view", desc="dataset"))
    print(f"{number} frames made in {(time.monotonic() - start) / 60:.1f} min")
    return sorted(config.out.glob("*/*.exr"))


def sheet(folder: pathlib.Path) -> str:
    """Describe the frames of a folder.

    Args:
        folder: that `run` wrote.

    Returns:
        a table of splits: scenes, views, frames, sample counts, photon-mapped images,
        size on disk and the relative L2 of the references' own noise.
    """
    rows = []
    for split in SPLITS:
        files = list(frames(folder, split))
        names = {name: path for name, _, path in files}
        scenes = {name.rpartition("-")[0] for name in names}
        random = sum(name.startswith("random") for name in names)
        spp = sorted({count for _, count, _ in files})
        noises = [noise(path) for path in names.values()]
        rows.append(
            [
                split,
                ", ".join(sorted(scenes - {"random"})),
                random,
                len(names),
                len(files),
                f"{spp[0]} to {spp[-1]}",
                sum(PHOTONS in exr.read_frame(p).estimates for p in names.values()),
                round(sum(path.stat().st_size for *_, path in files) / 1e6),
                float(np.median(noises)),
                float(np.max(noises)),
            ]
        )
    header = ["split", "real scenes", "random scenes", "views", "frames", "samples"]
    header += ["photon mapped", "MB", "reference noise, median", "maximum"]
    return table(header, rows)


def _number(view: View) -> int:
    """A seed of a view's own."""
    names = sorted({s for split in SPLITS.values() for s in split.scenes})
    place = names.index(view.scene) + 1 if view.scene in names else 0
    return 10_000 * place + view.seed


def _render(config: Config, view: View) -> int:
    """Render a view's frames that are missing, and return how many."""
    folder = config.out / view.split
    files = {n: folder / f"{view.name}-{n}.exr" for n in counts(view)}
    blind = folder / f"{view.name}.blind"
    todo = {n: path for n, path in files.items() if not path.exists()}
    if not todo or blind.exists():
        return 0
    scene = _source(config, view)
    if scene is None:
        blind.touch()
        return 0
    done = [path for path in files.values() if path.exists()]
    for spp, path in todo.items():
        settings = _settings(config, view, spp, first=not done)
        shared = exr.read_frame(done[0]) if done else None
        partial = path.with_suffix(".partial.npz")
        frame = rendering.render(
            scene,
            settings,
            reference=shared and shared.reference,
            partial=partial,
        )
        if shared:
            frame = frame.with_estimate(PHOTONS, shared.estimates[PHOTONS])
        denoised = methods.combine(jax.random.key(0), frame, method="oidn")
        frame = frame.with_estimate("oidn", denoised)
        about = rendering.provenance(scene, settings)
        exr.write_frame(path, frame, provenance=about)
        partial.unlink(missing_ok=True)
        done.append(path)
    return len(todo)


def _source(config: Config, view: View) -> str | None:
    """The scene to render; None if its camera sees nothing."""
    if view.scene == "random":
        name = f"random-{view.seed}"
        preview = rendering.load_scene(
            name, width=variations.PREVIEW, height=variations.PREVIEW
        )
        return name if variations.sees_something(preview) else None
    path = config.out / view.split / f"{view.name}.xml"
    original = config.scenes / view.scene / "scene.xml"
    if not original.is_file():
        raise ValueError(f"{original}: no such file; it is scene {view.scene}")
    if not path.exists() and not variations.write_variation(original, view.seed, path):
        return None
    return str(path)


def _settings(config: Config, view: View, spp: int, *, first: bool) -> Settings:
    """What is rendered: the first frame brings the reference and the photons."""
    more: dict[str, Any] = {}
    seed = spp.bit_length() * STREAMS  # sample counts are powers of two
    if first:
        rng = np.random.default_rng([_number(view), 0xF0705])
        more = {
            "reference_spp": SPLITS[view.split].reference_spp,
            "photons": PHOTONS_A_PASS,
            "passes": int(rng.choice(PASSES)),
        }
    size = config.size
    if config.quick:
        size, spp = 16, 8
        more = {"reference_spp": 64, "photons": 1000, "passes": 4} if more else {}
    return Settings(spp=spp, size=size, buffers=BUFFERS, seed=seed, **more)


if __name__ == "__main__":
    tool(Config, run)
