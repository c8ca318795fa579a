"""The server of a scanner: it lends its cameras and projectors to one client at a time.

It does what its client requests and nothing by itself. When the client is gone, whatever the reason,
projectors go dark and cameras stop.
"""

from __future__ import annotations

import logging
import socket
import threading
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InstrumentError, InvalidInput, LinkLost, SmsError
from sms_jobs.instruments.clock import Clock, RealClock
from sms_jobs.instruments.connected_rig import ConnectedRig
from sms_jobs.instruments.connection import connected
from sms_jobs.instruments.protocols import Fired
from sms_jobs.instruments.scanners.door import Door
from sms_jobs.instruments.scanners.link import DEFORMATION, SEQUENCE, SETTING, Address, error_reply
from sms_jobs.instruments.scanners.proof import SessionKeys
from sms_jobs.instruments.scanners.wire import SILENCE_S, Message, Wire, WireEnded
from sms_jobs.instruments.simulated.optics import WHITE, SimulatedCamera, VirtualRoom
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.optical_instruments import RigFile

_LOOKS_EVERY_S = 0.2
_QUEUE_S = 5.0
"""How long a client waits while another has the scanner, which may just be leaving."""
_MOST_WAITING = 8

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
    silence_s
        A client that has said nothing for so long is gone.
    """

    def __init__(
        self,
        rig: Callable[[], RigFile],
        address: Address,
        key: bytes,
        threads: int = 1,
        silence_s: float = SILENCE_S,
    ) -> None:
        self._rig = rig
        self._threads = threads
        self._silence_s = silence_s
        self._stopped = threading.Event()
        self._waiting = _WaitingRoom()
        self._door = Door(address, key, self._let_in)
        self.address = self._door.address

    def serve(self) -> None:
        """Serve one client after the other; instruments are used by the thread that calls this."""
        self._door.open()
        try:
            while not self._stopped.is_set():
                client = self._waiting.next(_LOOKS_EVERY_S)
                if client is not None:
                    self._serve(client)
        finally:
            self._door.close()
            self._waiting.close()

    def stop(self) -> None:
        """End it, from another thread."""
        self._stopped.set()

    def _let_in(self, wire: socket.socket, keys: SessionKeys, address: str) -> None:
        try:
            host, port = wire.getsockname()[:2]
            proven = Wire(wire, keys.from_server, keys.from_client, self._silence_s)
            client = _Client(proven, address, Address(str(host), int(port)))
        except (OSError, RuntimeError) as error:
            logger.debug("the client %s has gone at once: %s", address, error)
            wire.close()
            return
        self._waiting.enter(client)

    def _serve(self, client: _Client) -> None:
        with closing(client.wire) as wire:
            logger.info("a client has come: %s", client.address)
            try:
                _Visit(wire, self._rig, self._threads, self._stopped).serve()
            except WireEnded as error:
                logger.info("the client %s has gone (%s)", client.address, error)
            except Exception:  # the next client is to be served, whatever became of this one
                logger.exception("the client %s was sent away", client.address)


@dataclass(frozen=True)
class _Client:
    """One that has proven itself."""

    wire: Wire
    address: str
    server: Address

    def refuse(self) -> None:
        """Tell it that another one has the scanner."""
        taken = LinkLost(
            f"the scanner at {self.server} is lent to another client: end what records with it, or wait"
        )
        with closing(self.wire) as wire, suppress(WireEnded):
            wire.send(error_reply(taken))


class _WaitingRoom:
    """Clients that wait until the one before them has left, for a while."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._clients: deque[_Client] = deque()
        self._closed = False

    def enter(self, client: _Client) -> None:
        """Have a client wait; one too many is refused at once."""
        with self._changed:
            if len(self._clients) < _MOST_WAITING and not self._closed:
                self._clients.append(client)
                self._changed.notify()
                patience = threading.Timer(_QUEUE_S, self._give_up, [client])
                patience.daemon = True
                patience.start()
                return
        client.refuse()

    def next(self, patience_s: float) -> _Client | None:
        """Return the client whose turn it is; None if nobody comes in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._clients, patience_s)
            return self._clients.popleft() if self._clients else None

    def close(self) -> None:
        """Send everybody away."""
        with self._changed:
            self._closed = True
            clients = tuple(self._clients)
            self._clients.clear()
        for client in clients:
            client.wire.close()

    def _give_up(self, client: _Client) -> None:
        with self._changed:
            if client not in self._clients:
                return
            self._clients.remove(client)
        client.refuse()


@dataclass
class _Visit:
    """One client, from its coming to its going."""

    wire: Wire
    rig: Callable[[], RigFile]
    threads: int
    stopped: threading.Event
    clock: Clock = field(default_factory=RealClock)

    def serve(self) -> None:
        """Connect the instruments, and do what the client asks for until it is gone."""
        try:
            request = self._request()
            if request.get("command") != "open":
                raise InvalidInput("a client opens the scanner before it asks for anything else")
            setting = None if request["setting"] is None else SETTING.validate_python(request["setting"])
            with connected(self.rig(), setting, self.threads, self.clock) as rig:
                lent = Lent(rig, self.clock)
                try:
                    self._answer(lent.facts())
                    while True:
                        self._serve_request(lent, self._request())
                finally:
                    lent.rest()
                    logger.info("projectors are dark and cameras still")
        except (SmsError, KeyError, TypeError, ValueError) as error:
            self._answer(error_reply(error))

    def _serve_request(self, lent: Lent, request: Mapping[str, Any]) -> None:
        try:
            answer, image = lent.obey(request)
        except SmsError as error:
            self._answer(error_reply(error))
            return
        except (KeyError, TypeError, ValueError) as error:
            self._answer(
                error_reply(InvalidInput(f"the request {request.get('command')} cannot be read: {error}"))
            )
            return
        self._answer(answer, image)

    def _request(self) -> Mapping[str, Any]:
        message: Message | None = None
        while message is None:
            if self.stopped.is_set():
                raise WireEnded("the server was told to end")
            message = self.wire.receive(_LOOKS_EVERY_S)
        return message[0]

    def _answer(self, values: Mapping[str, Any], image: NDArray[Any] | None = None) -> None:
        self.wire.send(values, b"" if image is None else np.ascontiguousarray(image).data.cast("B"))


@dataclass
class Lent:
    """The sensors of a scanner while a client has them."""

    rig: ConnectedRig
    clock: Clock
    _sequence: FringeSequence = field(default_factory=FringeSequence)
    _fired: dict[str, Fired] = field(default_factory=dict)

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

    def obey(self, request: Mapping[str, Any]) -> tuple[dict[str, Any], NDArray[Any] | None]:
        """Do what a request asks for and return the answer."""
        match request["command"]:
            case "time":
                return {"time_s": self.clock.monotonic()}, None
            case "load":
                self._sequence = SEQUENCE.validate_python(request["sequence"])
                self._projector(request).load(self._sequence)
            case "show" if request["number"] == WHITE:
                self._projector(request).white()
            case "show":
                self._projector(request).show(request["number"])
            case "dark":
                self._projector(request).dark()
            case "arm":
                self._camera(request).arm(request["exposure"])
            case "trigger":
                self._fired |= self.rig.fire({request["camera"]: self._camera(request)})
            case "read":
                frame = self._camera(request).read(request["timeout_s"])
                fired = frame.fired or self._fired[request["camera"]]
                between_s = fired.not_before_s, fired.not_after_s
                return {"number": frame.number, "time_s": frame.time_s, "fired_s": between_s}, frame.image
            case "disarm":
                self._camera(request).disarm()
            case "stands":
                deformation = DEFORMATION.validate_python(request["deformation"])
                for room in self._rooms():
                    room.setting = replace(room.setting, deformation=deformation)
            case "elsewhere":
                self._light_elsewhere(request)
            case command:
                raise InvalidInput(f"there is no request '{command}'")
        return {}, None

    def _light_elsewhere(self, request: Mapping[str, Any]) -> None:
        """Have simulated cameras see what a projector of another scanner shows."""
        for room in self._rooms():
            if request["number"] is None:
                room.darken(request["projector"])
            else:
                room.light(
                    request["projector"], SEQUENCE.validate_python(request["sequence"]), request["number"]
                )

    def _rooms(self) -> list[VirtualRoom]:
        cameras = self.rig.cameras.values()
        return list({id(c.room): c.room for c in cameras if isinstance(c, SimulatedCamera)}.values())

    def _camera(self, request: Mapping[str, Any]) -> Any:
        return self._known(self.rig.cameras, request["camera"])

    def _projector(self, request: Mapping[str, Any]) -> Any:
        return self._known(self.rig.projectors, request["projector"])

    def _known(self, sensors: Mapping[str, Any], name: str) -> Any:
        if name not in sensors:
            raise InvalidInput(
                f"scanner {self.rig.name} has no {name}; it has {', '.join(sensors) or 'nothing to lend'}"
            )
        return sensors[name]
