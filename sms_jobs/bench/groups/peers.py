"""The same work by others: CPU time of other programs over ours, on one thread, in turn."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import cv2
import numpy as np
from numpy.typing import NDArray

from sms_jobs.bench.baselines import matched_by_opencv, unwrapped_by_numpy
from sms_jobs.bench.correlated.speckle_pairs import speckle_pair
from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.bench.fringes.returns import rms, wrapped
from sms_jobs.bench.groups.phase import REVERSE_EXPONENTIAL, STEPS, fringe_frames, unwrap_frames
from sms_jobs.bench.peers import NO_PEERS, Ratio, Timed, in_turn, missing_peers, peers_folder, started, timed
from sms_jobs.bench.roofline import Peak, Work, matching_work
from sms_jobs.errors import SmsError
from sms_jobs.metrology.arrays import Floats, Ints, Mask
from sms_jobs.metrology.deformation.matching.correlation import (
    CONVERGED,
    Matches,
    MatchSettings,
    Noise,
    PreparedImages,
    match_points,
    prepare_images,
)
from sms_jobs.metrology.deformation.matching.grid import GridSettings, match_grid
from sms_jobs.metrology.deformation.matching.seeding import SearchSettings
from sms_jobs.metrology.images.spline import Interpolant

_ROWS, _COLUMNS = 512, 1024
_SIZE, _RIM, _SPACING, _RADIUS = 512, 41, 5, 16
_NOISE, _CONTRAST = 10.0, 300.0  # grey levels
_STRETCH, _SHIFT_X, _SHIFT_Y = 0.002, 0.2, 0.3
_SEARCH_PX = 16
_PRECISION = 1e-3
_WHOLE = "from images in memory to displacements"
_SAMPLE = 40  # every so many-th point goes to what is slow
_ECC_ROUNDS, _ECC_GAIN = 20, 1e-6
_ARRAYS = 9  # that a subset needs in every iteration
_PEAK_ELEMENTS, _PEAK_COPIES, _ROOF_ROUNDS = 1 << 20, 20_000, 15


@dataclass(frozen=True)
class Pair:
    """A pair of images and the points that are matched in it.

    Attributes
    ----------
    images
        (2, rows, columns).
    x, y
        (n,), the grid of points, in px.
    truth
        (n, 2), their displacement in px.
    """

    images: NDArray[np.uint16]
    x: Ints
    y: Ints
    truth: Floats

    def prepared(self, interpolant: Interpolant = "quintic") -> PreparedImages:
        """Return the images ready to be matched, as one region."""
        noise = Noise(_NOISE * _NOISE, 0.0)
        regions = np.ones(self.images.shape[1:], np.int32)
        return prepare_images(self.images[0], self.images[1], regions, (noise, noise), interpolant)

    def matched(self, interpolant: Interpolant = "quintic") -> Matches:
        """Match all points from no displacement, from images to displacements, on one thread."""
        settings = MatchSettings(_RADIUS)
        return match_points(self.prepared(interpolant), self.x, self.y, np.zeros((len(self.x), 6)), settings)

    def followed(self) -> Matches:
        """Match the grid by seeds, from neighbour to neighbour, with outliers removed, on one thread."""
        search = SearchSettings(range_x=_SEARCH_PX, range_y=_SEARCH_PX)
        grid, settings = GridSettings(spacing=_SPACING), MatchSettings(_RADIUS)
        return match_grid(self.prepared(), self.images[1], settings, grid, search).matches

    def told(self, program: str, displacement: Floats, converged: Mask) -> str:
        """Return in words how many of some points converged, and the rms error of u and v."""
        error = (displacement - self.truth)[converged]
        return f"{program} {np.count_nonzero(converged)} of {len(converged)}, {rms(error):.5f} px"


def speckles(size: int, spacing: int) -> Pair:
    """Return a noisy pair stretched along x, in 12 bits, and a grid of points that all programs share."""
    middle = size // 2

    def field(x: Floats, y: Floats) -> tuple[Floats, Floats]:
        return _STRETCH * (x - middle) + _SHIFT_X, np.full_like(y, _SHIFT_Y)

    random = np.random.default_rng(2)
    exact = np.stack(speckle_pair(size, field, 1, _CONTRAST))
    noisy = np.rint(exact + random.normal(0.0, _NOISE, exact.shape))
    images = np.clip(noisy, 0.0, 4095.0).astype(np.uint16)
    along = np.arange(_RIM, size - _RIM + 1, spacing)
    x, y = (a.ravel() for a in np.meshgrid(along, along))
    truth = np.stack(field(x.astype(np.float64), y.astype(np.float64)), axis=1)
    return Pair(images, x, y, truth)


def warm_up() -> None:
    """Compile what is timed."""
    unwrap_frames(fringe_frames(2, 16)[1])
    pair = speckles(96, 4)
    pair.matched()
    pair.matched("cubic")
    pair.followed()
    peak = Peak.of(16, 16, 1)
    peak.calculate()
    peak.copy()


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions."""
    folder = peers_folder()
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield from _decoding(run, folder)
        yield from _matching(run, folder)
    finally:
        cv2.setNumThreads(threads)


