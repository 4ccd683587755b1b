"""What becomes of damaged, hostile and unusual EXR files, and of writes that fail?

Every file of the corpus (`tests.exr_corpus`) is read in another process with little
memory and little time, so that crashes, hangs and believed claims are seen. Good are
the right image, one clear error, or another image where the file has no checksum that
covers the change; all else is bad.
"""

import dataclasses

from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from tests.exr_corpus import attack


@dataclasses.dataclass(frozen=True)
class Config(attack.Config, Options):
    """Limits of the attempts."""


def run(config: Config) -> attack.Table:
    """Attempt everything.

    Args:
        config: the limits.

    Returns:
        counts of outcomes by kind of file.
    """
    return attack.run(config)


def report(found: attack.Table) -> Report:
    """Say what was found.

    Args:
        found: by `attack.run`.

    Returns:
        outcomes by kind of file.
    """
    some = [o for o in attack.BAD if any(counts[o] for counts in found.values())]
    shown = [*attack.GOOD, *some]
    total = sum(counts.total() for counts in found.values())
    rows = [
        [kind, *(counts[o] or None for o in shown)] for kind, counts in found.items()
    ]
    silent = sum(counts["no checksum"] for counts in found.values())
    answer = (
        f"{attack.bad(found)} of {total} attempts end badly; {silent} times a foreign "
        "file without a checksum is read as another image."
    )
    return Report(answer, table(["file", *shown], rows))


if __name__ == "__main__":
    main(Config, run, report)
