"""How other programs are timed beside ours, and what stands in for them where they are missing."""

from __future__ import annotations

import sys
from math import pi
from pathlib import Path

import numpy as np
import pytest

from sms_jobs.bench import peers as programs
from sms_jobs.bench.baselines import matched_by_opencv, unwrapped_by_numpy
from sms_jobs.bench.figures import Condition, Figure, Run
from sms_jobs.bench.fringes.returns import wrapped
from sms_jobs.bench.groups import peers
from sms_jobs.bench.groups.phase import REVERSE_EXPONENTIAL, STEPS, fringe_frames
from sms_jobs.bench.peers import PEERS, SCRIPTS, Ratio, in_turn, started
from sms_jobs.bench.roofline import Peak, matching_work
from sms_jobs.errors import SmsError


def test_both_are_measured_in_turn() -> None:
    order: list[str] = []

    def timed(name: str, seconds: list[float]) -> programs.Timed:
        def work() -> float:
            order.append(name)
            return seconds.pop(0)

        return work

    found = in_turn(timed("ours", [1.0, 2.0]), [timed("a", [4.0, 4.0]), timed("b", [9.0, 2.0])], 2)

    assert order == ["ours", "a", "b", "ours", "a", "b"]
    assert found == [Ratio((4.0, 2.0)), Ratio((9.0, 1.0))]
    assert found[0].figure("x_over_a", 3.5) == Figure("x_over_a", 3.0, "1", 3.5)
    assert found[1].told() == "median of 2 rounds, 1 to 9"


@pytest.fixture
def environment() -> Path:
    """Return an environment that has none of the programs: this one."""
    return Path(sys.prefix)


def test_a_script_answers_each_time_it_is_asked(
    environment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scripts = tmp_path / "scripts"
    scripts.mkdir()
    (scripts / "rounds.py").symlink_to(SCRIPTS / "rounds.py")
    (scripts / "one.py").write_text(
        "import sys\nfrom rounds import answer\n"
        "def work():\n    print('cpu busy')\n    open(sys.argv[1], 'a').write('x')\n    sum(range(100000))\n"
        "answer(work)\n",
        encoding="utf-8",
    )
    monkeypatch.setattr(programs, "SCRIPTS", scripts)

    with started(environment, tmp_path, "one.py", "count") as measured:
        assert (tmp_path / "count").read_text(encoding="utf-8") == "x"
        times = [measured(), measured()]

    assert min(times) > 0.0
    assert (tmp_path / "count").read_text(encoding="utf-8") == "xxx"


def test_a_program_that_is_not_there_is_said(environment: Path, tmp_path: Path) -> None:
    with (
        pytest.raises(SmsError, match=r"decode_fringes.py failed: ModuleNotFoundError: .*fringes"),
        started(environment, tmp_path, "decode_fringes.py"),
    ):
        pass


@pytest.mark.parametrize("named", [True, False])
def test_figures_of_missing_programs_are_absent_with_their_reason(
    named: bool, environment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if named:
        monkeypatch.setenv(PEERS, str(environment))
    else:
        monkeypatch.delenv(PEERS, raising=False)
    monkeypatch.setattr(peers, "_ROWS", 64)
    monkeypatch.setattr(peers, "_SIZE", 256)
    monkeypatch.setattr(peers, "_SAMPLE", 400)
    monkeypatch.setattr(peers, "_PEAK_COPIES", 200)
    monkeypatch.setattr(peers, "_PEAK_ELEMENTS", 1 << 14)

    found = list(peers.measure(Run(True, lambda words: None, 1, tmp_path)))

    figures = {one.name: one for one in found if isinstance(one, Figure)}
    told = {one.topic: one.text for one in found if isinstance(one, Condition)}
    assert figures["decode_over_numpy"].value is not None
    assert figures["icgn1_over_opencv_ecc"].value is not None
    assert 0.0 < (figures["icgn_roofline_share"].value or 0.0) < 1.0
    for name, target in (
        ("decode_over_fringes", 20.0),
        ("icgn1_over_pyvale", 6.0),
        ("icgn1_over_al_dic", None),
    ):
        assert figures[name] == Figure(name, None, "1", target)
        assert ("ModuleNotFoundError" if named else PEERS) in told[name]
        assert told[name].startswith("left out: ")


def test_plain_numpy_finds_what_we_find() -> None:
    omega, frames = fringe_frames(16, 128)

    slope, modulation, residual = unwrapped_by_numpy(frames, REVERSE_EXPONENTIAL, STEPS)

    error = np.abs(wrapped(slope - omega))
    # B / sigma = 50: a phase has 0.02 sqrt(2 / 4) rad, the slope that over sqrt(sum t^2) = 67.
    least = 0.02 / np.sqrt(2.0) / np.sqrt(np.sum(np.square(REVERSE_EXPONENTIAL)))
    assert np.median(error) == pytest.approx(0.6745 * least, rel=0.1)
    assert np.mean(error > pi / 32) < 0.001
    assert np.median(modulation) == pytest.approx(1000.0, rel=0.01)
    assert np.median(residual) == pytest.approx(0.02 / np.sqrt(2.0), rel=0.3)


def test_opencv_finds_a_displacement() -> None:
    pair = peers.speckles(128, 20)

    found = matched_by_opencv(pair.images, pair.x, pair.y, 16, 20, 1e-6)

    assert np.isfinite(found).all()
    assert np.abs(found - pair.truth).max() < 0.1
    assert np.abs(pair.matched().warp[:, [0, 3]] - pair.truth).max() < 0.02


def test_the_work_of_matching_is_counted_as_its_loops_are_written() -> None:
    once, each = matching_work(1.0, 0.0), matching_work(1.0, 1.0)

    # Operations of the statements in the loops over pixels, by hand; of a quintic, weights of one axis.
    weights = 4 + (4 * 2 + 1) + 5 * 2 + 3 * 2 + 5 * 2 + 5
    taps = 6 * (6 + 5) + 6 + 5 + 1
    assert each.operations - once.operations == 2 * weights + taps + 2 * 4 + 2 + 17
    assert once.operations == 3 * 12 + 2 * 11 + 7
    assert each.moved > once.moved > 0.0


def test_the_peak_does_what_it_is_counted_for() -> None:
    peak = Peak.of(8, 8, 3)
    peak.calculate()
    peak.copy()

    def chain(a: float, v: float) -> float:
        for added in [0.1 * tenths for tenths in range(1, 18) if tenths != 10]:
            a = a * v + added
        return a

    assert peak.work.operations == 8 * 8 * 16 * 2
    wanted = [sum(chain(v + 0.1 * k, v) for k in range(1, 9)) for v in peak.values.tolist()]
    assert peak.out == pytest.approx(wanted)
    assert peak.target == pytest.approx(peak.source + 2.0)