def _left_out(name: str, target: float | None, why: str) -> Iterator[Found]:
    yield Figure(name, None, "1", target)
    yield Condition(name, f"left out: {why}")


def _beside(
    folder: Path | None, names: dict[str, float | None], compare: Callable[[Path], Iterator[Found]]
) -> Iterator[Found]:
    """Yield what a comparison with others finds; the figures named without a value where they are missing."""
    why = NO_PEERS
    if folder is not None:
        try:
            found = list(compare(folder))
        except SmsError as error:
            why = str(error)
        else:
            yield from found
            return
    for name, target in names.items():
        yield from _left_out(name, target, why)


def _decoding(run: Run, folder: Path | None) -> Iterator[Found]:
    rows = _ROWS // (8 if run.quick else 1)
    run.say("peers: decoding fringes, with NumPy")
    truth, frames = zip(*(fringe_frames(rows, _COLUMNS, seed) for seed in (1, 2)), strict=True)

    def ours() -> list[Floats]:
        return [unwrap_frames(stack).omega for stack in frames]

    def numpy() -> list[Floats]:
        return [unwrapped_by_numpy(stack, REVERSE_EXPONENTIAL, STEPS)[0] for stack in frames]

    here = timed(ours)
    (ratio,) = in_turn(here, [timed(numpy)])
    yield ratio.figure("decode_over_numpy")
    yield Condition(
        "decode_over_numpy",
        f"{ratio.told()}; {_shown_frames(rows)}; a few lines of NumPy in single precision: wrapped phases, "
        "fringe orders by differences, weighted slope, modulation and residual, without the standard "
        f"deviations, saturation and flags that ours gives; rms error of the phase gradient, the worst "
        f"thousandth left out: ours {_error(ours(), truth):.2e}, NumPy {_error(numpy(), truth):.2e} rad",
    )

    def compare(peers: Path) -> Iterator[Found]:
        run.say("peers: decoding fringes, with fringes")
        where = run.folder / "decoding"
        where.mkdir()
        np.save(where / "frames.npy", np.concatenate(frames))
        case = {"densities": REVERSE_EXPONENTIAL, "steps": STEPS, "directions": len(frames)}
        (where / "case.json").write_text(json.dumps(case), encoding="utf-8")
        with (
            started(peers, where, "decode_fringes.py", "verbose") as verbose,
            started(peers, where, "decode_fringes.py") as plain,
        ):
            whole, less = in_turn(here, [verbose, plain])
        omega = list(np.load(where / "fringes.npz")["omega"])
        yield whole.figure("decode_over_fringes", 20.0)
        yield less.figure("decode_over_fringes_plain")
        yield Condition(
            "decode_over_fringes",
            f"{whole.told()}, without residual {less.told()}; {_shown_frames(rows)}; both give position, "
            "modulation, brightness and residual, fringes also wrapped phases and fringe orders of every "
            "density, ours a standard deviation from the noise, saturation and flags; without residual "
            "fringes gives position, modulation and brightness alone and ours the same as before; rms error "
            f"of the phase gradient, the worst thousandth left out: ours {_error(ours(), truth):.2e}, "
            f"fringes {_error(omega, truth):.2e} rad",
        )

    yield from _beside(folder, {"decode_over_fringes": 20.0, "decode_over_fringes_plain": None}, compare)


def _shown_frames(rows: int) -> str:
    densities = ", ".join(map(str, REVERSE_EXPONENTIAL))
    return (
        f"two directions, fringes {densities}, {STEPS} steps, {_COLUMNS} x {rows} px, uint16 frames in "
        f"memory, B / sigma = 50, one thread"
    )


