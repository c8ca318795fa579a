"""The specimen's frame of a turned panel, found by picked pixels: axis and shear, against exact truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sms_jobs.app.specimens.frame_choice import Choice
from sms_jobs.app.specimens.frame_finding import Finder
from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.kinds.deformation import correlate, strain
from sms_jobs.metrology.geometry.camera import project
from sms_jobs.metrology.geometry.transforms import compose, rotation_vector, transform
from sms_jobs.records.fields import StrainField
from sms_jobs.records.specimen_frame import SpecimenFrame
from sms_jobs.records.subject import Subject
from sms_jobs.testing.shelf import Shelf, reconstructed
from sms_jobs.virtual_rig.campaigns import Made, Size, placed, small_plate, tension_panel

_TURN_DEG = 5.0
_MICROSTRAIN = 1e6
_PEOPLE = 50
_SEED = 61
_ANYWHERE_MM = 4.0
_PLACES = ((-125.0, 0.0, 0.0), (125.0, 0.0, 0.0), (0.0, -110.0, 0.0))
"""Origin, x axis and plane on a panel of 290 mm, marked where an operator would: far apart."""


def warm_up() -> None:
    """Compile what a campaign goes through from frames to strain."""
    shelf, subject = reconstructed(*small_plate("plate"), lambda words: None, 1)
    for kind in (correlate.KIND, strain.KIND):
        shelf.run(kind, subject, kind.parameters())


def turned_panel(size: Size) -> Made:
    """Return the tension panel, turned by 5 degrees about its normal."""
    calibration, campaign = tension_panel("panel", size)
    assert campaign.scene is not None
    turn = placed((0.0, 0.0, float(np.radians(_TURN_DEG))), (0.0, 0.0, 0.0))
    scene = replace(campaign.scene, placement=compose(campaign.scene.placement, turn))
    return calibration, replace(campaign, scene=scene)


def picked(shelf: Shelf, random: np.random.Generator) -> Choice:
    """Return the pixels in which three marks lie, somewhere on the panel."""
    scene = shelf.campaign.scene
    assert scene is not None
    camera = scene.rig.sensor("C1")
    marks = np.array(_PLACES) + np.append(random.uniform(-_ANYWHERE_MM, _ANYWHERE_MM, 2), 0.0)
    pixels = project(camera.intrinsics, camera.pose, transform(scene.placement, marks))
    origin, x, plane = ((float(a), float(b)) for a, b in np.rint(pixels))
    return Choice(x=x, origin=origin, plane=plane)


def found_by(shelf: Shelf, subject: Subject, choice: Choice) -> SpecimenFrame:
    """Return the frame that a person's choice gives on the measured surface."""
    at_rest = replace(subject, state=shelf.campaign.reference.label)
    return Finder(shelf.records["reconstruct", at_rest]["surface"], None, None, choice).frame("")


def _shear(shelf: Shelf, subject: Subject, frame: SpecimenFrame | None) -> StrainField:
    """Return the strain along a frame, the scene's where it is None."""
    own = replace(shelf, campaign=replace(shelf.campaign, frame=frame), records=dict(shelf.records))
    own.run(strain.KIND, subject, strain.KIND.parameters())
    field: StrainField = own.records["strain", subject]["strain"]
    return field


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions."""
    shelf, subject = reconstructed(*turned_panel("small" if run.quick else "full"), run.say, run.threads)
    shelf.run(correlate.KIND, subject, correlate.KIND.parameters())
    assert shelf.campaign.scene is not None
    true = shelf.campaign.scene.placement.matrix()
    random = np.random.default_rng(_SEED)
    frames = [found_by(shelf, subject, picked(shelf, random)) for _ in range(_PEOPLE)]
    turns = np.array([rotation_vector(true.T @ one.placement.matrix()) for one in frames])
    stated = np.array([one.deviation.turn_rad for one in frames if one.deviation is not None])
    worst = frames[int(np.argmax(np.abs(turns[:, 2])))]
    yield Figure("axis_error_deg", float(np.degrees(np.abs(turns).max())), "deg", 0.1, "at most")
    rms = np.sqrt(np.mean(turns**2, axis=0))
    yield Figure("axis_rms_deg", float(np.degrees(rms[2])), "deg")
    yield Figure("reported_over_observed", float(np.sqrt(np.mean(stated[:, 2] ** 2)) / rms[2]), "1")
    along, truth = _shear(shelf, subject, None), shelf.truth(subject)
    exact = truth.strain(along.measure)
    off = _shear(shelf, subject, worst)
    both = (along.reason == 0) & (off.reason == 0)
    feigned = np.abs((off.strain - along.strain)[2][both]).max()
    mean = (off.strain - exact)[2][both].mean()
    yield Figure(
        "shear_from_frame_microstrain", _MICROSTRAIN * float(feigned), "microstrain", 20.0, "at most"
    )
    yield Figure(
        "mean_shear_error_microstrain", _MICROSTRAIN * float(abs(mean)), "microstrain", 20.0, "at most"
    )
    pixels = along.reason.shape[1]
    yield Condition(
        "axis",
        f"flat panel of 290 mm at 2000 microstrain, turned by {_TURN_DEG:g} degrees about its normal, one "
        f"camera of {pixels} px and one projector; {_PEOPLE} frames by the whole pixels in which marks lie, "
        "250 mm apart along x; largest turn about any axis, rms about the normal",
    )
    yield Condition(
        "shear",
        "with the worst of these frames: largest difference over all pixels from the shear along the true "
        "axes, and mean over all pixels of shear minus exact truth; gauge length 20 mm",
    )


GROUP = Group("frame", "the specimen's frame by picked pixels, against exact truth", warm_up, measure)
