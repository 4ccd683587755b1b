"""The work done so far, on disk, so that no pass is rendered twice."""

import dataclasses
import hashlib
import json
import os
import pathlib
import time
import zipfile

import numpy as np

from jscomb.rendering._passes import Moments
from jscomb.rendering._scenes import mitsuba
from jscomb.rendering._settings import Settings

SAVE_EVERY = 20.0  # seconds between two saves


class Partial:
    """The moments so far of one scene and its settings; kept nowhere without a path."""

    def __init__(self, path: pathlib.Path | None, scene: str, settings: Settings):
        self.path = path
        fields = dataclasses.asdict(settings)
        fields |= {"scene": scene, "variant": mitsuba().variant()}
        if os.path.isfile(scene):
            text = pathlib.Path(scene).read_bytes()
            fields["scene"] = hashlib.sha256(text).hexdigest()
        self.key = json.dumps(fields, sort_keys=True)
        self.saved = time.monotonic()

    def load(self) -> tuple[int, dict[str, Moments]]:
        """Passes done and their moments; none where there is no file."""
        if self.path is None or not self.path.exists():
            return 0, {}
        try:
            with np.load(self.path) as data:
                stored = {name: data[name] for name in data.files}
            key, done = str(stored.pop("key")), int(stored.pop("done"))
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise ValueError(f"{self.path}: not a partial render: {error}") from None
        if key != self.key:
            raise ValueError(
                f"{self.path} is of another scene or other settings: remove it or "
                "choose another file"
            )
        names = {name.rpartition(".")[0] for name in stored}
        return done, {
            name: Moments(*(stored[f"{name}.{f}"] for f in Moments._fields))
            for name in names
        }

    def save(self, done: int, moments: dict[str, Moments], *, last: bool) -> None:
        """Write now and then, and always after the last pass; atomically."""
        now = time.monotonic()
        if self.path is None or (not last and now - self.saved < SAVE_EVERY):
            return
        arrays = {
            f"{name}.{field}": value
            for name, each in moments.items()
            for field, value in each._asdict().items()
        }
        temporary = self.path.with_suffix(".tmp.npz")
        np.savez(temporary, key=self.key, done=done, **arrays)  # type: ignore[arg-type]
        os.replace(temporary, self.path)
        self.saved = now
