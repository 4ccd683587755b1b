"""Would the tests fail if the code were wrong?

Each mutation is one small mistake in a copy of the package: a sign in a paper's
equation, a window off by one, a variance not divided by the number of buffers, halves
swapped. The tests named beside it run until the first that fails.
"""

import concurrent.futures
import dataclasses
import os
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
from typing import NamedTuple

from tqdm import tqdm

from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table

ROOT = pathlib.Path(__file__).parents[2]
COPIED = "jscomb", "tests", "experiments", "pyproject.toml"


class Mutation(NamedTuple):
    """One mistake.

    Attributes:
        mistake: in words.
        file: of the package.
        right: text that stands there once.
        wrong: text that replaces it.
        tests: files that have to notice, in the folder of the tests.
    """

    mistake: str
    file: str
    right: str
    wrong: str
    tests: str


MUTATIONS = (
    Mutation(
        "James-Stein: shares of x and y swapped",
        "james_stein/_combine.py",
        "blend = share * x + (1 - share) * y",
        "blend = share * y + (1 - share) * x",
        "test_james_stein.py",
    ),
    Mutation(
        "James-Stein: p instead of p - 2 degrees of freedom",
        "james_stein/_combine.py",
        "jnp.maximum(count - 2, 0.0)",
        "jnp.maximum(count, 0.0)",
        "test_james_stein.py",
    ),
    Mutation(
        "James-Stein: the divergence added instead of subtracted",
        "james_stein/_combine.py",
        "count * s2 - window_sum(divergence, window)",
        "count * s2 + window_sum(divergence, window)",
        "test_james_stein.py",
    ),
    Mutation(
        "James-Stein, dual: each half's x with its own y",
        "james_stein/_combine.py",
        "combine(unbiased_a, biased_b, 2 * variance",
        "combine(unbiased_a, biased_a, 2 * variance",
        "test_james_stein.py",
    ),
    Mutation(
        "ensemble: each half judged by itself",
        "ensemble/_estimate.py",
        "(one(biased_a, unbiased_b) + one(biased_b, unbiased_a)) / 2",
        "(one(biased_a, unbiased_a) + one(biased_b, unbiased_b)) / 2",
        "test_ensemble.py",
    ),
    Mutation(
        "ensemble, over windows: each half judged by itself",
        "ensemble/_evidence.py",
        "Evidence(one(y_a, x_b, variance_b), one(y_b, x_a, variance_a), count)",
        "Evidence(one(y_a, x_a, variance_b), one(y_b, x_b, variance_a), count)",
        "test_ensemble.py",
    ),
    Mutation(
        "ensemble: the cross term's sign",
        "ensemble/_estimate.py",
        "y[:, None] * y[None] - (y[:, None]",
        "y[:, None] * y[None] + (y[:, None]",
        "test_ensemble.py",
    ),
    Mutation(
        "double shrinkage: share of the wrong integrator",
        "double_shrinkage/_combine.py",
        "jnp.where(lost, 1.0, weighted_ratio(e, e + o))",
        "jnp.where(lost, 1.0, weighted_ratio(o, e + o))",
        "test_double_shrinkage.py",
    ),
    Mutation(
        "double shrinkage: the prior's share and the rest swapped",
        "double_shrinkage/_combine.py",
        "share.prior * p + (1 - share.prior) * share.blend(u, b)",
        "(1 - share.prior) * p + share.prior * share.blend(u, b)",
        "test_double_shrinkage.py",
    ),
    Mutation(
        "progressive: the sign of SURE in the mixing",
        "progressive/_estimate.py",
        "square, saved = jnp.square(y - x), v - s",
        "square, saved = jnp.square(y - x), v + s",
        "test_progressive.py",
    ),
    Mutation(
        "progressive: the bound lets pass what it should stop",
        "progressive/_combine.py",
        "ndtr(strength * (shift - t))",
        "ndtr(strength * (t - shift))",
        "test_progressive.py",
    ),
    Mutation(
        "progressive: the noise of the channels' mean divided by C, not C squared",
        "progressive/_combine.py",
        "keepdims=True) / variance.shape[-1] ** 2",
        "keepdims=True) / variance.shape[-1]",
        "test_progressive.py",
    ),
    Mutation(
        "SURE: the divergence once instead of twice",
        "numerics/sure.py",
        "+ 2 * d - v",
        "+ d - v",
        "test_sure.py",
    ),
    Mutation(
        "uncorrelated kernels: the pull away from the window",
        "uncorrelated/_combine.py",
        "kernel(*differences) * (s_c - s_i)",
        "kernel(*differences) * (s_i - s_c)",
        "test_uncorrelated.py",
    ),
    Mutation(
        "uncorrelated kernels: weights of the samples they are applied to",
        "uncorrelated/_combine.py",
        "image = _drawn(first, kernel, second.z, window)",
        "image = _drawn(first, kernel, first.z, window)",
        "test_uncorrelated.py",
    ),
    Mutation(
        "windows: one pixel too narrow",
        "numerics/windows.py",
        "columns = _add_columns(image, check_window(window))",
        "columns = _add_columns(image, max(1, check_window(window) - 2))",
        "test_windows.py",
    ),
    Mutation(
        "a frame's variance not divided by its sub-buffers",
        "frame/_frame.py",
        "jnp.mean(self.buffers.variance, axis=0) / k",
        "jnp.mean(self.buffers.variance, axis=0)",
        "test_frame.py",
    ),
    Mutation(
        "variance from sub-buffers with K instead of K - 1",
        "frame/_frame.py",
        "jnp.var(self.buffers.color, axis=0, ddof=1) / k",
        "jnp.var(self.buffers.color, axis=0, ddof=0) / k",
        "test_frame.py",
    ),
    Mutation(
        "an estimate's halves swapped",
        "frame/_halves.py",
        "each.half(number)",
        "each.half(1 - number)",
        "test_composition.py test_frame.py",
    ),
    Mutation(
        "log-L2: the weight of the logarithm's own error",
        "learning/losses.py",
        "jnp.mean(jnp.square(found - truth) / weight)",
        "jnp.mean(jnp.square(found + truth) / weight)",
        "test_networks.py test_learning.py",
    ),
)


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to try.

    Attributes:
        only: mutations of files whose names contain this.
        limit: seconds for each.
    """

    only: str = ""
    limit: int = 300


def caught(mutation: Mutation, limit: int = 300) -> str | None:
    """Run the tests on a copy of the package with the mistake.

    Args:
        mutation: the mistake.
        limit: seconds after which the copy is given up.

    Returns:
        the first test that fails; None if all pass.

    Raises:
        ValueError: if the right text does not stand there just once.
        RuntimeError: if the tests could not run.
    """
    with tempfile.TemporaryDirectory() as folder:
        copy = pathlib.Path(folder)
        for name in COPIED:
            source = ROOT / name
            ignore = shutil.ignore_patterns("__pycache__")
            if source.is_dir():
                shutil.copytree(source, copy / name, ignore=ignore)
            else:
                shutil.copy(source, copy)
        path = copy / "jscomb" / mutation.file
        text = path.read_text()
        if text.count(mutation.right) != 1:
            raise ValueError(f"{mutation.file} has not one {mutation.right!r}")
        path.write_text(text.replace(mutation.right, mutation.wrong))
        files = [f"tests/{name}" for name in mutation.tests.split()]
        command = [sys.executable, "-m", "pytest", "-x", "-q"]
        command += ["-o", "addopts=--import-mode=importlib --strict-markers", *files]
        run = subprocess.run(
            command,
            cwd=copy,
            env=os.environ | {"PYTHONPATH": str(copy), "TF_CPP_MIN_LOG_LEVEL": "3"},
            capture_output=True,
            text=True,
            timeout=limit,
            check=False,
        )
    failed = re.search(r"^(?:FAILED|ERROR) tests/(\S+)", run.stdout, re.MULTILINE)
    if run.returncode > 1 or bool(failed) != bool(run.returncode):
        raise RuntimeError(
            f"{mutation.mistake}: {run.stdout[-300:]}{run.stderr[-300:]}"
        )
    return failed.group(1) if failed else None


def run(config: Config) -> dict[Mutation, str | None]:
    """Try all mistakes, one a core at a time.

    Args:
        config: what to try.

    Returns:
        the test that caught each; None where none did.
    """
    wanted = [m for m in MUTATIONS if config.only in m.file]
    wanted = wanted[: 1 if config.quick else None]
    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        found = pool.map(lambda m: caught(m, config.limit), wanted)
        return dict(zip(wanted, tqdm(found, total=len(wanted)), strict=True))


def report(found: dict[Mutation, str | None]) -> Report:
    """Say which were caught, and by what.

    Args:
        found: by `run`.

    Returns:
        a line a mistake.
    """
    number = sum(test is not None for test in found.values())
    rows = [(m.mistake, f"`{m.file}`", f"`{test}`") for m, test in found.items()]
    return Report(
        f"{number} of {len(found)} mistakes are caught.",
        table(("mistake", "in", "first test that fails"), rows),
    )


if __name__ == "__main__":
    main(Config, run, report)
