"""An emergency stop that asks nobody: neither a lock nor the program that uses the port."""

from __future__ import annotations

from collections.abc import Iterable

import serial

from sms_jobs.errors import ConfigurationError, LinkLost, SmsError
from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.codecs import powercube, ptu46, schunk_motion
from sms_jobs.records.instruments import Stage
from sms_jobs.records.serial_links import SIMULATED

_TIMES = 3  # since another program may be writing at the same moment, and nobody answers
_PAUSE_S = 0.05


def stop_requests(stage: Stage) -> tuple[bytes, ...]:
    """Return the bytes that stop a stage at once."""
    if stage.protocol == "powercube":
        halt = powercube.Message(powercube.BROADCAST, bytes((powercube.Command.HALT,)))
        return (powercube.encode(halt, stage.checksum),)
    if stage.protocol == "schunk-motion":
        command = schunk_motion.Command.FAST_STOP
        return tuple(
            schunk_motion.encode(schunk_motion.request(axis.module, command))
            for axis in (stage.pan, stage.tilt)
        )
    return (ptu46.command("h"),)


def emergency_stop(stages: Iterable[Stage], clock: Clock) -> tuple[str, ...]:
    """Stop stages at once, even while another program uses their ports; return the names of those commanded.

    What is being moved ends with an error there, and the stage must be recovered before it moves again.

    Raises
    ------
    LinkLost
        A port cannot be written to; all others were commanded before this is raised. Switch the power off.
    ConfigurationError
        A stage is simulated in memory: only the program that simulates it can stop it.
    """
    commanded: list[str] = []
    errors: list[SmsError] = []
    for stage in stages:
        if stage.link.port == SIMULATED:
            errors.append(
                ConfigurationError(
                    f"'{stage.name}' is simulated in the memory of another program: cancel its job instead"
                )
            )
            continue
        try:
            _tell(stage, clock)
        except (OSError, ValueError) as error:  # pyserial's exceptions are OSErrors
            errors.append(
                LinkLost(
                    f"'{stage.name}' cannot be stopped through {stage.link.port} ({error}): switch its power "
                    "off"
                )
            )
        else:
            commanded.append(stage.name)
    if errors:
        raise errors[0]
    return tuple(commanded)


def _tell(stage: Stage, clock: Clock) -> None:
    # Without exclusive use, since the port belongs to somebody else; who loses a reply by it asks again.
    port = serial.Serial(stage.link.port, stage.link.baud_rate, write_timeout=1.0)
    try:
        for _ in range(_TIMES):
            for request in stop_requests(stage):
                port.write(request)
            clock.sleep(_PAUSE_S)
    finally:
        port.close()
