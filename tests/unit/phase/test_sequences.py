"""The named fringe sequences are the thesis's, and every one that is to be unwrapped can be."""

from __future__ import annotations

import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.phase.sequences import SEQUENCES, named_sequence
from sms_jobs.metrology.phase.unwrapping_plan import unwrapping_plan
from sms_jobs.records.measurement import LARGEST_STEPS, FringeSequence


@pytest.mark.parametrize(
    ("name", "densities"),
    [
        ("reverse-exponential-32", (32, 31, 30, 28, 24, 16)),  # thesis Fig. 10
        ("forward-exponential-32", (1, 2, 4, 8, 16, 32)),  # thesis Fig. 10
        ("linear-4", (1, 2, 3, 4)),
        ("fdr-4", (0, 1, 2, 3)),  # thesis section 7.2.2
        ("multi-frequency-8", (1, 8)),
        ("multi-frequency-16", (1, 4, 16)),
        ("multi-frequency-64", (1, 8, 64)),
    ],
)
def test_a_name_means_what_the_thesis_says(name: str, densities: tuple[int, ...]) -> None:
    assert named_sequence(name) == densities


@pytest.mark.parametrize("kind", SEQUENCES)
@pytest.mark.parametrize("fringes", [2, 3, 5, 16, 50, 64, 100])
def test_every_sequence_ends_where_it_says_and_can_be_unwrapped(kind: str, fringes: int) -> None:
    densities = named_sequence(f"{kind}-{fringes}")
    assert max(densities) == (fringes - 1 if kind == "fdr" else fringes)
    assert len(set(densities)) == len(densities)
    plan = unwrapping_plan(tuple(t for t in densities if t))
    # With ratios of at most 8 (and rounding) a step's error stays below nine phase errors, far from pi.
    assert plan.amplification < 9.5


@pytest.mark.parametrize(
    "name", ["", "fdr", "fdr-0", "fdr-1", "fdr-1000", "FDR-8", "gray-code-8", "linear--8"]
)
def test_other_names_are_refused(name: str) -> None:
    with pytest.raises(InvalidInput, match="reverse-exponential-S"):
        named_sequence(name)


def test_phase_steps_are_limited() -> None:
    FringeSequence((16,), LARGEST_STEPS)
    with pytest.raises(InvalidInput, match="4096 phase steps at most, not 2147483647"):
        FringeSequence((16,), 2**31 - 1)
