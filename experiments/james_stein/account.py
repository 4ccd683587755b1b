"""What of the neural James-Stein combiner is here, and what was measured?"""

from experiments.common.claims import Claim
from experiments.common.claims import account as report
from experiments.common.command import Options, main

CLAIMS = (
    Claim(
        "eq. 9",
        "upper bound of the combined image's risk",
        where=("james_stein.risk_bound",),
    ),
)


def run(options: Options) -> tuple[Claim, ...]:
    """Return all claims.

    Args:
        options: of no effect.

    Returns:
        the claims.
    """
    del options
    return CLAIMS


if __name__ == "__main__":
    main(Options, run, report)
