"""The server of a scanner: it lends its cameras and projectors to one client at a time.

It does what it is told and nothing by itself. When the client is gone, whatever the reason, projectors go
dark and cameras stop.
"""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing import AuthenticationError
from multiprocessing.connection import Connection, Listener, answer_challenge, deliver_challenge
from socket import SHUT_RDWR, create_connection, socket
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InstrumentError, InvalidInput, SmsError
from sms_jobs.instruments.clock import Clock, RealClock
from sms_jobs.instruments.connection import connected
from sms_jobs.instruments.recorder import ConnectedRig
from sms_jobs.instruments.scanners.link import (
    DEFORMATION,
    LONGEST_MESSAGE,
    PROTOCOL,
    SEQUENCE,
    SETTING,
    Address,
    as_told,
    prompt,
    wire_of,
)
from sms_jobs.instruments.simulated.optics import WHITE, Hall, SimulatedCamera
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.optical_instruments import RigFile

_LOOKS_EVERY_S = 0.2
_PROOF_S = 5.0
"""What a caller may take to prove that it has the key: nobody keeps others out by saying nothing."""

logger = logging.getLogger(__name__)


class ScannerServer:
    """Serves the sensors of a rig file, until it is stopped.

    Parameters
    ----------
    rig
        Asked for whenever a client comes, so that a changed file holds from then on.
    address
        Where it listens; port 0 takes a free one, see `address`.
    key
        What a client has to know.
    threads
        For rendering, where sensors are simulated.
    """

    def __init__(self, rig: Callable[[], RigFile], address: Address, key: bytes, threads: int = 1) -> None:
        self._rig = rig
        self._key = key
        self._threads = threads
        self._stopped = threading.Event()
        self._listener = Listener((address.host, address.port), backlog=4)
        host, port = self._listener.address[:2]
        self.address = Address(str(host), int(port))

    def serve(self) -> None:
        """Serve one client after the other."""
        with self._listener:
            while not self._stopped.is_set():
                with self._listener.accept() as connection:
                    if not _proven(connection, self._key):
                        continue
                    logger.info("a client has come: %s", self._listener.last_accepted)
                    try:
                        prompt(connection)
                        _Visit(connection, self._rig, self._threads, self._stopped).serve()
                    except (EOFError, OSError):
                        logger.info("the client has gone")
                    except Exception:  # the next client is to be served, whatever became of this one
                        logger.exception("the client was sent away")

    def stop(self) -> None:
        """End it, from another thread."""
        self._stopped.set()
        with suppress(OSError):  # it may have ended already; if not, it waits for a caller
            create_connection((self.address.host, self.address.port), 1.0).close()


def _proven(connection: Connection, key: bytes) -> bool:
    """Return whether a caller knows the key, and prove to it that this is known here too."""
    with wire_of(connection) as wire:
        hang_up = threading.Timer(_PROOF_S, partial(_hang_up, wire))
        hang_up.start()
        try:
            deliver_challenge(connection, key)
            answer_challenge(connection, key)
        except (AuthenticationError, EOFError, OSError) as error:
            # Also one that only looks whether the port is open.
            logger.debug("a caller was turned away: %s", error)
            return False
        finally:
            hang_up.cancel()
    return True


def _hang_up(wire: socket) -> None:
    with suppress(OSError):
        wire.shutdown(SHUT_RDWR)


