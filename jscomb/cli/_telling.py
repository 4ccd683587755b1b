"""What `combine` says: its progress, and what was done and why."""

import contextlib
import json
import math
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from typing import Any, Literal, TypeVar

from tqdm import tqdm

from jscomb import methods

Voice = Literal["sentences", "quiet", "verbose", "json"]
Item = TypeVar("Item")
_COMPILES = ("making", "combining")  # phases that take long the first time


def voice(*, quiet: bool, verbose: bool, json: bool) -> Voice:
    """Return how to speak; raise if several are asked for.

    Args:
        quiet: of errors only.
        verbose: of every detail.
        json: to programs.
    """
    voices: dict[Voice, bool] = {"quiet": quiet, "verbose": verbose, "json": json}
    given: list[Voice] = [name for name, chosen in voices.items() if chosen]
    if len(given) > 1:
        options = " and ".join(f"--{name}" for name in given)
        raise ValueError(f"{options}: expected one of them")
    return given[0] if given else "sentences"


class Teller:
    """Shows on a terminal what is waited for, and says what was done.

    Progress goes to standard error, and only to a terminal; all else but failures goes
    to standard output.
    """

    def __init__(self, voice: Voice, count: int):
        """Show nothing yet.

        Args:
            voice: how to speak.
            count: frames; of several, the time left is shown.
        """
        self._voice, self._seconds, self._label = voice, {}, ""
        self._frame, self._several, self._start = "", count > 1, time.perf_counter()
        several = (
            "{n_fmt} of {total_fmt} frames done, {elapsed}, {remaining} left: {desc}"
        )
        shown = several if count > 1 else "{elapsed} {desc}"
        self._bar = tqdm(
            total=count, bar_format=shown, leave=False, disable=self._hidden
        )
        self._known: set[str] = set()
        self._ended = threading.Event()

    @property
    def _hidden(self) -> bool | None:
        """As tqdm takes it: None for where there is no terminal."""
        return True if self._voice == "quiet" else None

    def __enter__(self) -> "Teller":
        if not self._bar.disable:
            threading.Thread(target=self._tick, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._bar.close()

    def _tick(self) -> None:
        """Let the time go on while something is compiled."""
        while not self._ended.wait(1.0):
            self._bar.refresh()

    @contextlib.contextmanager
    def frame(self, name: str) -> Iterator[None]:
        """Count what is done within as one frame.

        Args:
            name: of its file.
        """
        self._frame, self._seconds, self._label = name, {}, ""
        yield
        self._stop()
        self._bar.update()

    def begin(self, label: str) -> None:
        """Show what is waited for from now on, and take its time.

        Args:
            label: the phase, and after a space what of it.
        """
        self._stop()
        self._label, self._start = label, time.perf_counter()
        shown = f"{self._frame}: {label}" if self._several else label
        if label.startswith(_COMPILES) and label not in self._known:
            shown += " (compiled the first time)"
        self._known.add(label)
        self._bar.set_description_str(shown)

    def _stop(self) -> None:
        """End the present phase."""
        if self._label:
            passed = time.perf_counter() - self._start
            self._seconds[self._label] = self._seconds.get(self._label, 0.0) + passed
        self._label = ""

    def each(self, items: Iterable[Item], count: int, unit: str) -> Iterator[Item]:
        """Yield items, and show how many are left.

        Args:
            items: to yield.
            count: of them.
            unit: what one is.
        """
        hidden = self._hidden
        yield from tqdm(items, total=count, unit=unit, leave=False, disable=hidden)

    def say(self, *lines: str) -> None:
        """Print lines, unless they are not wanted.

        Args:
            lines: for the user.
        """
        if self._voice in ("sentences", "verbose"):
            for line in lines:
                tqdm.write(line, file=sys.stdout)

    def say_more(self, line: str) -> None:
        """Print a line where every detail is wanted.

        Args:
            line: for the user.
        """
        if self._voice == "verbose":
            self.say(line)

    def say_seconds(self) -> None:
        """Print what each phase of the frame took, where every detail is wanted."""
        self._stop()
        took = (f"{label} {passed:.2f}" for label, passed in self._seconds.items())
        self.say_more(f"seconds: {'; '.join(took)}")

    def give(self, **found: Any) -> None:
        """Print what is known of a frame as one line of JSON, where that is wanted.

        Args:
            found: strings, numbers, lists and dictionaries of them.
        """
        if self._voice != "json":
            return
        self._stop()
        seconds: dict[str, float] = {}
        for label, passed in self._seconds.items():
            phase = label.partition(" ")[0]
            seconds[phase] = round(seconds.get(phase, 0.0) + passed, 4)
        line = json.dumps({**found, "seconds": seconds}, allow_nan=False)
        tqdm.write(line, file=sys.stdout)
        sys.stdout.flush()

    def fail(self, frame: str, target: str, why: str) -> None:
        """Say once why a frame of several failed.

        Args:
            frame: its file.
            target: the file that is not written.
            why: in one line.
        """
        if self._voice == "json":
            self.give(frame=frame, out=target, status="failed", error=why)
        else:
            tqdm.write(f"{frame}: {why}", file=sys.stderr)


def sentence(made: methods.Combined, reason: str) -> str:
    """Return what a tier did and why.

    Args:
        made: by the tier.
        reason: why not another tier; may be empty.
    """
    if made.error is not None:
        _, mean, deviation = made.error
        error = _rounded(float(mean), float(deviation))
        said = [f"ensemble of {len(made.bases)} estimates"]
        said += [f"estimated relative L2 {error} at median luminance 1"]
    else:
        (name,) = made.bases
        said = [f"multi-scale with {name}" if made.tier == "fast" else f"{name} alone"]
    if reason:
        said.append(reason)
    why: dict[str, list[str]] = {}
    for name, lacking in made.skipped.items():
        why.setdefault(lacking, []).append(name)
    said += [f"{', '.join(names)} skipped: {each}" for each, names in why.items()]
    return f"{made.tier}: {'; '.join(said)}"


def _rounded(mean: float, deviation: float) -> str:
    """An estimate, with the digits that its standard error leaves."""
    if not (math.isfinite(deviation) and deviation > 1e-6):
        return f"{mean:.2g} ± {deviation:.1g}"
    digits = max(0, -math.floor(math.log10(deviation)))
    return f"{mean:.{digits}f} ± {deviation:.{digits}f}"


def summary(made: methods.Combined) -> dict[str, Any]:
    """Return the estimated error of what a tier made, at median luminance 1, for JSON.

    Args:
        made: by the tier.
    """
    if made.error is None:
        return {"estimated_relative_l2": None}
    _, mean, deviation = made.error
    found = {"mean": as_json(mean), "standard_error": as_json(deviation)}
    return {"estimated_relative_l2": found}


def as_json(value: Any) -> float | None:
    """Return a number as JSON has it; None if it is not finite.

    Args:
        value: of shape [].
    """
    found = float(value)
    return found if math.isfinite(found) else None
