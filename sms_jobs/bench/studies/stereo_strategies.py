"""Three ways to the end of a displacement that two cameras see, against exact truth.

Where the reference camera sees a point of the first state later is known by matching its texture in time.
Where the partner sees it then may be told by the shape of that state, by following the partner's own texture,
or by matching the partner's image with that of the reference camera in the first state.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.bench.study import Outcome, Study, Table, new_figure
from sms_jobs.kinds.deformation import correlate
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT
from sms_jobs.kinds.point_matches import trusted_points
from sms_jobs.kinds.shape import stereo
from sms_jobs.kinds.shape.textures import white_texture
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.deformation.fields.displacement import blend_matches
from sms_jobs.metrology.deformation.matching.correlation import (
    NOT_CONVERGED,
    MatchSettings,
    Noise,
    PreparedImages,
    match_points,
    prepare_images,
)
from sms_jobs.metrology.deformation.matching.grid import GridMatches, GridSettings, is_sure, match_grid
from sms_jobs.metrology.deformation.matching.sampling import sample_nodes
from sms_jobs.metrology.deformation.matching.seeding import SearchSettings
from sms_jobs.metrology.deformation.matching.shape_functions import ShapeOrder
from sms_jobs.metrology.deformation.matching.verification import verify_displacement
from sms_jobs.metrology.geometry.camera import Camera, pixel_grid, project
from sms_jobs.metrology.geometry.planes import in_space, pixels_as_plane
from sms_jobs.metrology.geometry.several_cameras import meet_rays
from sms_jobs.metrology.images.texture_extent import textured_pixels
from sms_jobs.records.fields import Surface
from sms_jobs.records.reasons import Reason
from sms_jobs.records.scene import Deformation, Rigid, UniaxialStrain
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.testing.shelf import Shelf
from sms_jobs.virtual_rig.campaigns import Made
from sms_jobs.virtual_rig.stereo_campaigns import curved, stereo_campaign, stereo_rig

COLUMNS = 640
WAYS = ("each state", "own reference", "left reference")
_RADIUS, _SPACING, _RANGE_PX, _SMOOTHING_PX, _MARGIN_PX = 12, 5, 60, 0.6, 5
_GRID = GridSettings(_SPACING, maximum_sigma=0.1)
_OFF_SIGMAS = 3.0  # of a match, by which images may ask for another place
_STILL = (0.0, 0.0, 0.0)
_MICRO = 1e3

Motions: TypeAlias = Callable[[float], dict[str, tuple[Deformation, ...]]]
"""What is done to a specimen, by name, if a pixel is so large on it, in mm."""


def motions(px_mm: float) -> dict[str, tuple[Deformation, ...]]:
    """Return what is done to the specimen, by name; `px_mm` is the size of a pixel on it."""
    return {
        "shift by 0.3 px": (Rigid(_STILL, (0.3 * px_mm, 0.1 * px_mm, 0.2 * px_mm)),),
        "shift by 25 px": (Rigid(_STILL, (25.0 * px_mm, -10.0 * px_mm, 10.0 * px_mm)),),
        "turn by 8 degrees in its plane": (Rigid((0.0, 0.0, 0.14), _STILL),),
        "tilt by 8 degrees": (Rigid((0.0, 0.14, 0.0), _STILL),),
        "tilt by 15 degrees": (Rigid((0.0, 0.26, 0.0), _STILL),),
        "stretch by 5 %": (UniaxialStrain(0.05, 0.33),),
    }


@dataclass(frozen=True)
class _State:
    """What both cameras saw of a state, with its noise, and its surface."""

    textures: tuple[NDArray[np.floating], ...]
    noise: tuple[Noise, ...]
    surface: Surface


@dataclass(frozen=True)
class Judged:
    """Rms, median, 99.9th percentile and mean of errors in um where all ways have a value; valid part."""

    rms: float
    median: float
    tail: float
    bias: float
    valid: float


def specimen(columns: int, chosen: Motions) -> Made:
    """Return a campaign of a cylinder before two cameras, one state for each motion."""
    rig = stereo_rig(columns, columns * 4 // 5)
    field_mm = 500.0 * columns / rig.sensor("C1").intrinsics.fx
    done = tuple(chosen(field_mm / columns).values())
    return stereo_campaign("strategies", rig=rig, surface=curved(field_mm), deformations=done)


def _measured(shelf: Shelf, calibration: Calibration, subject: Subject) -> _State:
    """Record a state and measure its shape."""
    shelf.records[CALIBRATION, subject] = {"calibration": calibration}
    shelf.record(subject)
    shelf.run(stereo.KIND, subject, stereo.KIND.parameters())
    surface: Surface = shelf.records["stereo", subject]["surface"]
    everywhere = np.ones(surface.reason.shape, dtype=bool)
    seen = [
        white_texture(shelf.records[MEASUREMENT, own]["measurement"], _SMOOTHING_PX, everywhere)
        for own in subject.recordings
    ]
    return _State(tuple(texture for texture, _ in seen), tuple(noise for _, noise in seen), surface)


def _spread(images: PreparedImages, found: GridMatches, order: ShapeOrder) -> Floats:
    """Return matches at every pixel, (2, rows, columns) in px; NaN where the images object."""
    plane = in_space(pixels_as_plane(images.labels.shape))
    shift, variance = blend_matches(trusted_points(found, images.labels), plane, images.labels, _RADIUS)
    verified = verify_displacement(images, shift, _RADIUS, order, _SMOOTHING_PX)
    off = (verified.bias > _OFF_SIGMAS**2 * variance).any(axis=0)
    shift[:, off | ~verified.agrees] = np.nan
    return shift


def _as_seen(camera: Camera, points: Floats) -> Floats:
    """Return where a camera sees points (3, rows, columns), (2, rows, columns) in px."""
    place = np.full((2, *points.shape[1:]), np.nan)
    known = np.isfinite(points[0])
    place[:, known] = project(camera.intrinsics, camera.pose, np.ascontiguousarray(points[:, known].T)).T
    return place


def _followed(first: _State, last: _State, start: Floats) -> Floats:
    """Return where the partner sees points later by its own texture; `start` is where it did, in px."""
    texture, noise = first.textures[1], first.noise[1]
    level = noise.floor + noise.slope * texture
    labels = np.asarray(textured_pixels(texture, level, _RADIUS, _MARGIN_PX), dtype=np.int32)
    images = prepare_images(texture, last.textures[1], labels, (noise, last.noise[1]))
    search = SearchSettings(_RANGE_PX, _RANGE_PX)
    found = match_grid(images, last.textures[1], MatchSettings(_RADIUS, 0.3), _GRID, search)
    moved = _spread(images, found, 1)
    known = np.isfinite(start[0])
    end = np.full_like(start, np.nan)
    for axis in range(2):
        at = start[1][known], start[0][known]
        there = ndimage.map_coordinates(moved[axis], at, order=1, cval=np.nan)
        end[axis][known] = start[axis][known] + there
    return end


def _against_left(first: _State, last: _State, guess: Floats) -> Floats:
    """Return where the partner sees points later by the reference camera's first image."""
    labels = (first.surface.reason == Reason.VALID).astype(np.int32)
    pixels = np.moveaxis(pixel_grid(*labels.shape), -1, 0)
    shift = guess - pixels
    across, down = np.gradient(shift, axis=2), np.gradient(shift, axis=1)
    nodes = sample_nodes(labels, _SPACING)
    parts = (field[axis] for axis in range(2) for field in (shift, across, down))
    start = np.stack([part[nodes.y, nodes.x] for part in parts], axis=1)
    known = np.isfinite(start).all(axis=1)
    x, y = nodes.x[known].copy(), nodes.y[known].copy()
    noise = first.noise[0], last.noise[1]
    images = prepare_images(first.textures[0], last.textures[1], labels, noise)
    matches = match_points(images, x, y, start[known], MatchSettings(_RADIUS, 0.3, shape_order=2))
    matches.ending[~is_sure(matches, _GRID)] = NOT_CONVERGED
    return pixels + _spread(images, GridMatches(x, y, matches), 2)


