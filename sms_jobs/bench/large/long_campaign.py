"""A long test of which the report is made: sealed results of real size, as the pipeline makes them.

Sealing a gigabyte for each of 300 states would take the disk of most computers, so a few results are sealed,
and every state reads one of them: opened, compared with its checks and unpacked as any other, then multiplied
by the state's own load. No two states have the same values, and all have their noise.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy.ndimage import uniform_filter

import sms_jobs
from sms_jobs.archive import Archive, FolderStore, Provenance
from sms_jobs.archive.dataset import ArchivedDataset
from sms_jobs.bench.peak_memory import peak_rss_mb
from sms_jobs.errors import SmsError
from sms_jobs.kinds.documents import DocumentOutput
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT, Inputs, Kind
from sms_jobs.kinds.products import CALIBRATED, MEASURED, MERGED, REGIONS, STRAIN, SURFACE
from sms_jobs.kinds.reporting import report
from sms_jobs.kinds.surface_ports import maker_of
from sms_jobs.metrology.arrays import Floats, Mask, Singles
from sms_jobs.metrology.deformation.strain.tangent_plane import principal_and_equivalent
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.records.campaign import Campaign, LoadState, Specimen
from sms_jobs.records.fields import MergedField, Region, Regions, StrainField, Surface
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Box, Calibration, Rig, Sensor
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import Role
from sms_jobs.testing.in_memory import unheard

VIEW = "C1C2"
SEALED = 4
"""How many results differ in their noise."""
SUBSET_PX, GAUGE_PX = 21, 61
"""Sides of the squares over which errors of displacement and of strain go together."""
MM_PER_PX = 0.125
_LISTED = "sealed.json"
_AT = datetime(2026, 1, 1, tzinfo=UTC)
_SIGMA_MM, _SIGMA_Z_MM, _SIGMA_STRAIN = 0.001, 0.003, 20e-6
_STRETCH = 2000e-6
_SPREAD = 0.3  # of standard deviations about their middle, as texture varies
_OTHER_LOADS = 0.02

R = TypeVar("R")


@dataclass(frozen=True)
class _AtLoad:
    """A sealed result, as if it were that of a state whose load is `factor` times as large."""

    sealed: ArchivedDataset
    about: Subject
    factor: float

    @property
    def subject(self) -> Subject:
        """What it is about."""
        return self.about

    @property
    def names(self) -> tuple[str, ...]:
        """Of its records."""
        return self.sealed.names

    @property
    def path(self) -> str:
        """Of the sealed file."""
        return self.sealed.path

    @property
    def content_hash(self) -> str:
        """Of the sealed file."""
        return self.sealed.content_hash

    @property
    def provenance(self) -> Provenance:
        """Of the sealed file, but for the state."""
        return replace(self.sealed.provenance, subject=self.about)

    def read(self, name: str, record: type[R]) -> R:
        """Return one record at this load."""
        found: Any = self.sealed.read(name, record)
        if isinstance(found, MergedField):
            return replace(found, displacement=self.factor * found.displacement)  # type: ignore[return-value]
        if isinstance(found, StrainField):
            strained = {n: self.factor * getattr(found, n) for n in ("strain", "principal", "von_mises")}
            return replace(found, **strained)  # type: ignore[return-value]
        return found  # type: ignore[no-any-return]


def long_test(states: int) -> Campaign:
    """Return a test of so many deformed states beside the reference, seen by two cameras."""
    loads = tuple(LoadState(f"S{place:03}", load_n=10.0 * place) for place in range(states + 1))
    return Campaign("long", Specimen("panel with a hole"), "stereo", loads, (VIEW,))


def seal(folder: Path, campaign: Campaign, size: tuple[int, int]) -> None:
    """Seal results over images of (rows, columns) in an archive in a folder, and list them beside it."""
    archive, random, surface = (
        Archive(FolderStore(folder / "archive")),
        np.random.default_rng(300),
        _surface(size),
    )
    found: dict[str, list[str]] = {}

    def keep(kind: str, records: Mapping[str, Any]) -> None:
        made = found.setdefault(kind, [])
        subject = Subject(campaign.name, f"{kind}{len(made)}", VIEW)
        origin = Provenance(
            kind, 1, subject, "0" * 32, 1, _AT, {}, (), sms_jobs.__version__, "bench", "bench"
        )
        made.append(archive.seal_dataset(records, origin).path)

    keep(CALIBRATION, {CALIBRATED.stored_as: _calibration(size)})
    keep(MEASUREMENT, {MEASURED.stored_as: _measurement(random, size)})
    keep(maker_of(VIEW).kind, {SURFACE.stored_as: surface})
    labels = (surface.reason == Reason.VALID).astype(np.int32)
    regions = Regions((Region(1, int(labels.sum()), (size[1] / 2, size[0] / 2)),), labels)
    keep("correlate", {REGIONS.stored_as: regions})
    for _ in range(SEALED):
        keep("merge", {MERGED.of("C1").stored_as: _merged(random, surface)})
        keep("strain", {STRAIN.stored_as: _strain(random, surface)})
    (folder / _LISTED).write_text(json.dumps(found), encoding="utf-8")


@contextmanager
def inputs_of(folder: Path, kind: Kind[Any], campaign: Campaign, parameters: Any) -> Iterator[Inputs]:
    """Open what was sealed in a folder: what a job about the campaign would be given."""
    archive, subject = Archive(FolderStore(folder / "archive")), Subject(campaign.name)
    listed: dict[str, list[str]] = json.loads((folder / _LISTED).read_text(encoding="utf-8"))
    order = {state.label: place for place, state in enumerate(campaign.states)}
    with ExitStack() as until:
        opened = {
            source: [until.enter_context(archive.open_unrecorded(path)) for path in paths]
            for source, paths in listed.items()
        }
        datasets = {}
        for need in kind.checked_needs(campaign, subject, parameters):
            place, several = order.get(need.subject.state or "", 0), opened[need.source]
            load = place / len(order) * (1.0 + _OTHER_LOADS * np.sin(place))
            datasets[need.role] = _AtLoad(several[place % len(several)], need.subject, float(load))
        yield Inputs(subject, kind.context(campaign, subject), datasets)


@dataclass(frozen=True)
class Taken:
    """What writing a report took, in a process of its own."""

    page: str
    cpu_s: float
    peak_rss_mb: float


def measure(folder: Path, states: int) -> Taken:
    """Write the report of a test whose results are sealed in a folder; return what that took."""
    command = [sys.executable, "-P", "-m", __name__, str(folder), str(states)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        reason = done.stderr.strip().splitlines()[-1:] or ["no message"]
        raise SmsError(f"the report of the long test failed: {reason[0]}")
    return Taken(**json.loads(done.stdout.splitlines()[-1]))


def main(folder: Path, states: int) -> None:
    """Write the report with its usual parameters into the folder; print what that took."""
    started = time.process_time()
    parameters = report.KIND.parameters()
    with inputs_of(folder, report.KIND, long_test(states), parameters) as inputs:
        (page,) = report.KIND.run(inputs, parameters, unheard)
        assert isinstance(page, DocumentOutput)
        path = folder / page.filename
        page.write(path)
    sys.stdout.write(json.dumps(vars(Taken(str(path), time.process_time() - started, peak_rss_mb()))) + "\n")


def _grid(size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Return x and y in mm of every pixel, from the middle."""
    row, column = np.mgrid[0 : size[0], 0 : size[1]].astype(np.float64)
    return MM_PER_PX * (column - size[1] / 2), MM_PER_PX * (row - size[0] / 2)


