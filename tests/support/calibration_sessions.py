"""Calibration sessions whose observations are made from the exact truth, and their kinds run in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.kinds.calibration import calibrate, calibrate_boards, observe_bar, observe_board
from sms_jobs.kinds.calibration.sessions import bar_states, board_states, every_view
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT, DatasetOutput, Inputs
from sms_jobs.kinds.recording import simulate
from sms_jobs.kinds.recording.simulate import recipe
from sms_jobs.metrology.calibration.pair_points import meet_rays
from sms_jobs.metrology.geometry.camera import project, ray_directions
from sms_jobs.metrology.targets.sphere_blur import sphere_image_in_projector
from sms_jobs.records.artefacts import BallBar
from sms_jobs.records.calibration import CalibrationQuality
from sms_jobs.records.campaign import Campaign, LoadState
from sms_jobs.records.observations import BarObservation, BoardObservation
from sms_jobs.records.scene import Simulation
from sms_jobs.records.sensors import Calibration, Rig
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of
from sms_jobs.testing.in_memory import InMemory, unheard
from sms_jobs.virtual_rig.artefact_truth import placed_points
from sms_jobs.virtual_rig.artefacts import bar_centres
from support.sessions import small_session
from support.true_boards import true_board

Floats = NDArray[np.float64]

CAMERA_SIGMA_PX, DOT_SIGMA_PX = 0.002, 0.004
POINT_SIGMA_PX = (0.016, 0.012)
"""Of a phase on a sphere: a projector of 4:3 knows its rows better than its columns."""

_LEAST_COSINE = 0.35
"""Of the rays of both sensors with the surface of a sphere: what is seen well."""


def simulation(campaign: Campaign, subject: Subject) -> Simulation:
    """Return what the virtual rig shows a tuple of a session."""
    task = recipe(campaign, Subject(campaign.name, subject.state))
    return Simulation(task.scene, *view_of(subject.view).sensors, task.deformation, subject.state or "")


def board_observation(campaign: Campaign, subject: Subject, rng: np.random.Generator) -> BoardObservation:
    """Return what a view sees of a board: exact points and noise."""
    truth = true_board(simulation(campaign, subject))
    seen = truth.seen
    count = int(seen.sum())
    noise = rng.standard_normal((2, count, 2))
    return BoardObservation(
        *view_of(subject.view).sensors,
        campaign.state(subject.state or "").artefact or "",
        0.58,
        {},
        truth.place[seen],
        truth.point[seen],
        truth.camera_px[seen] + CAMERA_SIGMA_PX * noise[0],
        np.full(count, CAMERA_SIGMA_PX),
        truth.projector_px[seen] + DOT_SIGMA_PX * noise[1],
        np.full(count, DOT_SIGMA_PX),
    )


def bar_observation(
    campaign: Campaign, subject: Subject, rng: np.random.Generator, points: int = 60
) -> BarObservation:
    """Return what a view sees of a bar: camera pixels on both spheres, their exact image, and noise."""
    shown = simulation(campaign, subject)
    bar = shown.scene.surface
    assert isinstance(bar, BallBar)
    rig = shown.scene.rig
    camera, projector = (rig.sensor(n) for n in (shown.camera, shown.projector))
    both = (camera.intrinsics, camera.pose), (projector.intrinsics, projector.pose)
    centres = placed_points(shown.scene, shown.deformation, bar_centres(bar))
    spheres, pixels, images = [], [], []
    for number, centre in enumerate(centres, start=1):
        middle = project(*both[0], centre[None])[0]
        depth = float(np.linalg.norm(centre - camera.pose.centre()))
        reach = int(1.3 * bar.radius_mm * camera.intrinsics.fx / depth)
        x, y = np.meshgrid(*(np.arange(int(c) - reach, int(c) + reach + 1.0) for c in middle))
        chosen = np.stack([x.ravel(), y.ravel()], axis=-1)
        image = sphere_image_in_projector(*both, centre, bar.radius_mm, chosen)
        known = np.isfinite(image).all(axis=1)
        chosen, image = chosen[known], image[known]
        place, _ = meet_rays(*both, chosen, image)
        normal = (place - centre) / bar.radius_mm
        facing = [
            np.sum(normal * -_unit(ray_directions(*sensor, px)), axis=1) > _LEAST_COSINE
            for sensor, px in zip(both, (chosen, image), strict=True)
        ]
        own = rng.choice(np.flatnonzero(facing[0] & facing[1]), points, replace=False)
        spheres.append(np.full(points, number, np.int32))
        pixels.append(chosen[own])
        images.append(image[own])
    sigma = np.broadcast_to(POINT_SIGMA_PX, (2 * points, 2)).copy()
    projected = np.concatenate(images)
    return BarObservation(
        camera.name,
        projector.name,
        campaign.state(subject.state or "").artefact or "",
        {},
        1.0,
        np.concatenate(spheres),
        np.concatenate(pixels),
        projected + sigma * rng.standard_normal(projected.shape),
        sigma,
        centres + 0.02 * rng.standard_normal((2, 3)),
        np.full((2, 3), 0.02),
    )


def _unit(directions: Floats) -> Floats:
    return np.asarray(directions / np.linalg.norm(directions, axis=-1, keepdims=True))


@dataclass
class SessionInMemory:
    """A session and the records of its jobs, by kind and subject."""

    campaign: Campaign
    records: dict[tuple[str, str], Mapping[str, Any]] = field(default_factory=dict)
    statistics: dict[tuple[str, str], Mapping[str, float]] = field(default_factory=dict)
    pages: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def observed(cls, campaign: Campaign, seed: int = 1, points: int = 60) -> SessionInMemory:
        """Return a session with the observations of all its poses, made from the truth."""
        rng = np.random.default_rng(seed)
        made = cls(campaign)
        for subject in every_view(campaign, board_states(campaign)):
            made.put(observe_board.KIND.name, subject, board_observation(campaign, subject, rng))
        for subject in every_view(campaign, bar_states(campaign)):
            made.put(observe_bar.KIND.name, subject, bar_observation(campaign, subject, rng, points))
        return made

    def put(self, kind: str, subject: Subject, observation: BoardObservation | BarObservation) -> None:
        """Take an observation as the result of a job."""
        self.records[kind, str(subject)] = {"observation": observation}

    def observation(self, kind: str, state: str, view: str) -> Any:
        """Return what a view observed in a state."""
        return self.records[kind, f"{self.campaign.name}/{state}/{view}"]["observation"]

    def changed(
        self, kind: str, change: Callable[[Any], Any], states: Iterable[str] = (), views: Iterable[str] = ()
    ) -> SessionInMemory:
        """Return a copy with some observations of a kind changed; those of all states and views if none."""
        records = dict(self.records)
        for (name, text), held in self.records.items():
            subject = Subject.parse(text)
            if name != kind or (states and subject.state not in states):
                continue
            if not views or subject.view in views:
                records[name, text] = {"observation": change(held["observation"])}
        return SessionInMemory(self.campaign, records)

    def copy(self) -> SessionInMemory:
        """Return one whose records can be changed without changing these."""
        return SessionInMemory(self.campaign, dict(self.records), dict(self.statistics), dict(self.pages))

    def showing(self, states: Callable[[LoadState], bool]) -> SessionInMemory:
        """Return the session with some of its states alone."""
        kept = tuple(s for s in self.campaign.states if states(s))
        return SessionInMemory(replace(self.campaign, states=kept), self.records)

    def record(self, state: str) -> None:
        """Render a state."""
        subject = Subject(self.campaign.name, state)
        inputs = Inputs(subject, recipe(self.campaign, subject), {}, 2)
        for output in simulate.run(inputs, simulate.SimulateParameters(), unheard):
            assert isinstance(output, DatasetOutput)
            self.records[MEASUREMENT, str(output.subject)] = output.records

    def run(self, module: Any, subject: Subject, threads: int = 2, **options: Any) -> Mapping[str, Any]:
        """Run a kind of the session; return its records."""
        kind = module.KIND
        parameters = kind.parameters(**options)
        datasets = {
            need.role: InMemory(need.subject, self.records[need.source, str(need.subject)])
            for need in kind.checked_needs(self.campaign, subject, parameters)
        }
        inputs = Inputs(subject, kind.context(self.campaign, subject), datasets, threads)
        for output in map(kind.checked, kind.run(inputs, parameters, unheard)):
            if isinstance(output, DatasetOutput):
                self.records[kind.name, str(subject)] = output.records
                self.statistics[kind.name, str(subject)] = output.statistics
            else:
                self.pages[kind.name] = output
        return self.records[kind.name, str(subject)]

    def know(self, records: Mapping[str, Any]) -> None:
        """Take a calibration as the one that is valid for the session and all its poses."""
        name = self.campaign.name
        self.records[CALIBRATION, name] = records
        for subject in every_view(self.campaign, self.campaign.states):
            self.records[CALIBRATION, str(subject)] = records

    def calibrate_boards(self, threads: int = 2, **options: Any) -> Mapping[str, Any]:
        """Run `calibrate-boards`."""
        return self.run(calibrate_boards, Subject(self.campaign.name), threads, **options)

    def calibrate(self, threads: int = 2, **options: Any) -> Mapping[str, Any]:
        """Run `calibrate`."""
        return self.run(calibrate, Subject(self.campaign.name), threads, **options)


def point_errors(true: Rig, calibration: Calibration, quality: CalibrationQuality) -> tuple[Floats, Floats]:
    """Return errors of points over the volume, by all views, and what is expected of them, mm, both (n,)."""
    errors, expected = [], []
    for view, sigma in zip(quality.views, quality.expected_sigma, strict=True):
        truth = [(s.intrinsics, s.pose) for s in (true.sensor(n) for n in view_of(view).sensors)]
        found = [(s.intrinsics, s.pose) for s in (calibration.rig.sensor(n) for n in view_of(view).sensors)]
        seen = np.isfinite(sigma)
        pixels = [project(*sensor, quality.place[seen]) for sensor in truth]
        places, _ = meet_rays(found[0], found[1], pixels[0], pixels[1])
        errors.append(np.linalg.norm(places - quality.place[seen], axis=1))
        expected.append(sigma[seen])
    return np.concatenate(errors), np.concatenate(expected)


@cache
def recorded_session() -> SessionInMemory:
    """Return the small session, rendered; its boards are observed and calibrated, its bars not yet."""
    made = SessionInMemory(small_session("session"))
    for state in made.campaign.states:
        made.record(state.label)
    for subject in every_view(made.campaign, board_states(made.campaign)):
        made.run(observe_board, subject)
    made.calibrate_boards()
    return made


@cache
def observed_session() -> SessionInMemory:
    """Return the small session, rendered, with its bars observed too."""
    made = recorded_session().copy()
    special = observe_bar.special_labels(made.campaign)
    subjects = every_view(made.campaign, bar_states(made.campaign))
    for subject in sorted(subjects, key=lambda s: s.state not in special):
        made.run(observe_bar, subject)
    return made
