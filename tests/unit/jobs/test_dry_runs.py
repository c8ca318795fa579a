"""A dry run says what a recording takes and what it lacks, and asks no instrument."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
from support.homes import initialised
from support.sessions import small_session

from sms_jobs import bootstrap
from sms_jobs.bootstrap import Services
from sms_jobs.formats.rig_configuration import parse_rig
from sms_jobs.jobs.devices.stations import known_sensors
from sms_jobs.jobs.recording.dry_runs import dry_run
from sms_jobs.kinds.recording.acquire import all_states, order
from sms_jobs.records.campaign import Campaign, LoadState
from sms_jobs.records.shown.rehearsals import DryRun
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.campaigns import small_plate

# Ports that no computer has: whoever asked the instruments would fail.
RIG = """
name = "hall-3"
cameras = [{ name = "C1", driver = "simulated", columns = 256, rows = 256 }]
projectors = [
    { name = "P1", driver = "simulated", columns = 512, rows = 384, settle_ms = 100.0 },
    { name = "P2", driver = "simulated", columns = 512, rows = 384, settle_ms = 100.0 },
]
stages = [{ name = "stage", link = { port = "/nowhere/stage" } }]

[[channels]]
name = "temperature"
link = { port = "/nowhere/temperature" }
protocol = {}
unit = "degC"
"""


SIDE = """
    {{ name = "C{0}", driver = "simulated", columns = 100, rows = 80 }},