def _calibration(size: tuple[int, int]) -> Calibration:
    pose = Pose(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.0, 0.0, 500.0))
    lens = Intrinsics(4000.0, 4000.0, size[1] / 2, size[0] / 2)
    cameras = tuple(Sensor(name, Role.CAMERA, size[1], size[0], lens, pose) for name in ("C1", "C2"))
    half = MM_PER_PX * max(size) / 2
    return Calibration(Rig("stereo", cameras), Box((-half, -half, -50.0), (half, half, 50.0)), _AT, "exact")


def _measurement(random: np.random.Generator, size: tuple[int, int]) -> Measurement:
    speckle = uniform_filter(random.standard_normal(size), 4) > 0.0
    texture = (900.0 + 1800.0 * speckle + random.normal(0.0, 20.0, size)).astype(np.uint16)
    return Measurement(_AT, FringeSequence(), 4095, 0.1, 2.0, texture, ArrayStack(texture[None]))


def _surface(size: tuple[int, int]) -> Surface:
    """Return a curved panel with a hole, in a frame of nothing."""
    x, y = _grid(size)
    half = MM_PER_PX * min(size) / 2
    away = (
        (np.hypot(x, y) < 0.2 * half)
        | (np.abs(x) > 0.95 * half * size[1] / size[0])
        | (np.abs(y) > 0.95 * half)
    )
    reason = np.where(away, np.uint32(Reason.NO_TEXTURE), np.uint32(0)).astype(np.uint32)
    position = np.stack([x, -y, 20.0 * np.cos(x / (2.0 * half))])
    position[:, away] = np.nan
    return Surface(VIEW, "mm", position, reason, _covariance(np.ones(size), away), None, None, SUBSET_PX // 2)


def _covariance(spread: Floats, away: Mask) -> Singles:
    packed = np.zeros((6, *spread.shape), np.float32)
    packed[0] = packed[3] = (_SIGMA_MM * spread) ** 2
    packed[5] = (_SIGMA_Z_MM * spread) ** 2
    packed[:, away] = np.nan
    return packed


def _noise(random: np.random.Generator, size: tuple[int, int], side: int) -> Floats:
    """Return noise of deviation 1 that goes together over squares of `side` px."""
    # The mean of side^2 independent numbers.
    return np.asarray(side * uniform_filter(random.standard_normal(size), side))


def _merged(random: np.random.Generator, surface: Surface) -> MergedField:
    size, away = surface.reason.shape, surface.reason != Reason.VALID
    spread = np.exp(_SPREAD * _noise(random, size, SUBSET_PX))
    x, y, _ = surface.position
    scale = np.nanmax(np.abs(x))
    moved = np.stack(
        [_STRETCH * x, -0.3 * _STRETCH * y, 0.5 * np.cos(2.0 * x / scale) * np.cos(3.0 * y / scale)]
    )
    for place, sigma in enumerate((_SIGMA_MM, _SIGMA_MM, _SIGMA_Z_MM)):
        moved[place] += sigma * spread * _noise(random, size, SUBSET_PX)
    contributors = (~away).astype(np.uint8)
    return MergedField(
        "C1",
        (VIEW,),
        "mm",
        np.nan,
        moved,
        surface.position,
        _covariance(spread, away),
        contributors,
        surface.reason,
        np.full(size, np.nan, np.float32),
    )


def _strain(random: np.random.Generator, surface: Surface) -> StrainField:
    """Return the strain about a hole in a plate, as of Kirsch along its middle, with noise."""
    size, away = surface.reason.shape, surface.reason != Reason.VALID
    x, y, _ = surface.position
    radius = 0.2 * MM_PER_PX * min(size) / 2
    near = (radius / np.hypot(x, y)) ** 2
    xx = _STRETCH * (1.0 + 0.5 * near + 1.5 * near**2)
    sigma = _SIGMA_STRAIN * np.exp(_SPREAD * _noise(random, size, GAUGE_PX))
    strain = np.stack([xx, -0.3 * xx, 0.2 * near * _STRETCH * np.sin(2.0 * np.arctan2(y, x))])
    for component in strain:
        component += sigma * _noise(random, size, GAUGE_PX)
    principal, equivalent = principal_and_equivalent(strain)
    sigmas = np.where(away, np.nan, np.stack([sigma] * 3)).astype(np.float32)
    length = GAUGE_PX * MM_PER_PX
    return StrainField("small", "mm", length, strain, sigmas, principal, equivalent, surface.reason)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
