"""From requests to a graph of jobs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import pytest

from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.jobs.planning.graph import Existing, PlannedJob, Request, plan, plan_possible
from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT, Need, default_subjects
from sms_jobs.records.campaign import Campaign
from sms_jobs.virtual_rig.campaigns import small_plate, top_hat_bending

CAMPAIGN = top_hat_bending("hat", "small")[1]
EVERYTHING = [Request("simulate"), Request("pipeline")]


def only_calibration(need: Need) -> Existing | None:
    return Existing(file_id=1) if need.source == CALIBRATION else None


def everything_exists(need: Need) -> Existing | None:
    return Existing(file_id=1)


def counted(jobs: tuple[PlannedJob, ...]) -> Counter[str]:
    return Counter(job.kind.name for job in jobs)


def test_a_pipeline_covers_every_tuple_once() -> None:
    # 4 states, 4 views, 3 deformed states.
    assert counted(plan(CAMPAIGN, EVERYTHING, only_calibration)) == {
        "simulate": 4,
        "reconstruct": 16,
        "correlate": 12,
        "strain": 12,
        "merge": 3,
        "export": 3,
        "assess": 16,
        "report": 1,
    }


def test_every_job_comes_after_those_it_needs() -> None:
    jobs = plan(CAMPAIGN, EVERYTHING, only_calibration)
    for place, job in enumerate(jobs):
        producers = [i.producer for i in job.inputs if i.producer is not None]
        assert all(producer < place for producer in producers)
        assert len({i.need.role for i in job.inputs}) == len(job.inputs)


def test_every_need_is_met_by_a_job_that_makes_it() -> None:
    jobs = plan(CAMPAIGN, EVERYTHING, only_calibration)
    for job in jobs:
        for given in job.inputs:
            if given.producer is None:
                assert given.need.source == CALIBRATION
                continue
            producer = jobs[given.producer]
            assert given.need.source == (producer.kind.makes or producer.kind.name)
            wanted = given.need.subject
            assert producer.subject.state in (None, wanted.state)
            assert producer.subject.view in (None, wanted.view)


def test_one_state_brings_the_reference_that_it_needs_and_no_report() -> None:
    jobs = plan(CAMPAIGN, [Request("pipeline", states=("S02",))], everything_exists)
    assert {job.subject.state for job in jobs if job.kind.name == "reconstruct"} == {"S00", "S02"}
    assert {job.subject.state for job in jobs if job.kind.name == "correlate"} == {"S02"}
    assert "report" not in counted(jobs)


def test_one_view_brings_nothing_that_is_about_all_views_of_a_state() -> None:
    jobs = plan(CAMPAIGN, [Request("pipeline", views=("C1P2",))], everything_exists)
    # 4 states, 3 of them deformed.
    assert counted(jobs) == {"reconstruct": 4, "correlate": 3, "strain": 3, "assess": 4}
    assert {job.subject.view for job in jobs} == {"C1P2"}
    # A camera that measures shape is not merged with what it sees alone.
    both = replace(CAMPAIGN, views=("C1P1", "C1"), scene=None)
    assert counted(plan(both, [Request("pipeline", views=("C1P1",))], everything_exists))["merge"] == 3


def test_nobody_chooses_a_part_of_what_a_job_covers_whole() -> None:
    """Of every kind: a state or view that is chosen is obeyed or refused."""
    state, view = CAMPAIGN.states[1].label, CAMPAIGN.views[0]
    obeyed: dict[str, set[str]] = {}
    able = {name: kind for name, kind in all_kinds().items() if default_subjects(kind, CAMPAIGN)}
    for name, kind in able.items():
        for choice, given in (("state", {"states": (state,)}), ("view", {"views": (view,)})):
            try:
                plan_possible(CAMPAIGN, [Request(name, **given)], everything_exists)  # type: ignore[arg-type]
            except InvalidInput as error:
                if f"`{choice}` has no effect" in str(error):
                    continue
            obeyed.setdefault(kind.scope.value, set()).add(choice)
    assert obeyed == {"state": {"state"}, "tuple": {"state", "view"}}


def test_a_choice_without_effect_is_refused_with_what_to_do_instead() -> None:
    of_report = "report is about all states of campaign hat, .* by `state` has no effect .* leave_out=STATE"
    of_merge = "merge is about all views of a state of campaign hat, .*: submit merge without it$"
    for request, said in (
        (Request("report", states=("S01",)), of_report),
        (Request("report", views=("C1P1",)), "all views of campaign hat, .* submit report without it$"),
        (Request("merge", views=("C1P1", "C1P2")), of_merge),
    ):
        for asked in ([request], [Request("pipeline", {}, request.states, request.views), request]):
            with pytest.raises(InvalidInput, match=said):
                plan(CAMPAIGN, asked, everything_exists)
    # A state is recorded by all its views at once, and one of them is made of it.
    for kind in ("reconstruct", "pipeline"):
        jobs = plan(CAMPAIGN, [Request(k, views=("C1P1",)) for k in ("simulate", kind)], only_calibration)
        assert {job.subject.view for job in jobs if job.kind.name != "simulate"} == {"C1P1"}
    with pytest.raises(InvalidInput, match="simulate is about all views"):
        plan(CAMPAIGN, [Request("simulate", views=("C1P1",))], everything_exists)
    # Whoever names all of them has left nothing out.
    named = Request("report", {}, tuple(s.label for s in CAMPAIGN.states), CAMPAIGN.views)
    assert counted(plan(CAMPAIGN, [named], everything_exists)) == {"report": 1}


def test_one_kind_uses_what_exists() -> None:
    jobs = plan(CAMPAIGN, [Request("strain", views=("C1P2",))], everything_exists)
    assert counted(jobs) == {"strain": 3}
    assert all(i.existing == Existing(file_id=1) for job in jobs for i in job.inputs)


def test_what_is_needed_of_another_campaign_must_be_there() -> None:
    requests = [
        Request("merge"),
        Request("align", {"views": "other"}),
        Request("combine", {"views": "other"}),
    ]
    jobs = plan(CAMPAIGN, requests, everything_exists)
    assert {job.subject.campaign for job in jobs} == {"hat"}
    combine = [job for job in jobs if job.kind.name == "combine"]
    assert len(combine) == 3
    for job in combine:
        met = {given.need.subject.campaign: given.producer is None for given in job.inputs}
        assert met == {"hat": False, "other": True}

    def nothing_of_others(need: Need) -> Existing | None:
        return everything_exists(need) if need.subject.campaign == "hat" else None

    with pytest.raises(NotFound, match="needs the reconstruct of other/S00/C1P1"):
        plan(CAMPAIGN, requests, nothing_of_others)


def test_what_is_missing_is_named() -> None:
    with pytest.raises(NotFound, match="measurement of hat/S00/C1P1"):
        plan(CAMPAIGN, [Request("reconstruct")], only_calibration)


def test_a_missing_calibration_names_its_rig() -> None:
    def uncalibrated(need: Need) -> Existing | None:
        return None if need.source == CALIBRATION else Existing(file_id=1)

    told = f"reconstruct hat/S00/C1P1 needs a calibration of rig {CAMPAIGN.rig} that is valid"
    with pytest.raises(NotFound, match=f"{told}.* 'sms calibration import FILE --rig {CAMPAIGN.rig}'"):
        plan(CAMPAIGN, [Request("reconstruct")], uncalibrated)


def without(*lacking: str) -> Callable[[Need], Existing | None]:
    """Return a search that finds everything but the measurements of some tuples."""

    def find(need: Need) -> Existing | None:
        missing = need.source == MEASUREMENT and str(need.subject) in lacking
        return None if missing else Existing(file_id=1)

    return find


def test_a_state_that_lacks_something_is_refused_and_the_others_are_planned() -> None:
    found = plan_possible(CAMPAIGN, [Request("pipeline")], without("hat/S02/C1P2"))
    # S02 has 4 views; the other two deformed states and the reference are as if there were no S02.
    assert counted(found.jobs) == {
        "reconstruct": 12,
        "correlate": 8,
        "strain": 8,
        "merge": 2,
        "export": 2,
        "assess": 12,
    }
    assert {job.subject.state for job in found.jobs} == {"S00", "S01", "S03"}
    refused, report = found.refused
    assert str(refused.subject) == "hat/S02"
    assert "hat/S02/C1P2 needs the measurement of hat/S02/C1P2" in str(refused.error)
    assert refused.jobs == {
        "reconstruct": 4,
        "correlate": 4,
        "strain": 4,
        "merge": 1,
        "export": 1,
        "assess": 4,
    }
    # The report of the campaign shows every state.
    assert (str(report.subject), report.jobs) == ("hat", {"report": 1})
    assert "needs the measurement of hat/S02/C1P2" in str(report.error)
    for place, job in enumerate(found.jobs):
        assert all(i.producer is None or i.producer < place for i in job.inputs)
    with pytest.raises(NotFound, match="measurement of hat/S02/C1P2"):
        plan(CAMPAIGN, [Request("pipeline")], without("hat/S02/C1P2"))


def test_what_needs_a_refused_state_is_refused_with_it() -> None:
    previous = Request("pipeline", {"correlate.reference": "previous"})
    found = plan_possible(CAMPAIGN, [previous], without("hat/S02/C1P1"))
    assert [str(one.subject) for one in found.refused] == ["hat/S02", "hat/S03", "hat"]
    assert {job.subject.state for job in found.jobs} == {"S00", "S01"}


def test_nothing_is_planned_where_every_state_is_refused() -> None:
    # All are compared with the reference; of one state alone nothing is left.
    for request, lacking in (
        (Request("pipeline"), "hat/S00/C1P1"),
        (Request("pipeline", states=("S02",)), "hat/S02/C2P2"),
    ):
        with pytest.raises(NotFound, match=f"measurement of {lacking}"):
            plan_possible(CAMPAIGN, [request], without(lacking))


def test_a_campaign_on_a_real_rig_is_neither_simulated_nor_assessed() -> None:
    real = replace(small_plate("plate")[1], scene=None)

    def recorded(need: Need) -> Existing | None:
        return Existing(file_id=1) if need.source in (CALIBRATION, MEASUREMENT) else None

    kinds = counted(plan(real, EVERYTHING, recorded))
    assert "simulate" not in kinds
    assert "assess" not in kinds
    assert kinds["report"] == 1


def test_what_cannot_be_repeated_is_made_only_where_it_was_asked_for() -> None:
    requests = [Request("acquire", states=("S02",)), Request("pipeline", states=("S02",))]
    jobs = plan(CAMPAIGN, requests, everything_exists)
    # The reference state is compared with, as it was recorded; its load is gone.
    assert [str(job.subject) for job in jobs if job.kind.name == "acquire"] == ["hat/S02"]
    references = [
        i.existing
        for job in jobs
        for i in job.inputs
        if i.need.source == MEASUREMENT and i.need.subject.state == "S00"
    ]
    assert references
    assert all(existing == Existing(file_id=1) for existing in references)
    with pytest.raises(NotFound, match="needs the measurement of hat/S00"):
        plan(CAMPAIGN, requests, only_calibration)


def test_parameters_reach_their_kind() -> None:
    request = Request("pipeline", {"strain.gauge_length_mm": "25"})
    jobs = plan(CAMPAIGN, [request], everything_exists)
    lengths = {job.parameters.model_dump()["gauge_length_mm"] for job in jobs if job.kind.name == "strain"}
    assert lengths == {25.0}


def test_a_campaigns_own_parameters_hold_until_a_request_says_otherwise() -> None:
    own = replace(CAMPAIGN, processing={"strain": {"gauge_length_mm": 40.0, "measure": "small"}})
    (first, *_) = plan(own, [Request("strain", {"gauge_length_mm": "25"})], everything_exists)
    chosen = first.parameters.model_dump(exclude_defaults=True)
    assert chosen == {"gauge_length_mm": 25.0, "measure": "small"}


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        (Request("paint"), "paint"),
        (Request("strain", {"gauge_length_mm": "long"}), "gauge_length_mm.*long"),
        (Request("strain", {"colour": "red"}), "colour"),
        (Request("pipeline", {"paint.colour": "red"}), "paint.colour"),
        (Request("strain", states=("S9",)), "S9"),
        (Request("strain", views=("C9P9",)), "C9P9"),
    ],
)
def test_what_cannot_be_used_is_refused(request_: Request, words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        plan(CAMPAIGN, [request_], everything_exists)


def test_every_kind_is_found_by_its_file_and_documented() -> None:
    for name, kind in all_kinds().items():
        assert kind.name == name
        assert kind.version >= 1
        assert kind.summary
        assert (kind.parameters.__doc__ or "").strip()


def test_parameters_may_ask_for_the_state_before() -> None:
    """Correlating the last state with the one before needs the whole chain, one after the other."""
    last, view = CAMPAIGN.states[-1].label, CAMPAIGN.views[0]

    def chain(reference: str) -> list[PlannedJob]:
        request = Request("correlate", {"reference": reference}, (last,), (view,))
        return list(plan(CAMPAIGN, [request], everything_exists))

    assert [job.subject.state for job in chain("first")] == [last]
    jobs = chain("previous")
    assert [job.subject.state for job in jobs] == [s.label for s in CAMPAIGN.states[1:]]
    assert all(job.parameters.reference == "previous" for job in jobs)  # type: ignore[attr-defined]
    for place, job in enumerate(jobs):
        producers = [i.producer for i in job.inputs if i.need.source == "correlate"]
        assert producers == ([place - 1] if place else [])


def alone(*cameras: str) -> Campaign:
    """Return a real campaign of cameras without projectors."""
    return replace(CAMPAIGN, views=cameras, scene=None)


def images_exist(need: Need) -> Existing | None:
    return Existing(file_id=1) if need.source == MEASUREMENT else None


def test_the_pipeline_of_a_camera_alone_needs_neither_calibration_nor_shape() -> None:
    jobs = plan(alone("C1", "C2"), [Request("pipeline")], images_exist)
    kinds = counted(jobs)
    # 3 deformed states of 2 cameras.
    assert kinds["plane"] == 2
    assert kinds["correlate"] == kinds["strain"] == 6
    assert kinds["merge"] == 3
    assert not {"reconstruct", "assess"} & set(kinds)
    assert all(need.source != CALIBRATION for job in jobs for need in (i.need for i in job.inputs))


def test_each_pair_of_a_mixed_campaign_goes_its_own_way() -> None:
    mixed = replace(CAMPAIGN, views=("C1P1", "C2"), scene=None)
    jobs = plan(mixed, [Request("pipeline")], everything_exists)
    by_kind: dict[str, set[str | None]] = {}
    for job in jobs:
        by_kind.setdefault(job.kind.name, set()).add(job.subject.view)
    assert by_kind["correlate"] == by_kind["strain"] == {"C1P1", "C2"}
    assert (by_kind["reconstruct"], by_kind["plane"]) == ({"C1P1"}, {"C2"})


def test_a_camera_that_measures_shape_has_no_plane_in_the_pipeline() -> None:
    both = replace(CAMPAIGN, views=("C1P1", "C1"), scene=None)
    jobs = plan(both, [Request("pipeline")], everything_exists)
    assert {job.subject.view for job in jobs if job.kind.name in ("correlate", "plane")} == {"C1P1"}
    # It can still be asked for.
    asked = plan(both, [Request("correlate")], everything_exists)
    assert {job.subject.view for job in asked} == {"C1P1", "C1"}


def test_what_the_pipeline_leaves_out_is_to_be_submitted_as_well() -> None:
    both = replace(CAMPAIGN, views=("C1P1", "C1"), scene=None)
    gauges = Request("gauges", {"gauge": "G1 x=0 y=0 length=20"})

    def recorded(need: Need) -> Existing | None:
        return Existing(file_id=1) if need.source in (MEASUREMENT, CALIBRATION) else None

    asked = [Request("pipeline"), gauges]
    found = plan_possible(both, asked, recorded)
    said = str(found.refused[0].error)
    assert "needs the plane of hat/S00/C1, and there is none; the pipeline does not make it: " in said
    assert said.endswith("'sms job submit plane -c hat', or set `view` to views other than C1")
    # Both ways are ways.
    assert plan(both, [*asked, Request("plane")], recorded)
    assert plan(both, [replace(one, views=("C1P1",)) for one in asked], recorded)
    with pytest.raises(NotFound, match=r"the correlate of hat/S01/C1P1.*; submit the pipeline, or the job"):
        plan(both, [gauges], recorded)


@pytest.mark.parametrize("kind", ["reconstruct", "mesh", "assess"])
def test_a_kind_that_can_do_nothing_in_a_campaign_is_refused(kind: str) -> None:
    with pytest.raises(InvalidInput, match=f"{kind} has nothing to do .* C1 without a projector.*strain"):
        plan(alone("C1"), [Request(kind)], images_exist)
    with pytest.raises(InvalidInput, match="KIND one of correlate, export"):
        plan(alone("C1"), [Request("pipeline", {"reconstruct.blur_px": 5})], images_exist)


def test_a_report_needs_nothing_of_a_state_that_is_left_out() -> None:
    def all_but_one(need: Need) -> Existing | None:
        there = need.subject.state != "S02" or need.source == MEASUREMENT
        return Existing(file_id=1) if there else None

    with pytest.raises(NotFound, match="first, or leave the state out with leave_out=S02"):
        plan(CAMPAIGN, [Request("report")], all_but_one)
    (job,) = plan(CAMPAIGN, [Request("report", {"leave_out": "S02"})], all_but_one)
    assert "S02" not in {i.need.subject.state for i in job.inputs}

    def nothing_at_rest(need: Need) -> Existing | None:
        return None if need.subject.state == CAMPAIGN.reference.label else Existing(file_id=1)

    with pytest.raises(NotFound) as error:
        plan(CAMPAIGN, [Request("report")], nothing_at_rest)
    assert "leave" not in str(error.value)
