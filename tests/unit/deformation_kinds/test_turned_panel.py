"""A panel turned by five degrees about its normal: the frame found on it, and strain along it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sms_jobs.app.specimens.frame_choice import Choice, Place
from sms_jobs.app.specimens.frame_finding import Finder
from sms_jobs.app.specimens.specimen_axes import in_specimen_frame
from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.calibration_factors import known_view
from sms_jobs.kinds.deformation import correlate, gauges, merge, strain
from sms_jobs.metrology.calibration.point_factor import point_factor
from sms_jobs.metrology.geometry.camera import project
from sms_jobs.metrology.geometry.specimen_frame import frame_through
from sms_jobs.metrology.geometry.transforms import compose, rotation_vector, transform
from sms_jobs.records.fields import Surface
from sms_jobs.records.specimen_frame import SpecimenFrame
from sms_jobs.records.subject import Subject
from sms_jobs.testing.shelf import Shelf, reconstructed
from sms_jobs.virtual_rig.campaigns import placed, small_plate

VIEW = "C1P1"
TURN_RAD = float(np.radians(5.0))
AT_REST, DEFORMED = Subject("turned", "S00", VIEW), Subject("turned", "S01", VIEW)


@pytest.fixture(scope="module")
def shelf() -> Shelf:
    """Return the small plate, turned in its plane, at rest and stretched; correlated, and nobody's frame."""
    calibration, campaign = small_plate("turned")
    assert campaign.scene is not None
    turned = compose(campaign.scene.placement, placed((0.0, 0.0, TURN_RAD), (0.0, 0.0, 0.0)))
    scene = replace(campaign.scene, placement=turned)
    found, _ = reconstructed(
        calibration, replace(campaign, scene=scene, views=(VIEW,)), lambda words: None, 1
    )
    found.run(correlate.KIND, DEFORMED, correlate.KIND.parameters())
    return found


def true_frame(shelf: Shelf) -> np.ndarray:
    assert shelf.campaign.scene is not None
    return shelf.campaign.scene.placement.matrix()


def seen_at(shelf: Shelf, *place: float) -> Place:
    """Return the pixel at which the camera sees a place of the specimen."""
    scene = shelf.campaign.scene
    assert scene is not None
    camera = scene.rig.sensor("C1")
    x, y = project(camera.intrinsics, camera.pose, transform(scene.placement, np.array(place)))
    return (float(x), float(y))


def at_rest(shelf: Shelf) -> Surface:
    surface = shelf.records["reconstruct", AT_REST]["surface"]
    assert isinstance(surface, Surface)
    return surface


def picked(shelf: Shelf) -> Choice:
    places = [seen_at(shelf, *p) for p in ((0.0, 0.0, 0.0), (55.0, 0.0, 0.0), (5.0, -50.0, 0.0))]
    return Choice(origin=places[0], x=places[1], plane=places[2])


def found_by(shelf: Shelf, choice: Choice) -> SpecimenFrame:
    return Finder(at_rest(shelf), None, None, choice).frame("0" * 64)


def with_frame(shelf: Shelf, frame: SpecimenFrame | None) -> Shelf:
    """Return the same results of a campaign as on a real rig, whose scene nobody knows."""
    return replace(
        shelf, campaign=replace(shelf.campaign, scene=None, frame=frame), records=dict(shelf.records)
    )


@pytest.mark.parametrize("method", ["points", "plane"])
def test_the_frame_is_the_true_one_within_its_deviations(shelf: Shelf, method: str) -> None:
    choice = picked(shelf)
    if method == "plane":
        corner = [seen_at(shelf, sign * -60.0, sign * 60.0, 0.0) for sign in (1.0, -1.0)]
        region = "rectangle " + " ".join(f"{value:g}" for pixel in corner for value in pixel)
        choice = replace(choice, plane=None, region=region)
    found = found_by(shelf, choice)
    assert found.method == method
    assert found.deviation is not None
    turn = rotation_vector(true_frame(shelf).T @ found.placement.matrix())
    # Required: 0.1 degrees. The shape's noise of 20 um, a ninth of it at a place, is 0.003 over 55 mm.
    assert np.abs(turn).max() < np.radians(0.1)
    # The picked pixels are exact here, and half a pixel is stated of them: the errors are smaller, never
    # beyond four deviations.
    assert (np.abs(turn) < 4.0 * np.array(found.deviation.turn_rad)).all()
    # Half a pixel of 1.4 mm at both ends of 55 mm.
    assert found.deviation.turn_rad[2] == pytest.approx(0.5 * 1.4 * np.sqrt(2.0) / 55.0, rel=0.1)
    assert found.calibration is None


def exactly_moved(shelf: Shelf) -> Shelf:
    """Return the results with the exact shape and displacement in place of the measured ones."""
    truth = shelf.truth(DEFORMED)
    moved, rest = dict(shelf.records["correlate", DEFORMED]), dict(shelf.records["reconstruct", AT_REST])
    field, surface = moved["displacement"], rest["surface"]
    known = np.isfinite(field.displacement)
    moved["displacement"] = replace(field, displacement=np.where(known, truth.displacement, np.nan))
    rest["surface"] = replace(
        surface, position=np.where(np.isfinite(surface.position), truth.shape.xyz, np.nan)
    )
    records = shelf.records | {("correlate", DEFORMED): moved, ("reconstruct", AT_REST): rest}
    return replace(shelf, records=records)


