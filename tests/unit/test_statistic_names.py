"""Names of statistics are taken apart as they were put together."""

from __future__ import annotations

from dataclasses import fields

from sms_jobs.records import statistic_names as names
from sms_jobs.records.assessment import Errors
from sms_jobs.records.gauge_limits import GaugeLimit, gauge_limit
from sms_jobs.records.reasons import Reason
from sms_jobs.records.shown.quick_looks import GaugeLook

CHANNELS = {"load_n": 1.0, "temperature": 2.0, "sitting_before": 3.0}


def test_channels_are_found_again_by_what_they_read_before() -> None:
    told = {names.before(name): value for name, value in CHANNELS.items()}
    told |= {names.after(name): -value for name, value in CHANNELS.items()}
    assert names.channels_before({**told, names.DOUBTS: 1.0}) == CHANNELS


def test_losses_are_told_in_words() -> None:
    of_pixels = {names.lost_to(reason): 0.5 for reason in Reason if reason}
    of_points = {names.fraction_of_points(reason): 0.25 for reason in Reason if reason}
    told = {**of_pixels, **of_points, names.VALID_FRACTION: 0.0}
    for part, value in ((names.lost_to, 0.5), (names.fraction_of_points, 0.25)):
        words = names.losses(told, part)
        assert set(words.values()) == {value}
        named = {word.replace(" ", "_").upper() for word in words}
        assert named == {reason.name for reason in Reason if reason}


def test_a_gauge_is_read_as_it_was_written() -> None:
    written = {}
    for place, quantity in enumerate(names.GAUGE_QUANTITIES):
        for gauge in ("g1", "left_edge"):
            written[names.of_gauge(gauge, quantity)] = float(place)
            written[names.of_gauge(gauge, names.with_sigma(quantity))] = 0.1 * place
    assert list(names.gauges_in(written)) == ["g1", "left_edge"]
    look = GaugeLook.of("left_edge", written)
    assert [look.read(quantity) for quantity in names.GAUGE_QUANTITIES] == [(k, 0.1 * k) for k in range(4)]


def test_a_limit_names_the_statistic_that_it_is_held_against() -> None:
    for quantity in names.GAUGE_QUANTITIES:
        limit = gauge_limit(f"g1.{quantity} > 0.5mm", "it")
        assert limit == GaugeLimit("g1", quantity, True, 0.5)
        assert limit.statistic == names.of_gauge("g1", quantity)


def test_only_lengths_carry_a_unit_among_errors() -> None:
    of_shape = {one.name: names.of_errors("shape", one.name) for one in fields(Errors)}
    with_unit = {key for key, name in of_shape.items() if name.endswith("_mm")}
    assert with_unit == {"rms", "bias", "largest"}
    assert not any(names.of_errors("strain", key).endswith("_mm") for key in of_shape)
