"""Simulators on pseudo-terminals, where anything that opens a serial port can talk to them."""

from __future__ import annotations

import os
import select
import sys
import tty
from dataclasses import replace
from pathlib import Path

import pytest

from sms_jobs.errors import ConfigurationError, InvalidInput, LinkLost, NotFound
from sms_jobs.instruments.clock import RealClock, SimulatedClock
from sms_jobs.instruments.devices.connecting import Connector
from sms_jobs.instruments.devices.emergency_stop import emergency_stop, stop_requests
from sms_jobs.instruments.simulated.serial.simulation import SerialSimulation, simulate
from sms_jobs.instruments.transports.serial_port import SerialPort
from sms_jobs.records.instruments import Instruments, SerialChannel, Stage, TriggerController
from sms_jobs.records.serial_links import LineProtocol, SerialLink, Wire

LINK = SerialLink("simulated", 9600)
STAGE = Stage("stage", LINK)
BOX = TriggerController("box", LINK, LineProtocol(), (Wire("C1", 1),), "T{output}")
RIG = Instruments(stages=(STAGE,), triggers=(BOX,))

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals")


def exchange(path: str, request: bytes, length: int) -> bytes:
    """Talk to a port with nothing but the operating system."""
    port = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        tty.setraw(port)
        os.write(port, request)
        reply = b""
        while len(reply) < length and select.select([port], [], [], 5.0)[0]:
            reply += os.read(port, length - len(reply))
        return reply
    finally:
        os.close(port)


def test_any_terminal_can_talk_to_them(tmp_path: Path) -> None:
    folder = tmp_path / "ports"
    with simulate(RIG, folder) as simulated:
        assert [(p.device, p.path) for p in simulated.ports] == [
            ("stage", str(folder / "stage")),
            ("box", str(folder / "box")),
        ]
        # Version of module 12: 2512 (hexadecimal), the low byte first, and 09+84+0a+1d+12+25 = eb.
        version = exchange(simulated.ports[0].path, bytes.fromhex("02 05 82 0a 1d ae 03"), 9)
        assert version.hex(" ") == "02 09 84 0a 1d 12 25 eb 03"
        assert exchange(simulated.ports[1].path, b"T1\r\n", 3) == b"O\r\n"
        assert exchange(simulated.ports[1].path, b"T9\r\n", 5) == b"N01\r\n"
        assert [output for _, output in simulated.simulation.controller("box").triggers] == [1]
    assert list(folder.iterdir()) == []
    simulated.close()


def test_a_port_belongs_to_one_program() -> None:
    with simulate(RIG) as simulated:
        link = SerialLink(simulated.ports[1].path)
        first = SerialPort("box", link)
        with pytest.raises(LinkLost, match=r"of 'box' cannot be opened .* no other program does"):
            SerialPort("box", link)
        first.close()
        SerialPort("box", link).close()


def test_a_port_that_breaks_is_reported() -> None:
    with simulate(RIG) as simulated:
        port = SerialPort("box", SerialLink(simulated.ports[1].path))
    # The terminal is gone, as a USB adapter that was pulled out.
    for use in (lambda: port.write(b"T1\r\n"), lambda: port.read(0.05), port.flush):
        with pytest.raises(LinkLost, match=r"'box' broke .* plug the cable in again"):
            use()
    port.close()


def test_an_emergency_stop_that_reaches_nobody_says_so() -> None:
    missing = replace(STAGE, link=SerialLink("/nowhere/tty"))
    with pytest.raises(LinkLost, match=r"'stage' cannot be stopped .* switch its power off"):
        emergency_stop([missing], RealClock())
    with pytest.raises(ConfigurationError, match="simulated in the memory of another program"):
        emergency_stop([STAGE], RealClock())
    # HALT of all modules, as published for one: 04 + 01 + 02 = 07.
    assert [r.hex(" ") for r in stop_requests(STAGE)] == ["02 04 01 10 82 07 03"]


def test_what_cannot_be_simulated_is_said() -> None:
    odd = TriggerController("box", LINK, LineProtocol(accepted="^ready$"), (Wire("C1", 1),), "T")
    with pytest.raises(InvalidInput, match="'box' cannot be simulated"):
        SerialSimulation(Instruments(triggers=(odd,)), SimulatedClock())
    channel = SerialChannel("load", LINK, LineProtocol(), "N", "?", reply=r"^<(?P<value>\d)>$")
    with pytest.raises(InvalidInput, match="channel 'load' cannot be simulated"):
        SerialSimulation(Instruments(channels=(channel,)), SimulatedClock())
    simulation = SerialSimulation(RIG, SimulatedClock())
    with pytest.raises(NotFound, match="there is stage, box"):
        simulation.wire("load")
    with pytest.raises(NotFound, match="no simulated controller"):
        simulation.controller("stage")
    with pytest.raises(ConfigurationError, match="there is no simulation"):
        Connector(RealClock()).stage(STAGE)