def test_strain_along_the_found_frame_has_the_true_shear(shelf: Shelf) -> None:
    exact, truth = exactly_moved(shelf), shelf.truth(DEFORMED)

    def shear_error(frame: SpecimenFrame | None) -> float:
        own = with_frame(exact, frame)
        own.run(strain.KIND, DEFORMED, strain.KIND.parameters())
        field = own.records["strain", DEFORMED]["strain"]
        error = (field.strain - truth.strain(field.measure))[2]
        return float(np.nanmax(np.abs(error)))

    # The frame is found on the measured shape; required: 20 microstrain, of 6500 between xx and yy.
    assert shear_error(found_by(shelf, picked(shelf))) < 20e-6
    # Along the world's X, 5 degrees and the plate's own 2.3 off: sin(2 x 7.3 degrees) / 2 of 6500.
    assert shear_error(None) == pytest.approx(820e-6, rel=0.05)


def test_gauges_lie_in_the_frame(shelf: Shelf) -> None:
    exact = with_frame(exactly_moved(shelf), found_by(shelf, picked(shelf)))
    parameters = gauges.KIND.parameters(gauge=("G x=10 y=-5 length=20", "T x=10 y=-5 length=20 angle=90"))
    exact.run(gauges.KIND, DEFORMED, parameters)
    along, across = exact.records["gauges", DEFORMED]["gauges"].strain
    # Green-Lagrange of 0.5 % and -0.15 %; 0.1 degrees turn 3e-6 of their difference into them.
    assert along == pytest.approx(0.005 + 0.005**2 / 2, abs=5e-6)
    assert across == pytest.approx(-0.0015 + 0.0015**2 / 2, abs=5e-6)


def test_only_what_lies_along_the_frame_takes_it(shelf: Shelf) -> None:
    one = with_frame(shelf, found_by(shelf, picked(shelf))).campaign
    other = with_frame(shelf, None).campaign
    assert one.placement != other.placement
    for kind in (strain.KIND, gauges.KIND):
        assert kind.along_frame
        assert kind.context(one, DEFORMED) != kind.context(other, DEFORMED)
        # Of a camera alone x is that of its image, whatever the specimen's frame.
        alone = replace(DEFORMED, view="C1")
        assert kind.context(one, alone) == kind.context(other, alone)
    for unmoved in (correlate.KIND, merge.KIND):
        about = DEFORMED if unmoved is correlate.KIND else replace(DEFORMED, view=None)
        assert not unmoved.along_frame
        assert unmoved.context(one, about) == unmoved.context(other, about)


def test_strains_along_different_axes_are_not_merged(shelf: Shelf) -> None:
    own = with_frame(shelf, found_by(shelf, picked(shelf)))
    own.run(strain.KIND, DEFORMED, strain.KIND.parameters())
    second = replace(DEFORMED, view="C1P2")
    for source, state in (("reconstruct", "S00"), ("correlate", "S01"), ("strain", "S01")):
        own.records[source, replace(second, state=state)] = own.records[
            source, replace(DEFORMED, state=state)
        ]
    both = replace(own, campaign=replace(own.campaign, views=(VIEW, "C1P2")))
    both.run(merge.KIND, Subject("turned", "S01"), merge.KIND.parameters())
    mesh = both.records["merge", Subject("turned", "S01")]["mesh"]
    assert mesh.strain_axis == own.campaign.frame.x_axis  # type: ignore[union-attr]
    with_frame(both, None).run(strain.KIND, second, strain.KIND.parameters())
    turned = with_frame(both, None)
    turned.run(strain.KIND, second, strain.KIND.parameters())
    with pytest.raises(InvalidInput, match="C1P1 and C1P2 lie along different axes"):
        turned.run(merge.KIND, Subject("turned", "S01"), merge.KIND.parameters())


