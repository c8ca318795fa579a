"""A panel too long for one position of the rig, measured from two: aligned by its texture, and combined."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sms_jobs.errors import InvalidInput, MeasurementFailed
from sms_jobs.kinds.deformation import align, combine, correlate, merge, strain
from sms_jobs.kinds.kind import CALIBRATION, Inputs
from sms_jobs.kinds.recording import simulate
from sms_jobs.kinds.shape import reconstruct
from sms_jobs.metrology.deformation.joining.common_frame import vertex_normals
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.transforms import compose, inverse, rotation_vector, transform
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.scene import Plane
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.testing.in_memory import InMemory
from sms_jobs.testing.shelf import Shelf
from sms_jobs.virtual_rig.campaigns import placed, small_plate
from sms_jobs.virtual_rig.deformations import carried_points, packed_chain

VIEW = "C1P1"
RADIUS = 8
CHOSEN = align.AlignParameters(views=("right",), subset_radius_px=RADIUS)


def position(name: str, rotation_rad: Any, shift_mm: float, seed: int) -> tuple[Calibration, Campaign]:
    """Return a campaign on a plate of 260 mm, of which the camera sees 180 mm."""
    calibration, campaign = small_plate(name)
    assert campaign.scene is not None
    scene = replace(
        campaign.scene,
        surface=Plane(260.0, 150.0),
        placement=placed(rotation_rad, (shift_mm, -2.0, 3.0)),
        seed=seed,
    )
    return calibration, replace(campaign, scene=scene, views=(VIEW,))


def shelf_of(made: tuple[Calibration, Campaign], records: dict[Any, Any], states: tuple[str, ...]) -> Shelf:
    calibration, campaign = made
    shelf = Shelf(campaign, 1, records)
    for label in states:
        subject = Subject(campaign.name, label, VIEW)
        records[CALIBRATION, subject] = {"calibration": calibration}
        shelf.run(simulate.KIND, Subject(campaign.name, label), simulate.KIND.parameters())
        shelf.run(reconstruct.KIND, subject, reconstruct.KIND.parameters())
    return shelf


@pytest.fixture(scope="module")
def views() -> tuple[Shelf, Shelf]:
    """Return two positions of the rig 50 mm apart, the second turned a little besides; stretched, merged."""
    records: dict[Any, Any] = {}
    made = (position("left", (0.05, -0.03, 0.04), 26.0, 1), position("right", (0.07, 0.02, 0.08), -24.0, 2))
    shelves = tuple(shelf_of(one, records, ("S00", "S01")) for one in made)
    for shelf in shelves:
        subject = Subject(shelf.campaign.name, "S01", VIEW)
        shelf.run(correlate.KIND, subject, correlate.KIND.parameters())
        shelf.run(strain.KIND, subject, strain.KIND.parameters())
        shelf.run(merge.KIND, Subject(shelf.campaign.name, "S01"), merge.KIND.parameters())
    shelves[0].run(align.KIND, Subject("left"), CHOSEN)
    return shelves[0], shelves[1]


def true_pose(views: tuple[Shelf, Shelf]) -> Pose:
    left, right = (shelf.campaign.scene for shelf in views)
    assert left is not None
    assert right is not None
    return compose(left.placement, inverse(right.placement))


def test_the_alignment_is_the_true_one_within_its_covariance(views: tuple[Shelf, Shelf]) -> None:
    found = views[0].records["align", Subject("left")]["view_1"]
    off = compose(Pose(found.rotation, found.translation_mm), inverse(true_pose(views)))
    error = np.r_[rotation_vector(off.matrix()), off.translation]
    # Chi-square of 6 is below 22.5 in 999 of 1000.
    assert error @ np.linalg.solve(found.covariance, error) < 22.5
    # 20 um of noise in a point, averaged over 5 pi 16 / 9 = 28 pixels in both views, and some of the match.
    assert 0.003 < found.rms_mm < 0.015
    # The median of 30 lengths is known to about 8 %; three of those.
    assert found.scale < 1.25
    assert found.points >= 24
    assert found.used_fraction > 0.9
    assert found.place.shape == found.residual.shape == (found.points, 3)


def test_the_result_does_not_depend_on_threads(views: tuple[Shelf, Shelf]) -> None:
    left = replace(views[0], threads=2, records=dict(views[0].records))
    left.run(align.KIND, Subject("left"), CHOSEN)
    one, two = (shelf.records["align", Subject("left")]["view_1"] for shelf in (views[0], left))
    assert one.rotation == two.rotation
    assert one.translation_mm == two.translation_mm


def combined(views: tuple[Shelf, Shelf]) -> Any:
    shelf = replace(views[0], records=dict(views[0].records))
    shelf.run(combine.KIND, Subject("left", "S01"), combine.CombineParameters(views=("right",)))
    return shelf.records["combine", Subject("left", "S01")]["mesh"]


def area(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def test_the_combined_surface_is_that_of_both_and_the_overlap_is_there_once(
    views: tuple[Shelf, Shelf],
) -> None:
    mesh = combined(views)
    each = [shelf.records["merge", Subject(shelf.campaign.name, "S01")]["mesh"] for shelf in views]
    scene = views[0].campaign.scene
    assert scene is not None
    pose = true_pose(views)
    material = [
        transform(inverse(scene.placement), vertices)
        for vertices in (mesh.vertices, each[0].vertices, transform(pose, each[1].vertices))
    ]
    both = [material[1], material[2]]
    # What is seen of the plate is a rectangle but for the slant of the image's sides, some mm.
    height = np.ptp(material[0][:, 1])
    union = max(m[:, 0].max() for m in both) - min(m[:, 0].min() for m in both)
    assert np.ptp(material[0][:, 0]) == pytest.approx(union, abs=0.2)
    doubled = sum(area(one.vertices, one.faces) for one in each)
    found = area(mesh.vertices, mesh.faces)
    assert found < 0.8 * doubled
    # Slanted sides and the seam of a pixel, 1.4 mm, along the height.
    assert found == pytest.approx(union * height, rel=0.08)
    assert (vertex_normals(mesh.vertices, mesh.faces)[:, 2] > 0.9).all()


def test_the_combined_fields_are_true_within_their_sigma(views: tuple[Shelf, Shelf]) -> None:
    mesh = combined(views)
    values = dict(zip(mesh.value_names, mesh.values, strict=True))
    scene, state = views[0].campaign.scene, views[0].campaign.states[1]
    assert scene is not None
    at_rest = transform(inverse(scene.placement), mesh.vertices)
    at_rest[:, 2] = 0.0
    truth = carried_points(packed_chain(state.deformation, scene.placement), at_rest) - transform(
        scene.placement, at_rest
    )
    error = np.stack([values[f"displacement {axis}"] for axis in "XYZ"], axis=1) - truth
    squared = np.sum(error**2, axis=1)
    for view in (0, 1):
        own = values["view"] == view
        assert own.sum() > 500
        stated = np.mean(values["sigma of displacement"][own] ** 2)
        # The project's limits, 0.8 .. 1.2; the noise of a vertex moves its true displacement by 0.5 % of it.
        assert 0.8 < np.sqrt(stated / squared[own].mean()) < 1.2
        # 8 x 5 independent gauges of 20 mm in a view, at a sigma of 150 microstrain: 25, four times.
        along = np.nanmean(values["strain xx"][own])
        assert along == pytest.approx(0.005 + 0.005**2 / 2, abs=1e-4)


def test_the_views_differ_by_what_is_stated(views: tuple[Shelf, Shelf]) -> None:
    left = views[0]
    parameters = combine.CombineParameters(views=("right",))
    subject = Subject("left", "S01")
    datasets = {
        need.role: InMemory(need.subject, left.records[need.source, need.subject])
        for need in combine.KIND.checked_needs(left.campaign, subject, parameters)
    }
    (output,) = combine.KIND.run(
        Inputs(subject, None, datasets), parameters, lambda fraction, message="": None
    )
    told = output.statistics  # type: ignore[union-attr]
    ratio = told["difference_rms_mm_0_1"] / told["stated_difference_mm_0_1"]
    # As the displacement of each, which is stated to 20 %.
    assert 0.8 < ratio < 1.25
    assert told["overlap_vertices_0_1"] > 1000


@pytest.mark.parametrize("scale", [1.0, 1.01])
def test_a_calibration_of_another_scale_is_told(views: tuple[Shelf, Shelf], scale: float) -> None:
    left, at_rest = views[0], Subject("right", "S00", VIEW)
    surface = left.records["reconstruct", at_rest]["surface"]
    grown = replace(surface, position=scale * surface.position)
    records = {
        **left.records,
        ("reconstruct", at_rest): {**left.records["reconstruct", at_rest], "surface": grown},
    }
    # The next one is right, and is aligned after it.
    for source in ("measurement", "reconstruct"):
        records[source, Subject("after", "S00", VIEW)] = left.records[source, at_rest]
    subject, said = Subject("left"), []
    chosen = align.AlignParameters(views=("right", "after"), subset_radius_px=RADIUS)
    datasets = {
        need.role: InMemory(need.subject, records[need.source, need.subject])
        for need in align.KIND.checked_needs(left.campaign, subject, chosen)
    }
    inputs = Inputs(subject, align.KIND.context(left.campaign, subject), datasets)
    list(align.KIND.run(inputs, chosen, lambda fraction, message="": said.append(message)))
    assert ("note: the points of right miss those here by" in said[-1]) == (scale > 1.0)
    assert ("times what is stated: lengths there are 1.0100 of those here" in said[-1]) == (scale > 1.0)


def test_a_camera_that_sees_nothing_of_the_overlap_does_no_harm(views: tuple[Shelf, Shelf]) -> None:
    # A second camera with its back to the overlap: the same frames, of which no pixel is trusted.
    records = dict(views[0].records)
    for name in ("left", "right"):
        at_rest = Subject(name, "S00", VIEW)
        for source in ("measurement", "reconstruct"):
            records[source, Subject(name, "S00", "C9P1")] = records[source, at_rest]
        blind = dict(records["reconstruct", at_rest])
        blind["surface"] = replace(blind["surface"], reason=np.ones_like(blind["surface"].reason))
        records["reconstruct", Subject(name, "S00", "C9P1")] = blind
    campaign = replace(views[0].campaign, views=("C9P1", VIEW))
    both = replace(views[0], campaign=campaign, records=records)
    both.run(align.KIND, Subject("left"), CHOSEN)
    one, two = (shelf.records["align", Subject("left")]["view_1"] for shelf in (views[0], both))
    assert one.points == two.points
    np.testing.assert_array_equal(one.residual, two.residual)


@contextmanager
def refused(kind: type[Exception], words: str) -> Iterator[None]:
    with pytest.raises(kind, match=words):
        yield


def test_views_that_have_nothing_in_common_are_refused(views: tuple[Shelf, Shelf]) -> None:
    made = position("other", (0.05, -0.03, 0.04), 0.0, 3)
    scene = made[1].scene
    assert scene is not None
    assert scene.speckle is not None
    other = replace(scene, speckle=replace(scene.speckle, seed=99))
    records = dict(views[0].records)
    shelf_of((made[0], replace(made[1], scene=other)), records, ("S00",))
    left = replace(views[0], records=records)
    with refused(MeasurementFailed, "fewer than 4 sub-images"):
        left.run(align.KIND, Subject("left"), align.AlignParameters(views=("other",)))
    with refused(InvalidInput, "cannot be aligned with itself"):
        left.run(align.KIND, Subject("left"), align.AlignParameters(views=("left",)))
    records["merge", Subject("other", "S01")] = records["merge", Subject("left", "S01")]
    with refused(InvalidInput, "other is not aligned with left, only right"):
        left.run(combine.KIND, Subject("left", "S01"), combine.CombineParameters(views=("other",)))


def test_views_are_named_once_and_in_any_way() -> None:
    assert align.AlignParameters(views="one, two three").views == ("one", "two", "three")  # type: ignore[arg-type]
    for wrong, words in (("", "at least 1"), ("one one", "twice"), ("../one", "cannot be the name")):
        with pytest.raises(ValueError, match=words):
            align.AlignParameters(views=wrong)  # type: ignore[arg-type]