@dataclass
class _Visit:
    """One client, from its coming to its going."""

    connection: Connection
    rig: Callable[[], RigFile]
    threads: int
    stopped: threading.Event
    clock: Clock = field(default_factory=RealClock)

    def serve(self) -> None:
        """Connect the instruments, and do what the client asks for until it is gone."""
        try:
            told = self._request()
            if told.get("command") != "open" or told.get("protocol") != PROTOCOL:
                raise InvalidInput(
                    f"the client speaks version {told.get('protocol')} and this server version {PROTOCOL}: "
                    "give both computers the same version of this program"
                )
            setting = None if told["setting"] is None else SETTING.validate_python(told["setting"])
            with connected(self.rig(), setting, self.threads, self.clock) as rig:
                lent = Lent(rig, self.clock)
                try:
                    self._answer(lent.facts())
                    while True:
                        self._serve_request(lent, self._request())
                finally:
                    lent.rest()
        except (SmsError, KeyError, TypeError, ValueError) as error:
            self._answer(as_told(error))

    def _serve_request(self, lent: Lent, told: Mapping[str, Any]) -> None:
        try:
            answer, image = lent.obey(told)
        except SmsError as error:
            self._answer(as_told(error))
            return
        except (KeyError, TypeError, ValueError) as error:
            self._answer(as_told(InvalidInput(f"the request {told.get('command')} cannot be read: {error}")))
            return
        self._answer(answer, image)

    def _request(self) -> dict[str, Any]:
        while not self.connection.poll(_LOOKS_EVERY_S):
            if self.stopped.is_set():
                raise EOFError
        told = json.loads(self.connection.recv_bytes(LONGEST_MESSAGE))
        if not isinstance(told, dict):
            raise TypeError("a request is a JSON object")
        return told

    def _answer(self, values: Mapping[str, Any], image: NDArray[Any] | None = None) -> None:
        follows = {} if image is None else {"bytes": image.nbytes}
        self.connection.send_bytes(json.dumps({**values, **follows}).encode())
        if image is not None:
            self.connection.send_bytes(np.ascontiguousarray(image).data.cast("B"))


@dataclass
class Lent:
    """The sensors of a scanner while a client has them."""

    rig: ConnectedRig
    clock: Clock
    _sequence: FringeSequence = field(default_factory=FringeSequence)

    def facts(self) -> dict[str, Any]:
        """Return what there is."""
        return {
            "cameras": {n: vars(c.facts) for n, c in self.rig.cameras.items()},
            "projectors": list(self.rig.projectors),
            "described": dict(self.rig.described),
            "simulated": self.rig.simulation is not None,
        }

    def rest(self) -> None:
        """Leave projectors dark and cameras still, whatever state they are in."""
        for leave in (
            *(p.dark for p in self.rig.projectors.values()),
            *(c.disarm for c in self.rig.cameras.values()),
        ):
            with suppress(InstrumentError):
                leave()

    def obey(self, told: Mapping[str, Any]) -> tuple[dict[str, Any], NDArray[Any] | None]:
        """Do what a request asks for and return the answer."""
        match told["command"]:
            case "time":
                return {"time_s": self.clock.monotonic()}, None
            case "load":
                self._sequence = SEQUENCE.validate_python(told["sequence"])
                self._projector(told).load(self._sequence)
            case "show" if told["number"] == WHITE:
                self._projector(told).white()
            case "show":
                self._projector(told).show(told["number"])
            case "dark":
                self._projector(told).dark()
            case "arm":
                self._camera(told).arm(told["exposure"])
            case "trigger":
                self.rig.trigger.fire({told["camera"]: self._camera(told)})
            case "read":
                frame = self._camera(told).read(told["timeout_s"])
                return {"number": frame.number, "time_s": frame.time_s}, frame.image
            case "disarm":
                self._camera(told).disarm()
            case "stands":
                deformation = DEFORMATION.validate_python(told["deformation"])
                for hall in self._halls():
                    hall.setting = replace(hall.setting, deformation=deformation)
            case "elsewhere":
                self._light_elsewhere(told)
            case command:
                raise InvalidInput(f"there is no request '{command}'")
        return {}, None

    def _light_elsewhere(self, told: Mapping[str, Any]) -> None:
        """Have simulated cameras see what a projector of another scanner shows."""
        for hall in self._halls():
            if told["number"] is None:
                hall.darken(told["projector"])
            else:
                hall.light(told["projector"], SEQUENCE.validate_python(told["sequence"]), told["number"])

    def _halls(self) -> list[Hall]:
        cameras = self.rig.cameras.values()
        return list({id(c.hall): c.hall for c in cameras if isinstance(c, SimulatedCamera)}.values())

    def _camera(self, told: Mapping[str, Any]) -> Any:
        return self._known(self.rig.cameras, told["camera"])

    def _projector(self, told: Mapping[str, Any]) -> Any:
        return self._known(self.rig.projectors, told["projector"])

    def _known(self, sensors: Mapping[str, Any], name: str) -> Any:
        if name not in sensors:
            raise InvalidInput(
                f"scanner {self.rig.name} has no {name}; it has {', '.join(sensors) or 'nothing to lend'}"
            )
        return sensors[name]
