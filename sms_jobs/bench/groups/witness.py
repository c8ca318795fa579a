"""Witness: accuracy on images that other programs render, over accuracy on our own virtual rig's."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from math import sqrt
from pathlib import Path

import numpy as np

from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.bench.groups import strain as strain_figures
from sms_jobs.bench.peers import NO_PEERS, missing_peers, peers_folder
from sms_jobs.bench.witness.effects import EFFECTS, STATE, halved_hat
from sms_jobs.bench.witness.fringes import Witnessed, fringes_of_mitsuba
from sms_jobs.bench.witness.scenes import MeshTruth
from sms_jobs.bench.witness.speckles import cylinder_in_tension, speckles_of_riley
from sms_jobs.errors import SmsError
from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.deformation import correlate, strain
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT
from sms_jobs.kinds.surface_ports import maker_of, position_covariance
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.fields import Surface
from sms_jobs.records.subject import Subject
from sms_jobs.testing.shelf import Shelf, reconstructed
from sms_jobs.virtual_rig.campaigns import Made, tension_panel, top_hat_bending
from sms_jobs.virtual_rig.truth import Truth

_UNITS = {"shape": ("um", 1e3), "displacement": ("um", 1e3), "strain": ("microstrain", 1e6)}
_TARGET = 1.2
_WRONG = 6.0


@dataclass(frozen=True)
class Errors:
    """Rms errors over all valid pixels.

    Attributes
    ----------
    rms
        Of `shape` and `displacement`, lengths in mm, and of `strain`, its three components together.
    valid
        How many pixels have a displacement.
    beside
        How many pixels with a position, a displacement or a strain see no specimen.
    wrong
        Part of the positions that are off by more than `_WRONG` of their stated deviations.
    """

    rms: Mapping[str, float]
    valid: int
    beside: int
    wrong: float

    def over(self, other: Errors) -> dict[str, float]:
        """Return these errors, and how many pixels are valid, over others."""
        ratio = {name: self.rms[name] / other.rms[name] for name in self.rms}
        return ratio | {"valid": self.valid / other.valid}


def measured(shelf: Shelf, last: Subject, truth: MeshTruth, gauge_length_mm: float) -> Errors:
    """Measure displacement and strain between two states whose shapes are there; compare with the truth."""
    at_rest = replace(last, state=shelf.campaign.reference.label)
    shelf.run(correlate.KIND, last, correlate.KIND.parameters())
    shelf.run(strain.KIND, last, strain.KIND.parameters(gauge_length_mm=gauge_length_mm))
    surface = shelf.records[maker_of(last.view).kind, at_rest]["surface"]
    moved = shelf.records["correlate", last]["displacement"]
    strained = shelf.records["strain", last]["strain"]
    rms, beside = {}, 0
    for name, found, true, reason in (
        ("shape", surface.position, truth.position, surface.reason),
        ("displacement", moved.displacement, truth.displacement, moved.reason),
        ("strain", strained.strain, truth.strain, strained.reason),
    ):
        error = (found - true)[:, reason == 0]
        seen = np.isfinite(error).all(axis=0)
        beside += int(np.count_nonzero(~seen))
        squared = np.square(error[:, seen])
        rms[name] = sqrt(squared.mean() if name == "strain" else squared.sum(axis=0).mean())
    return Errors(rms, int(np.count_nonzero(moved.reason == 0)), beside, _wrong(surface, truth))


def _wrong(surface: Surface, truth: MeshTruth) -> float:
    valid = surface.reason == 0
    variance = trace(position_covariance(surface))[valid]
    squared = np.square((surface.position - truth.position)[:, valid]).sum(axis=0)
    return float(np.mean(squared > _WRONG**2 * variance))


def on_our_images(made: Made, state: str, gauge_length_mm: float, run: Run) -> Errors:
    """Measure a campaign's first view on images of the virtual rig."""
    shelf, last = reconstructed(*made, lambda words: None, run.threads, (state,))
    return measured(shelf, last, _as_mesh(shelf.truth(last)), gauge_length_mm)


def on_theirs(made: Made, state: str, gauge_length_mm: float, run: Run, images: Witnessed) -> Errors:
    """Measure it on images that another program has rendered."""
    calibration, campaign = made
    shelf = Shelf(campaign, run.threads)
    maker = all_kinds()[maker_of(campaign.views[0]).kind]
    last = Subject(campaign.name, state, campaign.views[0])
    for subject in (replace(last, state=campaign.reference.label), last):
        shelf.records[CALIBRATION, subject] = {"calibration": calibration}
        for own in subject.recordings:
            shelf.records[MEASUREMENT, own] = {"measurement": images.recorded[str(own.state), str(own.view)]}
        shelf.run(maker, subject, maker.parameters())
    return measured(shelf, last, images.truth, gauge_length_mm)


def _as_mesh(truth: Truth) -> MeshTruth:
    return MeshTruth(truth.shape.xyz, truth.displacement, truth.green_lagrange)


@dataclass(frozen=True)
class Scene:
    """A campaign that both render: its name, its first view at rest and at a state, by which program."""

    name: str
    make: Callable[[], Made]
    state: str
    gauge_length_mm: float
    render: Callable[[Path, Path, Campaign, str], Witnessed]
    told: str