def compared(
    say: Callable[[str], None], columns: int, chosen: Motions = motions
) -> dict[str, dict[str, Judged]]:
    """Return the errors of displacement by motion and way."""
    calibration, campaign = specimen(columns, chosen)
    shelf = Shelf(campaign, 1)
    cameras = [Camera(s.intrinsics, s.pose, s.columns, s.rows) for s in calibration.rig.sensors]
    at_rest = Subject(campaign.name, "S00", "C1C2")
    first = _measured(shelf, calibration, at_rest)
    start, position = _as_seen(cameras[1], first.surface.position), first.surface.position
    pixels = np.moveaxis(pixel_grid(*first.surface.reason.shape), -1, 0)
    search = correlate.KIND.parameters(
        subset_radius_px=_RADIUS, search_range_x_px=_RANGE_PX, search_range_y_px=_RANGE_PX
    )
    found: dict[str, dict[str, Judged]] = {}
    for number, name in enumerate(chosen(1.0), start=1):
        say(name)
        subject = replace(at_rest, state=f"S{number:02d}")
        last = _measured(shelf, calibration, subject)
        shelf.run(correlate.KIND, subject, search)
        field = shelf.records["correlate", subject]["displacement"]
        own = (pixels + field.image_displacement).reshape(2, -1)
        ends = (
            _followed(first, last, start),
            _against_left(first, last, _as_seen(cameras[1], position + field.displacement)),
        )
        moved = [field.displacement]
        for end in ends:
            met = meet_rays(cameras[0], [cameras[1]], own, end.reshape(1, 2, -1), np.ones((1, *own.shape)))
            moved.append(met.xyz.reshape(position.shape) - position)
        truth = shelf.truth(subject)
        visible = truth.shape.seen & truth.shape.lit & truth.lit_and_seen_at_end
        errors = [np.where(visible, one - truth.displacement, np.nan) for one in moved]
        found[name] = dict(zip(WAYS, _judged(errors, int(visible.sum())), strict=True))
    return found


