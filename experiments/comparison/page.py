"""One page to look at: the table of all combiners, the plots, and the images.

Of what `comparison.sweep` measured. The page holds everything that it shows, and needs
no server and no network.
"""

import dataclasses
import html
import io
import pathlib
from collections.abc import Container
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib as mpl
import tyro
from matplotlib.figure import Figure
from tqdm import tqdm

from experiments.common.command import tool
from experiments.comparison import convergence, equal_time, pareto
from experiments.comparison.combiners import combiners
from experiments.comparison.sweep import Record, results
from jscomb import exr, methods, viewer
from jscomb.frame import Frame
from jscomb.typing import Image

TEMPLATE = pathlib.Path(__file__).with_suffix(".html")


@dataclasses.dataclass(frozen=True)
class Config:
    """What to show.

    Attributes:
        results: lines of `experiments.comparison.sweep`.
        frames: EXR files with a reference, such as those in the sweep's work folder.
        out: page to write.
        combiners: images to show of each frame.
        metric: of the table and the plots; one that every seed has.
        quick: measure the quick sweep into the results first, and show its first frame.
    """

    results: tyro.conf.Positional[pathlib.Path]
    frames: tuple[pathlib.Path, ...] = ()
    out: pathlib.Path = pathlib.Path("page.html")
    combiners: tuple[str, ...] = (
        "path tracing",
        "oidn",
        "whitened",
        "njs",
        "pd",
        "dsc",
        *methods.TIERS,
    )
    metric: str = "relative L2"
    quick: bool = False


def shown(path: pathlib.Path, combiners: tuple[str, ...]) -> viewer.Scene:
    """A frame's images, and of the tiers the map of the estimated error.

    Args:
        path: EXR file with a reference.
        combiners: names of `experiments.comparison.combiners`.

    Returns:
        the scene, of normalised radiance.

    Raises:
        ValueError: if the frame has no reference, or no denoised image.
    """
    frame = exr.read_frame(path)
    if frame.reference is None or "oidn" not in frame.estimates:
        raise ValueError(f"{path} has no reference or no biased image 'oidn'")
    frame, key = frame.normalised(), jax.random.key(0)
    tiers = [name for name in combiners if name in methods.TIERS]
    made = {name: methods.combine_tier(key, frame, tier=name) for name in tiers}
    images = {
        name: made[name].estimate.image if name in made else _made(frame, name)
        for name in combiners
    }
    known = {n: tier.error.map for n, tier in made.items() if tier.error is not None}
    return viewer.make_scene(
        path.stem, images, reference=frame.reference, maps={"estimated": known}
    )


def _made(frame: Frame, name: str) -> Image:
    """A combiner's image."""
    combiner = combiners()[name]
    return combiner.combine(*([frame, jnp.float32(1)] if combiner.traced else [frame]))


def table(rows: dict[str, pareto.Row]) -> str:
    """Rows as an HTML table, the cheapest first.

    Args:
        rows: by `pareto.rows_of`.

    Returns:
        HTML.
    """
    counts = list(next(iter(rows.values())).errors)
    heads = [
        "",
        *(f"{spp} spp" for spp in counts),
        "mean",
        "worst",
        "cost in denoisings",
    ]
    lines = ["<tr>" + "".join(f"<th>{head}</th>" for head in heads) + "</tr>"]
    for name, row in sorted(rows.items(), key=lambda item: item[1].cost):
        numbers = [*row.errors.values(), row.mean, row.worst, row.cost]
        cells = [html.escape(name), *(f"{number:.3f}" for number in numbers)]
        mark = ' class="front"' if row.front else ""
        lines.append(f"<tr{mark}>" + "".join(f"<td>{c}</td>" for c in cells) + "</tr>")
    return "<table>" + "\n".join(lines) + "</table>"


def plots(
    records: list[Record], metric: str, *, combiners: Container[str]
) -> list[str]:
    """All plots, as SVG.

    Args:
        records: of a sweep.
        metric: of the plots.
        combiners: whose curves to draw.

    Returns:
        the elements.
    """
    rows = pareto.rows_of(records, metric)
    drawn = [_svg(pareto.draw(rows, metric))]
    shown: dict[str, Any] = {
        "combiners": tuple(name for name in rows if name in combiners)
    }
    curves = convergence.curves(records, metric)
    drawn.append(_svg(convergence.draw(curves, metric, **shown)))
    if any(record["seconds"]["sampling"] is not None for record in records):
        timed, shown["along"] = equal_time.curves(records, metric), "seconds"
        drawn.append(_svg(convergence.draw(timed, metric, **shown)))
    return drawn


def _svg(figure: Figure) -> str:
    """A plot as an element, without the head of a file."""
    file = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": "jscomb"}):
        figure.savefig(file, format="svg")
    text = file.getvalue()
    return text[text.index("<svg") :]


def page(records: list[Record], frames: list[viewer.Scene], metric: str) -> str:
    """The whole page.

    Args:
        records: of a sweep.
        frames: by `shown`.
        metric: of the table and the plots.

    Returns:
        HTML that needs nothing else.
    """
    scenes = sorted({record["scene"] for record in records})
    seeds = max(len(record["errors"][metric]) for record in records)
    about = (
        f"The {metric} of every combiner on {', '.join(scenes)}, mean of {seeds} seeds,"
        " divided by that of the better of path tracing and Open Image Denoise:"
        " geometric mean over scenes, at each sample count. Its cost beside sampling,"
        " in units of one denoising. Marked: what nothing cheaper is as good as."
    )
    # The curves of what is shown: of all combiners they could not be told apart.
    drawn = plots(records, metric, combiners=frames[0].images)
    parts = {
        "about": html.escape(about),
        "table": table(pareto.rows_of(records, metric)),
        "plots": "\n".join(f"<figure>{svg}</figure>" for svg in drawn),
        "viewer": viewer.element(frames, address=True),
    }
    text = TEMPLATE.read_text()
    for name, part in parts.items():
        text = text.replace("{{" + name + "}}", part)
    return text


def run(config: Config) -> pathlib.Path:
    """Write the page.

    Args:
        config: what to show.

    Returns:
        its path.

    Raises:
        ValueError: if there are no results, no frames, or a frame without a reference.
    """
    records, frames = results(config.results, quick=config.quick), config.frames
    if config.quick:
        frames = tuple(sorted(config.results.with_suffix("").glob("*-4-0.exr")))
    if not frames:
        raise ValueError("no --frames to show")
    made = [shown(path, config.combiners) for path in tqdm(frames, unit="frame")]
    config.out.write_text(page(records, made, config.metric))
    return config.out


if __name__ == "__main__":
    tool(Config, run)