"""


@pytest.fixture(scope="module")
def services(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Services]:
    home = tmp_path_factory.mktemp("home")
    initialised(home)
    with bootstrap.services(home) as made:
        yield made


def tried(
    services: Services, campaign: Campaign, text: str = RIG, states: tuple[LoadState, ...] | None = None
) -> DryRun:
    folder = services.archive.store.root
    with services.catalogue.reading() as session:
        rig = parse_rig(text, "rig.toml", known_sensors())
        return dry_run(session, rig, campaign, states or campaign.states, folder / "spool", services.archive)


def asking_for(*channels: str) -> Campaign:
    # Before a scene without its sensors, whose images are smaller than those of the rig here.
    processing = {"acquire": {"channels": channels, "recordings": 1}}
    plate = small_plate("plate")[1]
    assert plate.scene is not None
    scene = replace(plate.scene, rig=replace(plate.scene.rig, sensors=()))
    return replace(plate, processing=processing, scene=scene)


def test_frames_bytes_and_time_follow_from_the_plan(services: Services) -> None:
    done = tried(services, small_session("session"))
    assert list(done.states) == ["B01", "B02", "B03", "S01", "S02", "S03", "S04", "S05", "S06"]
    assert done.missing == ()
    # 2 orientations of 6 densities of 4 steps, and a white frame, by each of two views.
    assert done.frames == 9 * 2 * 49
    assert done.raw_bytes == done.archived_bytes == done.frames * 256 * 256 * 2
    assert done.packed is None
    # A set that is recorded again lies beside the first.
    assert done.spool_bytes == 3 * 49 * 256 * 256 * 2
    assert all(s.recording_s > 2 * 49 * 0.1 for s in done.states.values())
    assert done.states["B01"].moving_s < done.states["S03"].moving_s < done.states["S01"].moving_s


def test_how_patterns_come_is_told(services: Services) -> None:
    pulses = ', pulses = { cameras = ["C1"], period_ms = 25.0 } },'
    of_the_first = RIG.replace(" },", pulses, 1)
    stepped, played = tried(services, asking_for()), tried(services, asking_for(), of_the_first)
    one_by_one = "40 patterns shown one by one: the file of rig hall-3 gives P{} no pulses"
    assert stepped.ways == {"P1": one_by_one.format(1), "P2": one_by_one.format(2)}
    assert played.ways == {"P1": "40 patterns played in a burst, one every 25 ms", "P2": one_by_one.format(2)}
    for label, state in stepped.states.items():
        # 39 periods of 25 ms and 50 ms after them instead of 40 times 100, and white as before.
        saved_s = state.recording_s - played.states[label].recording_s
        assert saved_s == pytest.approx(40 * 0.1 - 39 * 0.025 - 0.05, abs=1e-6)


def test_what_the_rig_lacks_is_told(services: Services) -> None:
    assert tried(services, asking_for("temperature=0.5")).missing == ()
    (channel,) = tried(services, asking_for("load_n")).missing
    assert "rig hall-3 has no channel 'load_n'" in channel
    projector, size = tried(
        services,
        small_session("session"),
        RIG.replace('name = "P2"', 'name = "P3"').replace("columns = 256", "columns = 300"),
    ).missing
    assert "has no P2; it has C1, P1, P3" in projector
    assert "C1 has 300 x 256 px in the file of rig hall-3, and 256 x 256 px in the plan" in size
    without = tried(services, small_session("session"), RIG.replace("stages =", "# stages ="))
    assert len(without.missing) == 6
    assert without.missing[0].startswith("S01: rig hall-3 has no stage")


def test_a_simulated_rig_lacks_a_scene_where_the_plan_has_none(services: Services) -> None:
    (scene,) = tried(services, replace(asking_for(), scene=None)).missing
    assert scene.startswith(
        "rig hall-3 is simulated, and campaign plate describes no scene that it could see"
    )


def test_simulated_sensors_have_the_images_of_the_scene(services: Services) -> None:
    camera, one, two = tried(services, small_plate("plate")[1]).missing
    assert camera == (
        "C1 has 256 x 256 px in the file of rig hall-3, and 128 x 128 px in the plan: correct one of them"
    )
    assert [words.split(" in the file")[0] for words in (one, two)] == [
        "P1 has 512 x 384 px",
        "P2 has 512 x 384 px",
    ]
    as_it_is = RIG.replace("256, rows = 256", "128, rows = 128").replace("512, rows = 384", "256, rows = 192")
    assert tried(services, small_plate("plate")[1], as_it_is).missing == ()


def test_cameras_without_a_projector_are_recorded_beside_fringes(services: Services) -> None:
    plate = replace(asking_for(), views=("C1P1", "C1P2", "C2C3"))
    lacking, _ = tried(services, plate).missing
    assert lacking == "the file of rig hall-3 has no C2; it has C1, P1, P2"
    rig = RIG.replace("cameras = [", "cameras = [" + SIDE.format(2) + SIDE.format(3))
    done = tried(services, plate, rig)
    assert done.missing == ()
    # At each of two states two sets of fringes and a white frame, and one image of each of two cameras.
    states, fringes = len(plate.states), plate.sequence.frames + 1
    assert done.frames == states * (2 * fringes + 2)
    assert done.raw_bytes == states * 2 * (2 * fringes * 256 * 256 + 2 * 100 * 80)
    assert order(plate, Subject("plate", "S00")).views == ("C1P1", "C1P2", "C2", "C3")


def test_cameras_alone_need_no_projector_and_take_an_image_each(services: Services) -> None:
    alone = replace(asking_for(), views=("C1C2", "C3"))
    rig = RIG.replace("cameras = [", "cameras = [" + SIDE.format(2) + SIDE.format(3))
    done = tried(services, alone, rig[: rig.index("projectors")] + rig[rig.index("stages") :])
    assert done.missing == ()
    assert done.frames == 3 * len(alone.states)
    assert done.raw_bytes == len(alone.states) * 2 * (256 * 256 + 2 * 100 * 80)
    # Their images lie in their files twice, and nothing is known yet of how well they are packed.
    assert (done.packed, done.archived_bytes) == (None, 2 * done.raw_bytes)
    assert [s.label for s in alone.states] == [str(s.state) for s in all_states(alone)]


def test_values_that_no_channel_confirms_are_remarked_on(services: Services) -> None:
    (remark,) = tried(services, asking_for()).remarks
    assert "what load_n will be, which no channel of rig hall-3 reads" in remark


def test_a_disk_that_is_too_small_is_told(services: Services) -> None:
    # 490 frames of more than 8 GB each: no disk of a test has room for that.
    huge = RIG.replace("columns = 256, rows = 256", "columns = 65535, rows = 65535")
    done = tried(services, replace(asking_for(), processing={}), huge)
    assert [words.split(" has room")[0] for words in done.missing] == [
        "the disk of the spool",
        "the disk of the archive",
    ]