def _judged(errors: list[Floats], visible: int) -> list[Judged]:
    """Return what errors (3, rows, columns) of each way come to, in um, where all ways have a value."""
    common = np.isfinite(errors).all(axis=(0, 1))
    told = []
    for error in errors:
        own = _MICRO * error[:, common]
        length = np.linalg.norm(own, axis=0)
        told.append(
            Judged(
                float(np.sqrt(np.mean(length**2))),
                float(np.median(length)),
                float(np.quantile(length, 0.999)),
                float(np.linalg.norm(own.mean(axis=1))),
                float(np.isfinite(error[0]).sum() / visible),
            )
        )
    return told


def run(say: Callable[[str], None]) -> Outcome:
    """Move, turn, tilt and stretch a cylinder before two cameras."""
    found = compared(say, COLUMNS)
    figure = new_figure(9.5, 4.2)
    axes = figure.subplots()
    for number, way in enumerate(WAYS):
        place = np.arange(len(found)) + 0.27 * (number - 1)
        axes.bar(place, [each[way].rms for each in found.values()], 0.25, label=way)
    axes.set_xticks(
        np.arange(len(found)), [name.replace(" by ", "\n", 1) for name in found], fontsize="small"
    )
    axes.set_ylabel("rms error of displacement [um]")
    axes.legend(fontsize="small")
    figures = ("rms, um", "median, um", "99.9 %, um", "bias, um", "valid part")
    rows = [
        (name, way, *(round(value, 4) for value in vars(one).values()))
        for name, each in found.items()
        for way, one in each.items()
    ]
    remarks = {
        "conditions": f"cylinder, two cameras of {COLUMNS} x {COLUMNS * 4 // 5} px at 20 degrees and 500 mm, "
        f"12 bit, subsets of {2 * _RADIUS + 1} px, of second order between cameras and of first in time; "
        "errors where all three have a value, valid parts of what both cameras see in both states",
        "each state": "cameras matched with each other at every state: what correlate does",
        "own reference": "each camera's texture followed from its own first image",
        "left reference": "the partner's image matched with the reference camera's first image",
    }
    return Outcome(Table(("motion", "way", *figures), rows, remarks), figure)


STUDY = Study(
    "stereo-strategies", "where the partner of a camera sees a point later: three ways compared", run
)