def _error(found: list[Floats], truth: tuple[Floats, ...]) -> float:
    """Return the rms error in rad of all but the worst thousandth, which are wrong fringe orders."""
    error = np.abs(wrapped(np.stack(found) - np.stack(truth))).ravel()
    return rms(np.sort(error)[: int(0.999 * error.size)])


def _matching(run: Run, folder: Path | None) -> Iterator[Found]:
    pair = speckles(_SIZE // (2 if run.quick else 1), _SPACING)
    here = timed(pair.matched)
    yield from _ecc(run, pair)
    yield from _roofline(run, pair)

    def prepare(name: str) -> Path:
        where = run.folder / name
        where.mkdir()
        np.save(where / "pair.npy", pair.images)
        np.save(where / "points.npy", np.stack([pair.x, pair.y], axis=1))
        case = {
            "rim_px": _RIM,
            "radius_px": _RADIUS,
            "spacing_px": _SPACING,
            "search_px": _SEARCH_PX,
            "tolerance_px": MatchSettings().tolerance,
            "precision": _PRECISION,
        }
        (where / "case.json").write_text(json.dumps(case), encoding="utf-8")
        return where

    yield from _beside(
        folder,
        {"icgn1_over_pyvale": 6.0, "icgn1_cubic_over_pyvale": None, "grid_over_pyvale": None},
        lambda peers: _pyvale(run, pair, here, peers, prepare("pyvale")),
    )
    yield from _beside(
        folder,
        {"icgn1_over_al_dic": None},
        lambda peers: _al_dic(run, pair, here, peers, prepare("al_dic")),
    )


def _ours(pair: Pair) -> str:
    found = pair.matched()
    return pair.told("ours", found.warp[:, [0, 3]], found.ending == CONVERGED)


def _shown_pair(pair: Pair) -> str:
    return (
        f"the same {len(pair.x)} points, {_SPACING} px apart, subsets of {2 * _RADIUS + 1} px, affine, "
        f"{pair.images.shape[1]} px images of 12 bits, stretched by {_STRETCH:.1%}, noise of "
        f"{_NOISE / _CONTRAST:.1%} of the contrast, one thread"
    )


def _pyvale(run: Run, pair: Pair, here: Timed, peers: Path, where: Path) -> Iterator[Found]:
    run.say("peers: matching, with pyvale")
    scans = ("RASTER", "MULTIWINDOW_RG")
    with ExitStack() as stack:
        alone, guided = [stack.enter_context(started(peers, where, "match_pyvale.py", s)) for s in scans]
        (quintic,) = in_turn(here, [alone])
        (cubic,) = in_turn(timed(lambda: pair.matched("cubic")), [alone])
        (grid,) = in_turn(timed(pair.followed), [guided])
    told = []
    for scan in scans:
        found = np.load(where / f"pyvale-{scan}.npz")
        if not (np.array_equal(found["x"], pair.x) and np.array_equal(found["y"], pair.y)):
            raise SmsError(
                "pyvale matched other points than ours: see which grid its version makes of a mask"
            )
        name = f"{scan} ({found['iterations'].mean():.1f} iterations)"
        told.append(pair.told(name, found["displacement"], found["converged"]))
    iterations = float(pair.matched().iterations.mean())
    yield quintic.figure("icgn1_over_pyvale", 6.0)
    yield cubic.figure("icgn1_cubic_over_pyvale")
    yield grid.figure("grid_over_pyvale")
    yield Condition(
        "icgn1_over_pyvale",
        f"{quintic.told()}, with our cubic spline {cubic.told()}; {_shown_pair(pair)}; {_WHOLE}; "
        "every point from no displacement (pyvale: RASTER, ZNSSD, cubic spline, no blur); ours to "
        f"{MatchSettings().tolerance:g} px in {iterations:.1f} iterations with a quintic spline, pyvale to "
        f"{_PRECISION:g} of its unknowns, of about half a px; converged and rms error: {_ours(pair)}; "
        f"{'; '.join(told)}",
    )
    followed = pair.followed()
    part = float((followed.ending == CONVERGED).mean())
    yield Condition(
        "grid_over_pyvale",
        f"{grid.told()}, of whole times; as programs are used: seeds and then from neighbour to neighbour "
        f"(pyvale: MULTIWINDOW_RG), search of {_SEARCH_PX} px; ours matches {len(followed.ending)} points up "
        f"to the image's border, {part:.2%} of them found, and takes outliers out; pyvale {len(pair.x)}",
    )


def _al_dic(run: Run, pair: Pair, here: Timed, peers: Path, where: Path) -> Iterator[Found]:
    run.say("peers: matching, with al-dic")
    with started(peers, where, "match_al_dic.py") as theirs:
        (ratio,) = in_turn(here, [theirs])
    found = np.load(where / "al_dic.npz")
    yield ratio.figure("icgn1_over_al_dic")
    yield Condition(
        "icgn1_over_al_dic",
        f"{ratio.told()}; {_shown_pair(pair)}; {_WHOLE}; its local IC-GN of six unknowns (local_icgn, "
        f"cubic through 4 x 4 pixels), from no displacement, its own criterion at "
        f"{MatchSettings().tolerance:g}, {found['iterations'].mean():.1f} iterations; converged and rms "
        f"error: {_ours(pair)}; {pair.told('al-dic', found['displacement'], found['converged'])}",
    )


def _ecc(run: Run, pair: Pair) -> Iterator[Found]:
    run.say("peers: matching, with OpenCV")
    some = np.s_[::_SAMPLE]
    few = Pair(pair.images, pair.x[some], pair.y[some], pair.truth[some])

    def match() -> Floats:
        return matched_by_opencv(few.images, few.x, few.y, _RADIUS, _ECC_ROUNDS, _ECC_GAIN)

    images = pair.prepared()
    guess = np.zeros((len(pair.x), 6))
    here = timed(lambda: match_points(images, pair.x, pair.y, guess, MatchSettings(_RADIUS)))
    (of_few,) = in_turn(here, [timed(match)])
    # They match fewer points than we do.
    ratio = Ratio(tuple(one * len(pair.x) / len(few.x) for one in of_few.rounds))
    found = match()
    yield ratio.figure("icgn1_over_opencv_ecc")
    yield Condition(
        "icgn1_over_opencv_ecc",
        f"{ratio.told()}; time a point, images prepared: {len(few.x)} of the points by OpenCV's "
        f"findTransformECC, a call each, affine, linear interpolation, up to {_ECC_ROUNDS} iterations or a "
        f"gain of {_ECC_GAIN:g}, from no displacement; {_shown_pair(pair)}; converged and rms error: "
        f"{_ours(pair)}; "
        f"{few.told('OpenCV', found, np.isfinite(found[:, 0]))}",
    )


def _roofline(run: Run, pair: Pair) -> Iterator[Found]:
    run.say("peers: what the processor could do at most")
    whole = (2 * _RADIUS + 1) ** 2
    peak = Peak.of(_PEAK_ELEMENTS, _ARRAYS * whole // 2, _PEAK_COPIES)
    images, guess = pair.prepared(), np.zeros((len(pair.x), 6))

    def match() -> Matches:
        return match_points(images, pair.x, pair.y, guess, MatchSettings(_RADIUS))

    asked = matching_work(float(whole * len(pair.x)), float(match().iterations.mean()))
    by_operations, by_bytes = in_turn(timed(match), [timed(peak.calculate), timed(peak.copy)], _ROOF_ROUNDS)
    could = Work(asked.operations / peak.work.operations, asked.moved / peak.work.moved)
    operations = [could.operations * one for one in by_operations.rounds]
    moved = [could.moved * one for one in by_bytes.rounds]
    share = Ratio(tuple(max(pair_of) for pair_of in zip(operations, moved, strict=True)))
    yield share.figure("icgn_roofline_share", 0.4)
    per_point = len(pair.x)
    yield Condition(
        "icgn_roofline_share",
        f"{share.told()}; the least time that {asked.operations / per_point:.3g} operations and "
        f"{asked.moved / per_point:.3g} bytes a point take over the time taken: {median(operations):.2f} by "
        "the peak of fused multiplications and additions in double precision, "
        f"{median(moved):.2f} by the bandwidth of a copy within the cache of {_ARRAYS} arrays of a subset, "
        f"both measured in turn with matching; counted in bench/roofline.py; {_shown_pair(pair)}, images "
        "prepared",
    )


GROUP = Group(
    "peers",
    "CPU time of other programs over ours, on the same input in turn",
    warm_up,
    measure,
    missing_peers,
)