def test_shape_and_displacement_are_offered_along_the_frame(shelf: Shelf) -> None:
    own = with_frame(shelf, found_by(shelf, picked(shelf)))
    own.run(strain.KIND, DEFORMED, strain.KIND.parameters())
    own.run(merge.KIND, Subject("turned", "S01"), merge.KIND.parameters())
    campaign = own.campaign
    surface = in_specimen_frame(at_rest(shelf), campaign)
    flat = surface.position[2][np.isfinite(surface.position[2])]
    # A plane at z = 0: 20 um of noise, and 4 um over 75 mm from the frame's own.
    assert np.abs(flat.mean()) < 0.02
    assert flat.std() < 0.06
    moved = own.records["correlate", DEFORMED]["displacement"]
    there = in_specimen_frame(moved, campaign)
    known = np.isfinite(moved.displacement[0])
    np.testing.assert_allclose(
        np.linalg.norm(there.displacement[:, known], axis=0),
        np.linalg.norm(moved.displacement[:, known], axis=0),
        rtol=1e-12,
    )
    # Neither the trace nor the determinant of a covariance knows of a turn; float32 keeps 1e-7 of each part.
    for packed, turned in ((moved.covariance, there.covariance),):
        trace = [one[[0, 3, 5]][:, known].sum(axis=0) for one in (packed, turned)]
        np.testing.assert_allclose(trace[1], trace[0], rtol=1e-5)
    along = true_frame(shelf)[:, 0]
    full = moved.covariance[:, known][:, 0].astype(np.float64)
    c = np.array([[full[0], full[1], full[2]], [full[1], full[3], full[4]], [full[2], full[4], full[5]]])
    # The frame is 0.1 degrees off at most: 0.4 % of the largest variance.
    assert there.covariance[0][known][0] == pytest.approx(along @ c @ along, abs=4e-3 * np.trace(c))
    mesh = in_specimen_frame(own.records["merge", Subject("turned", "S01")]["mesh"], campaign)
    assert mesh.value_names[:3] == ("displacement x", "displacement y", "displacement z")
    # 0.5 % of the length along x, less the middle's shift: the slope over the panel is the strain.
    slope = np.polyfit(mesh.vertices[:, 0], mesh.value("displacement x"), 1)[0]
    # Noise of 30 um a vertex over 150 mm is nothing; the rigid turn of 3 mrad is second order.
    assert slope == pytest.approx(0.005, abs=1e-4)


def test_what_has_no_frame_is_refused(shelf: Shelf) -> None:
    own = with_frame(shelf, None)
    with pytest.raises(InvalidInput, match=r"the specimen's frame of campaign .* is not set"):
        in_specimen_frame(at_rest(shelf), own.campaign)
    own.run(strain.KIND, DEFORMED, strain.KIND.parameters())
    framed = with_frame(shelf, found_by(shelf, picked(shelf))).campaign
    with pytest.raises(InvalidInput, match="degrees off the specimen's x axis"):
        in_specimen_frame(own.records["strain", DEFORMED]["strain"], framed)
    with pytest.raises(InvalidInput, match="has no frame"):
        in_specimen_frame(shelf.records["correlate", DEFORMED]["regions"], framed)


def test_what_the_calibration_adds_is_how_its_errors_turn_the_frame(
    known_plate: Any, rng: np.random.Generator
) -> None:
    measured = known_plate.results["reconstruct", known_plate.subject("S00", VIEW)]
    known = known_view(measured["factor"])
    choice = Choice(origin=(45.0, 62.0), x=(90.0, 60.0), plane=(60.0, 90.0))
    found = Finder(measured["surface"], known, None, choice).frame("0" * 64)
    assert found.calibration is not None
    places = np.array([point.position_mm for point in found.points])
    columns, axes = point_factor(known, places), found.placement.matrix()
    off = []
    for drawn in rng.normal(size=(1000, columns.shape[2])):
        origin, x, plane = places + columns @ drawn
        there = frame_through(origin, x, plane, axes[:, 2])
        shift = axes.T @ (np.array(there.translation) - found.placement.translation)
        off.append([*rotation_vector(axes.T @ there.matrix()), *shift])
    stated = [*found.calibration.turn_rad, *found.calibration.origin_mm]
    # A standard deviation of 1000 draws is known to 2.2 %; four of those.
    np.testing.assert_allclose(np.std(off, axis=0) / stated, 1.0, atol=0.09)
    fitted = replace(choice, plane=None, region="rectangle 30 30 100 100")
    plane = Finder(measured["surface"], known, None, fitted).frame("0" * 64).calibration
    assert plane is not None
    # Both know the x axis by the same two points.
    assert plane.turn_rad[2] == pytest.approx(found.calibration.turn_rad[2], rel=0.05)


def test_marks_are_known_better_than_a_person_points(shelf: Shelf) -> None:
    surface = at_rest(shelf)
    centres = ((44.3, 61.8), (88.6, 58.2), (60.1, 90.4))
    row, column = np.mgrid[: surface.reason.shape[0] * 4, : surface.reason.shape[1] * 4]
    fine = np.full(row.shape, 200.0)
    for x, y in centres:
        fine[np.hypot((column + 0.5) / 4 - 0.5 - x, (row + 0.5) / 4 - 0.5 - y) < 6.0] = 30.0
    image = fine.reshape(row.shape[0] // 4, 4, row.shape[1] // 4, 4).mean(axis=(1, 3)).astype(np.uint8)
    pointed = [(x + 2.0, y - 1.5) for x, y in centres]
    choice = Choice(origin=pointed[0], x=pointed[1], plane=pointed[2], markers=True)
    found = Finder(surface, None, image, choice).frame("0" * 64)
    # A dot without noise is fitted to what eight bits round off, far below a tenth of a pixel.
    np.testing.assert_allclose([point.pixel for point in found.points], centres, atol=0.05)
    assert found.markers
    rough = Finder(surface, None, None, replace(choice, markers=False)).frame("0" * 64)
    assert found.deviation is not None
    assert rough.deviation is not None
    assert found.deviation.turn_rad[2] < 0.2 * rough.deviation.turn_rad[2]
