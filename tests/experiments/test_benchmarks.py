"""What functions cost: their work is counted right, and what was measured is kept."""

import collections
import importlib.util
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jscomb
from experiments.benchmarks import (
    accelerators,
    files,
    large,
    performance,
    processes,
    robustness,
    tiers,
)
from experiments.benchmarks.work import Work, work_of
from jscomb import exr
from tests.conftest import DATA

M, N, K = 3, 5, 7


def scanned(x):
    """Ten exponentials of each number."""
    return jax.lax.scan(lambda c, _: (jnp.exp(c), None), x, length=10)[0]


def branched(x):
    """The dearer branch counts."""
    return jax.lax.cond(x[0] > 0, lambda x: jnp.sin(jnp.sin(x)), jnp.exp, x)


@pytest.mark.parametrize(
    ("function", "shapes", "expected"),
    [
        (jnp.matmul, [(M, K), (K, N)], {"products": 2 * M * N * K}),
        (lambda x: x[::2] + 1, [(8,)], {"operations": 4}),
        (scanned, [(6,)], {"exponentials": 60}),
        (jax.jit(scanned), [(6,)], {"exponentials": 60}),
        (branched, [(6,)], {"exponentials": 12, "operations": 1}),
        (jnp.sum, [(9,)], {"operations": 9}),
        (jax.vmap(jnp.dot), [(4, K), (4, K)], {"products": 2 * 4 * K}),
    ],
)
def test_work_is_counted(function, shapes, expected):
    arrays = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    found = work_of(function, *arrays)
    for kind in ("products", "operations", "exponentials"):
        assert getattr(found, kind) == expected.get(kind, 0), kind
    made = jax.eval_shape(function, *arrays)
    assert found.moved == 4 * sum(each.size for each in (*arrays, made))


def test_what_is_not_used_is_not_moved():
    arrays = [jnp.ones(8, jnp.float32), jnp.ones(100, jnp.float32)]
    assert work_of(lambda x, y: x, *arrays).moved == 64


def test_time_is_that_of_computing_or_moving():
    rates = Work(10.0, 2.0, 1.0, 4.0)
    assert Work(10, 2, 1, 4).seconds(rates) == 3
    assert Work(1, 0, 0, 40).seconds(rates) == 10


@pytest.mark.slow
def test_performance_is_measured_and_kept(tmp_path, monkeypatch):
    config = performance.Config(tmp_path / "costs.jsonl", quick=True)
    found = performance.run(config)
    assert set(found.costs) == set(performance.functions(quick=True))
    for costs in found.costs.values():
        assert list(costs) == [32, 64]
        for cost in costs.values():
            assert cost.seconds > 0
            assert cost.ceiling > 0
            assert cost.compiling > 0
        assert costs[32].compiling_gradient > 0

    def never(*_, **__):
        raise AssertionError("measured again")

    monkeypatch.setattr(performance, "measure", never)
    assert performance.run(config) == found
    assert "`smoothing.box`" in performance.report(found).body


@pytest.mark.slow
def test_performance_of_an_earlier_package(tmp_path):
    there = pathlib.Path(jscomb.__file__).parent
    (tmp_path / "jscomb").symlink_to(there, target_is_directory=True)
    with performance.process_of(tmp_path) as process:
        spec = process.submit(importlib.util.find_spec, "jscomb").result()
        assert pathlib.Path(spec.origin).parent == tmp_path / "jscomb"
        given = performance.seconds_here, "smoothing.box", 32, True
        seconds = process.submit(*given).result()
    costs = {"smoothing.box": dict.fromkeys((16, 32), performance.Cost(*[1.0] * 7))}
    before = {"smoothing.box": (seconds, 2 * seconds)}
    found = performance.Found(costs, before, Work(*[1.0] * 4))
    said = performance.report(found)
    assert "Of 1 that were there before 0 take less than 0.50" in said.answer
    assert "| `smoothing.box` | 2.00 |" in said.body


@pytest.mark.slow
def test_large_frames_of_any_size(glass_frame, tmp_path):
    path = tmp_path / "glass.exr"
    exr.write_frame(path, glass_frame)
    config = large.Config(path, methods=("whitened",), budget=2, quick=True)
    rows = large.run(config)
    (row,) = rows.values()
    assert row.tile < 256
    assert row.difference < 1e-6
    assert row.seconds > 0
    assert f"whitened {row.seconds:.1f} s" in large.report(rows).answer
    grown = large.enlarged(glass_frame, 100)
    assert grown.color.shape == (100, 100, 3)
    np.testing.assert_array_equal(grown.color[:64, :64], glass_frame.color)
    np.testing.assert_array_equal(grown.color[64:], grown.color[28:64][::-1])


@pytest.mark.slow
def test_programs_for_accelerators_are_counted():
    programs = accelerators.run(accelerators.Config(quick=True))
    assert set(programs) == set(performance.functions(quick=True))
    assert all(each.callbacks == 0 < each.steps for each in programs.values())
    in_loops = jax.make_jaxpr(
        lambda x: jax.lax.fori_loop(0, 5, lambda _, y: jnp.sin(y) * 2, x)
    )(1.0)
    counted = sum(n for name, n in accelerators.primitives(in_loops.jaxpr)
                  if name in ("sin", "mul"))  # fmt: skip
    assert counted == 10


def test_robustness_counts_what_is_bad():
    good = collections.Counter({"right image": 3, "no checksum": 2})
    found = {"own": good, "foreign": collections.Counter({"hang": 1})}
    said = robustness.report(found)
    assert said.answer.startswith("1 of 6 attempts end badly; 2 times")
    assert "| foreign |  |  |  | 1 |" in said.body


@pytest.mark.slow
def test_files_are_read_and_written_beside_openexr():
    found = files.run(files.Config(quick=True))
    assert found.keys() == files.WAYS.keys()
    assert all(row.seconds > 0 for row in found.values())
    said = files.report(found)
    ratio = found["jscomb, a frame"].seconds / next(iter(found.values())).seconds
    assert f"takes {ratio:.2f} times" in said.answer


@pytest.mark.slow
def test_tiers_cost_what_their_parts_do():
    frame = DATA / "cornell-glass-64.exr"
    found = tiers.run(tiers.Config(frame, quick=True))
    ((size, tier), cost), *_ = found.costs.items()
    assert (size, tier) == (96, "fast")
    assert 0 < cost.second < cost.first
    assert found.parts[96].keys() >= {"oidn", "weights"}
    said = tiers.report(found._replace(rendering=10.0))
    assert "| 0.0922 |" in said.body  # of 96x96 pixels
    assert f"fast {cost.second / cost.denoising:.3g}" in said.answer


@pytest.mark.slow
def test_processes_share_a_sequence():
    frame = DATA / "cornell-glass-64.exr"
    one, two = processes.run(processes.Config(frame, quick=True))
    assert (one.processes, two.processes) == (1, 2)
    assert one.frames == two.frames == 2
    said = processes.report([one, two])
    gain = one.seconds / two.seconds
    assert f"2 processes {gain:.2f} times" in said.answer


def test_every_frame_is_in_one_share():
    frames = [*map(pathlib.Path, "abcdefg")]
    found = processes.shares(frames, 3)
    assert sorted(frame for share in found for frame in share) == frames
    assert max(map(len, found)) - min(map(len, found)) == 1
