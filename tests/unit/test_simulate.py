"""The simulate kind: what it records, for which campaigns, and that it records the same again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.sessions import small_session

from sms_jobs.archive import Archive, MemoryStore
from sms_jobs.archive.provenance import Provenance
from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.kind import MEASUREMENT, DatasetOutput, Inputs, default_subjects
from sms_jobs.kinds.recording.simulate import KIND, UNTIMED, Recipe, SimulateParameters
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.scene import Simulation, Speckle
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.campaigns import small_plate

CAMPAIGN = small_plate("plate")[1]


def recorded(campaign: Campaign, state: str, threads: int = 1) -> dict[str, DatasetOutput]:
    subject = Subject(campaign.name, state)
    inputs = Inputs(subject, KIND.context(campaign, subject), {}, threads)
    told: list[float] = []
    outputs = KIND.run(inputs, SimulateParameters(), lambda fraction, message="": told.append(fraction))
    found = {}
    for output in outputs:
        assert isinstance(output, DatasetOutput)
        found[str(output.subject)] = output
    assert told == sorted(told)
    assert told[-1] == 1.0
    return found


def measurement_of(output: DatasetOutput) -> Measurement:
    found = output.records["measurement"]
    assert isinstance(found, Measurement)
    return found


def test_every_pair_of_the_state_is_recorded() -> None:
    outputs = recorded(CAMPAIGN, "S01")
    assert list(outputs) == ["plate/S01/C1P1", "plate/S01/C1P2"]
    assert CAMPAIGN.scene is not None
    for view, output in zip(("P1", "P2"), outputs.values(), strict=True):
        measurement = measurement_of(output)
        assert measurement.frames.shape == (CAMPAIGN.sequence.frames, 128, 128)
        assert measurement.sequence == CAMPAIGN.sequence
        assert measurement.recorded_at == CAMPAIGN.state("S01").time
        deformation = CAMPAIGN.state("S01").deformation
        assert measurement.simulation == Simulation(CAMPAIGN.scene, "C1", view, deformation, "S01")
        assert output.statistics["saturated_fraction"] == 0.0
        assert output.statistics["mean_level_count"] == pytest.approx(measurement.texture.mean())


def test_recording_again_gives_the_same_and_another_state_does_not() -> None:
    first, again, other = (recorded(CAMPAIGN, s, n) for s, n in (("S00", 1), ("S00", 2), ("S01", 1)))
    for a, b in zip(first.values(), again.values(), strict=True):
        np.testing.assert_array_equal(measurement_of(a).texture, measurement_of(b).texture)
        np.testing.assert_array_equal(measurement_of(a).frames.frame(7), measurement_of(b).frames.frame(7))
    here, there = measurement_of(first["plate/S00/C1P1"]), measurement_of(other["plate/S01/C1P1"])
    assert not np.array_equal(here.texture, there.texture)


def test_a_bracket_is_recorded_exposure_by_exposure_and_dazzled_for_real() -> None:
    exposures = (0.25, 1.0, 4.0)
    sequence = replace(CAMPAIGN.sequence, exposures=exposures)
    bracketed = next(iter(recorded(replace(CAMPAIGN, sequence=sequence), "S00").values()))
    single = measurement_of(next(iter(recorded(CAMPAIGN, "S00").values())))
    measurement = measurement_of(bracketed)
    count = sequence.frames_per_exposure
    assert sequence.frames == measurement.frames.shape[0] == 3 * count == 3 * CAMPAIGN.sequence.frames
    rows = measurement.frames.rows(40, 60)
    for index in (0, count - 1, count, 2 * count + 7):
        np.testing.assert_array_equal(measurement.frames.frame(index)[40:60], rows[index])
    levels = rows.reshape(3, count, 20, 128).astype(float)
    assert not (levels[0] >= measurement.full_scale).any()
    assert (levels[2] >= measurement.full_scale).mean() > 0.05
    lit = (levels[2] < measurement.full_scale).all(axis=0) & (levels[1].mean(axis=0) > 50.0)
    for number, exposure in enumerate(exposures):
        # Thousands of pixels of noise below 30 grey levels: their mean is good to 0.5.
        off = levels[number][:, lit] - exposure * levels[1][:, lit]
        assert abs(off.mean()) < 0.5
    # Each frame has noise of its own, and the white frame is of exposure 1 whatever the bracket.
    assert not np.array_equal(rows[count], rows[0])
    assert measurement.texture.mean() == pytest.approx(single.texture.mean(), rel=1e-3)


def test_what_is_hashed_is_what_the_recording_depends_on() -> None:
    subject = Subject("plate", "S00")
    renamed = replace(CAMPAIGN, specimen=replace(CAMPAIGN.specimen, description="another"))
    assert KIND.context(renamed, subject) == KIND.context(CAMPAIGN, subject)
    assert KIND.context(CAMPAIGN, Subject("plate", "S01")) != KIND.context(CAMPAIGN, subject)


def test_a_state_without_a_time_gets_a_fixed_one() -> None:
    untimed = replace(CAMPAIGN, states=(replace(CAMPAIGN.states[0], time=None),))
    context = KIND.context(untimed, Subject("plate", "S00"))
    assert isinstance(context, Recipe)
    assert context.recorded_at == UNTIMED


def test_only_campaigns_of_the_virtual_rig_can_be_recorded() -> None:
    real = replace(CAMPAIGN, scene=None)
    assert default_subjects(KIND, real) == ()
    with pytest.raises(InvalidInput, match="no scene"):
        KIND.context(real, Subject("plate", "S00"))
    with pytest.raises(InvalidInput, match="no sensor P7"):
        recorded(replace(CAMPAIGN, views=("C1P7",)), "S00")


def test_it_makes_measurements_from_nothing() -> None:
    assert KIND.makes == MEASUREMENT
    assert not list(KIND.needs(CAMPAIGN, Subject("plate", "S00"), KIND.parameters()))
    assert [str(s) for s in default_subjects(KIND, CAMPAIGN)] == ["plate/S00", "plate/S01"]
    assert KIND.repeatable(SimulateParameters())


def test_a_recording_comes_back_from_the_archive_with_what_was_simulated() -> None:
    output = recorded(CAMPAIGN, "S01")["plate/S01/C1P2"]
    provenance = Provenance(
        "simulate", 1, output.subject, "0123456789abcdef", 1, UNTIMED, {}, (), "0", "host", "operator"
    )
    archive = Archive(MemoryStore())
    sealed = archive.seal_dataset(output.records, provenance)
    made = measurement_of(output)
    with archive.open(sealed) as dataset:
        read = dataset.read("measurement", Measurement)
        # Equal in value: the truth of two states is looked for in equal scenes.
        assert read.simulation == made.simulation
        np.testing.assert_array_equal(read.frames.rows(10, 40), made.frames.rows(10, 40))


def test_a_state_of_a_session_is_recorded_with_its_artefact() -> None:
    session = small_session("session")
    assert session.session is not None
    specked = replace(session, scene=replace(session.scene, speckle=Speckle(5.0)))
    for label, artefact in (("B02", "board"), ("S03", "bar")):
        context = KIND.context(specked, Subject("session", label))
        assert isinstance(context, Recipe)
        assert context.scene.surface == session.session.artefacts[artefact]
        assert context.scene.speckle is None
        assert context.deformation == session.state(label).deformation
    # One pose of the bar takes three quarters of a megabyte a view: it is enough to archive one.
    output = recorded(replace(session, sequence=FringeSequence((8, 4)), views=("C1P2",)), "S03")
    made = measurement_of(output["session/S03/C1P2"])
    provenance = Provenance(
        "simulate",
        1,
        Subject("session", "S03", "C1P2"),
        "0" * 16,
        1,
        UNTIMED,
        {},
        (),
        "0",
        "host",
        "operator",
    )
    archive = Archive(MemoryStore())
    sealed = archive.seal_dataset({"measurement": made}, provenance)
    with archive.open(sealed) as dataset:
        assert dataset.read("measurement", Measurement).simulation == made.simulation
    assert default_subjects(KIND, session) == tuple(Subject("session", s.label) for s in session.states)
