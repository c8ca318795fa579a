"""How long the virtual rig takes; the target is 10 s on two cores for 48 frames of a megapixel."""

from __future__ import annotations

from typing import Any

import numpy as np

from sms_jobs.records.scene import Simulation
from sms_jobs.virtual_rig.campaigns import top_hat_bending
from sms_jobs.virtual_rig.rendering import render
from sms_jobs.virtual_rig.truth import exact_truth


def full_top_hat(state: int) -> Simulation:
    campaign = top_hat_bending("bench", "full")[1]
    assert campaign.scene is not None
    load = campaign.states[state]
    return Simulation(campaign.scene, "C1", "P1", load.deformation, load.label)


def test_a_megapixel_of_48_frames(benchmark: Any) -> None:
    sequence = top_hat_bending("bench", "full")[1].sequence

    def record() -> int:
        frames = render(full_top_hat(2), sequence, threads=2).frames
        return sum(int(np.max(frames.frame(i))) for i in range(sequence.frames))

    assert benchmark.pedantic(record, rounds=3, warmup_rounds=1) > 0


def test_truth_of_a_megapixel(benchmark: Any) -> None:
    truth = benchmark.pedantic(
        exact_truth, (full_top_hat(0), full_top_hat(2)), {"threads": 2}, rounds=3, warmup_rounds=1
    )
    assert truth.shape.seen.any()
