"""Names, texts, numbers and times of records have limits, the same wherever they come from."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from math import inf, nan, nextafter
from pathlib import Path

import numpy as np
import pytest
from support.homes import initialised

from sms_jobs.cli.commands import COMMANDS
from sms_jobs.errors import ConfigurationError, InvalidInput
from sms_jobs.formats.configuration import example_campaign, parse_campaign
from sms_jobs.metrology.geometry.camera import SENSOR_PARAMETERS
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.records.calibration import CalibrationUncertainty
from sms_jobs.records.campaign import LoadState, Specimen
from sms_jobs.records.numbers import LARGEST, is_excessive
from sms_jobs.records.recording import Recording, Verdict, as_recorded
from sms_jobs.records.sensors import Box, SensorFormat
from sms_jobs.records.times import EARLIEST, LATEST, parsed_time
from sms_jobs.virtual_rig.campaigns import small_plate


@pytest.mark.parametrize("value", [inf, -inf, nan, 1e308])
def test_numbers_with_which_nothing_can_be_computed(value: float) -> None:
    calibration, _ = small_plate("plate")
    sensor = calibration.rig.sensors[0]
    with pytest.raises(InvalidInput, match="load_n of state S00"):
        LoadState("S00", load_n=value)
    with pytest.raises(InvalidInput, match="measured_load_n of state S00"):
        LoadState("S00", measured_load_n=value)
    with pytest.raises(InvalidInput, match="channel gauge of state S00"):
        LoadState("S00", channels={"gauge": value})
    with pytest.raises(InvalidInput, match="fx of sensor C1"):
        replace(sensor, intrinsics=Intrinsics(value, 900.0, 64.0, 64.0))
    with pytest.raises(InvalidInput, match="corner of the volume"):
        Box((0.0, 0.0, 0.0), (1.0, 1.0, value))


def test_limits_are_allowed_themselves_and_told_from_what_is_just_beyond() -> None:
    for value in (LARGEST, -LARGEST):
        assert LoadState("S00", load_n=value).load_n == value
    with pytest.raises(InvalidInput, match=r"load_n of state S00 is 1000000000000000\.1, and should be"):
        LoadState("S00", load_n=nextafter(LARGEST, inf))
    with pytest.raises(InvalidInput, match=r"load_n of state S00 is -1000000000000000\.1, and should be"):
        LoadState("S00", load_n=nextafter(-LARGEST, -inf))
    with pytest.raises(InvalidInput, match="load_n of state S00 is a whole number of 1329 bits"):
        LoadState("S00", load_n=10**400)
    last = LATEST - timedelta(microseconds=1)
    assert [LoadState("S00", time=moment).time for moment in (EARLIEST, last)] == [EARLIEST, last]


def test_what_an_overloaded_instrument_says_is_no_reading() -> None:
    before = {"load_n": 9.9e37, "gauge": 1.0, "broken": nan}
    after = {"load_n": 5.0, "gauge": 3.0}
    frames = {"numbers": np.arange(3), "times_s": np.arange(3.0)}
    recording = Recording("hall", Verdict(0.8, 0.0, 0.3), 0, 1, before, after, **frames)
    assert recording.readings() == {"gauge": 2.0}
    state = as_recorded(LoadState("S00", load_n=5.0), recording.readings())
    assert (state.known_load_n, state.channels) == (5.0, {"gauge": 2.0})


def test_names_and_sizes() -> None:
    with pytest.raises(InvalidInput, match="name of a specimen has 65 letters"):
        Specimen("a" * 65)
    with pytest.raises(InvalidInput, match=r"material of specimen a holds \\x1b"):
        Specimen("a", "\x1b[2J")
    with pytest.raises(InvalidInput, match="name of a channel"):
        LoadState("S00", channels={"a" * 65: 1.0})
    with pytest.raises(InvalidInput, match="columns of sensor C1"):
        SensorFormat("C1", 1 << 40, 10)


@pytest.mark.parametrize(
    "text",
    [
        "0001-01-01T00:00:00+14:00",
        "9999-12-31T23:59:59-14:00",
        "1899-12-31T00:00:00Z",
        "2200-01-01T00:00:00Z",
    ],
)
def test_years_that_no_test_had(text: str) -> None:
    with pytest.raises(InvalidInput, match="not in the years 1900 to 2199"):
        parsed_time(text, "--recorded-at")
    with pytest.raises(InvalidInput, match="time of state S00"):
        LoadState("S00", time=datetime.fromisoformat(text))


def test_times_need_a_zone() -> None:
    for text in ("2026-03-01T12:00:00", "yesterday", ""):
        with pytest.raises(InvalidInput, match="a time with its zone"):
            parsed_time(text, "--valid-from")
    assert parsed_time("2026-03-01T12:00:00Z", "--valid-from") == datetime(2026, 3, 1, 12, tzinfo=UTC)


@pytest.mark.parametrize("number", ["9" * 400, "9223372036854775808", "1e16", "1e308"])
def test_a_plan_with_an_endless_number_is_refused_by_its_key(number: str) -> None:
    text = example_campaign().replace("load_n = 20_000", f"load_n = {number}")
    with pytest.raises(ConfigurationError, match=r"plan\.toml, line \d+: states\[S01\].load_n should be"):
        parse_campaign(text, "plan.toml")


def test_every_command_refuses_endless_numbers() -> None:
    with pytest.raises(InvalidInput, match="priority cannot be"):
        COMMANDS["queue"].load("queue").commands["priority"].callback(value=1, priority=1 << 63)
    assert not is_excessive(True)
    assert not is_excessive((1 << 63) - 1)
    assert is_excessive(1 << 63)
    assert is_excessive(nan)


def test_an_archive_that_is_no_folder(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from sms_jobs import bootstrap

    initialised(home)
    for place in ("/dev/null", str(home / "sms.toml"), str(home / "unmounted")):
        monkeypatch.setenv("SMS_ARCHIVE", place)
        with pytest.raises(ConfigurationError, match="there is no folder"), bootstrap.services(home):
            pass
    assert not (home / "unmounted").exists()
    monkeypatch.setenv("SMS_ARCHIVE", "/dev/null")
    with pytest.raises(ConfigurationError):
        initialised(home)


@pytest.mark.parametrize("name", ["archive", "spool", "environment_file"])
@pytest.mark.parametrize("place", ["{" * 300, "a/" * 3000])
def test_a_place_that_no_file_system_has(
    name: str, place: str, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sms_jobs import bootstrap

    initialised(home)
    (home / "sms.toml").write_text(f'{name} = "{place}"\n')
    with (
        pytest.raises(ConfigurationError, match=r"255 are possible|cannot be read"),
        bootstrap.services(home),
    ):
        pass


def test_a_covariance_of_other_parameters_is_not_taken_for_ours(rng: np.random.Generator) -> None:
    count = 2 * len(SENSOR_PARAMETERS)
    covariance = rng.standard_normal((count, count))
    known = CalibrationUncertainty(("C1", "P1"), SENSOR_PARAMETERS, covariance)
    order = np.roll(np.arange(count), len(SENSOR_PARAMETERS))
    np.testing.assert_array_equal(known.of(["P1", "C1"]), covariance[np.ix_(order, order)])
    fewer, less = SENSOR_PARAMETERS[:-1], len(SENSOR_PARAMETERS) - 1
    old = CalibrationUncertainty(("C1", "P1"), fewer, covariance[: 2 * less, : 2 * less]).of(["P1"])
    np.testing.assert_array_equal(old[:-1, :-1], covariance[less : 2 * less, less : 2 * less])
    assert not old[-1].any()  # a parameter that did not exist was fixed
    assert not old[:, -1].any()
    other = CalibrationUncertainty(("C1", "P1"), (*SENSOR_PARAMETERS, "k99"), covariance)
    with pytest.raises(InvalidInput, match="k99, but sensors have"):
        other.of(["C1"])