def _scenes() -> tuple[Scene, ...]:
    return (
        Scene(
            "hat",
            lambda: top_hat_bending("hat", "small"),
            "S03",
            20.0,
            fringes_of_mitsuba,
            "the demo's top hat in fringes, pushed out by 10 mm, view C1P1, 512 px, rendered by Mitsuba",
        ),
        Scene(
            "panel",
            lambda: tension_panel("panel", "small"),
            "S03",
            20.0,
            fringes_of_mitsuba,
            "a flat panel of 290 mm in fringes, stretched by 2000 microstrain, 512 px, rendered by Mitsuba",
        ),
        Scene(
            "stereo",
            cylinder_in_tension,
            "S03",
            10.0,
            speckles_of_riley,
            "a cylinder before two cameras of 640 x 512 px, stretched by 0.5 %, rendered by riley",
        ),
    )


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions."""
    ratios: dict[str, dict[str, float]] = {}
    scenes = _scenes()
    for scene in scenes:
        outcome = _tried(scene, run)
        if isinstance(outcome, str):
            yield Condition(scene.name, f"left out: {outcome}")
            continue
        ours, theirs = outcome
        ratios[scene.name] = theirs.over(ours)
        for name, ratio in ratios[scene.name].items():
            yield Figure(f"{scene.name}_{name}_over_own", ratio, "1")
        for name, (unit, scale) in _UNITS.items():
            yield Figure(f"{scene.name}_{name}_{unit}", scale * theirs.rms[name], unit)
            yield Figure(f"{scene.name}_{name}_own_{unit}", scale * ours.rms[name], unit)
        yield Condition(scene.name, _told(scene, ours, theirs))
    for name in _UNITS:
        every = [ratio[name] for ratio in ratios.values()]
        yield Figure(
            f"{name}_over_own", max(every) if len(every) == len(scenes) else None, "1", _TARGET, "at most"
        )
    yield Condition(
        "over_own",
        "rms error on images that another program has rendered over that on our virtual rig's, the worst of "
        "all scenes: the same rig, specimen, print, response and noise, but for the noise's numbers; default "
        "parameters; no value where a scene was left out",
    )
    yield from _effects(run)


def _effects(run: Run) -> Iterator[Found]:
    """Yield by how much errors grow by what light does besides going straight to paint and a pin-hole."""
    peers = peers_folder()
    if peers is None or run.quick:
        return
    made = halved_hat()
    found: dict[str, Errors] = {}
    for effect in EFFECTS:
        run.say(f"witness: {effect.name}")
        folder = run.folder / effect.name
        folder.mkdir()
        try:
            images = fringes_of_mitsuba(peers, folder, made[1], STATE, effect.effects)
        except SmsError as error:
            yield Condition(f"effect_{effect.name}", f"left out: {error}")
            continue
        found[effect.name] = on_theirs(made, STATE, 20.0, run, images)
        yield Figure(f"effect_{effect.name}_wrong", found[effect.name].wrong, "1")
    direct = found.pop("direct", None)
    if direct is not None:
        for name, errors in found.items():
            for quantity, ratio in errors.over(direct).items():
                yield Figure(f"effect_{name}_{quantity}_over_direct", ratio, "1")
    each = "; ".join(f"{effect.name}: {effect.told}" for effect in EFFECTS)
    yield Condition(
        "effect",
        f"the demo's top hat with cameras of 256 px, rendered by Mitsuba, view C1P1: {each}. Wrong is the "
        f"part of the valid positions that are off by more than {_WRONG:g} stated deviations",
    )


def _tried(scene: Scene, run: Run) -> tuple[Errors, Errors] | str:
    """Measure a scene on our images and on theirs, or say why that is left out."""
    peers = peers_folder()
    if peers is None:
        return NO_PEERS
    if run.quick:
        return "--quick"
    try:
        return _both(scene, peers, run)
    except SmsError as error:
        return str(error)


def _both(scene: Scene, peers: Path, run: Run) -> tuple[Errors, Errors]:
    """Measure a scene on our images and on theirs."""
    made = scene.make()
    run.say(f"witness: {scene.name}, rendering")
    folder = run.folder / scene.name
    folder.mkdir()
    images = scene.render(peers, folder, made[1], scene.state)
    run.say(f"witness: {scene.name}, measuring")
    theirs = on_theirs(made, scene.state, scene.gauge_length_mm, run, images)
    return on_our_images(made, scene.state, scene.gauge_length_mm, run), theirs


def _told(scene: Scene, ours: Errors, theirs: Errors) -> str:
    return (
        f"{scene.told}; shape at rest, displacement, and strain with a gauge length of "
        f"{scene.gauge_length_mm:g} mm, against the truth of the mesh and, on our own images, the surface; "
        f"rms over all {theirs.valid} and {ours.valid} valid pixels, those left out whose centre sees no "
        f"specimen, {theirs.beside} and {ours.beside} times"
    )


def warm_up() -> None:
    """Compile what images are measured with, where there are any."""
    if peers_folder() is not None:
        strain_figures.warm_up()


def _lacks() -> str:
    return missing_peers(Mitsuba="import mitsuba; mitsuba.set_variant('llvm_ad_rgb')", riley="import riley")


GROUP = Group(
    "witness", "errors on images that other programs render, over those on our own", warm_up, measure, _lacks
)
